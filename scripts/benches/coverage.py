"""How often 95 % intervals hold the truth, on simulated repetitions of the same experiments.

The data are exact mass-spring-damper responses (linear systems, solved by matrix exponentials, not
by the project) with noise; they are fitted through the FMU in configs/models. For intervals from
derivatives the noise is white, or an autoregression of first order (`noises`), in as many
experiments as `experiments` says; beside them stands how often they would hold the truth if the
noise were taken for white. The share of intervals that hold the truth should be between 90 and
99 %. What comes out are counts: they do not depend on the machine.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from scipy.signal import lsim
from scipy.special import stdtrit

from benches import Row
from benches.common import MODELS
from cluster_est import Experiment, Input, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.executors.local import LocalExecutor
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import UncertaintySettings, assess, profiles
from workers.messages import FloatArray

OPTIONS = {"repetitions": 200, "profiles": 200, "noises": [0.0, 0.5, 0.9], "experiments": [4, 20]}
FMU = MODELS / "mass_spring_damper.fmu"
TRUTH = {"m": 1.2, "k": 30.0, "c": 0.6}
STEP = 0.04
NOISE = 0.02
REFIT = LeastSquares(differences="forward", trials=2)

Hits = dict[str, list[bool]]


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each kind of interval and parameter, with the standard error of the share."""
    kinds: dict[str, Hits] = {}
    for correlation in options.noises:
        for count in options.experiments:
            name = f"noise {correlation:g}, {count} experiments"
            own, white = covariance_hits(options.repetitions, count, correlation=correlation)
            kinds |= {name: own, f"{name}, as if white": white}
    kinds["profile"] = profile_hits(options.profiles)
    for kind, found in kinds.items():
        for label, held in found.items():
            share = float(np.mean(held))
            error = float(np.sqrt(max(share * (1.0 - share), 1e-9) / len(held)))
            yield {"intervals": kind, "parameter": label, "held": sum(held), "of": len(held),
                   "share": share, "its error": error}  # fmt: skip


def response(times: FloatArray, force: FloatArray, x0: float) -> FloatArray:
    """Displacement under a force that is linear between its samples, without approximation."""
    m, k, c = TRUTH["m"], TRUTH["k"], TRUTH["c"]
    system = ([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    return np.asarray(lsim(system, force, times, [x0, 0.0])[1]).ravel()


def noise(generator: np.random.Generator, samples: int, correlation: float) -> FloatArray:
    """An autoregression of first order, stationary from its first sample on."""
    values = generator.normal(size=samples)
    for t in range(1, samples if correlation else 0):
        values[t] = correlation * values[t - 1] + np.sqrt(1.0 - correlation**2) * values[t]
    return NOISE * values


def repeated(
    repetitions: int, experiments: int, samples: int, seed: int, correlation: float = 0.0
) -> tuple[Problem, dict[str, float]]:
    """All repetitions in one problem, so that one executor serves them all; and the truth."""
    generator = np.random.default_rng(seed)
    times = STEP * np.arange(samples, dtype=np.float64)
    truth = dict(TRUTH)
    runs = []
    designs = [
        (2.0 * generator.normal(size=samples), float(generator.uniform(-0.2, 0.2)))
        for _ in range(experiments)
    ]
    exact = [response(times, force, x0) for force, x0 in designs]
    for r in range(repetitions):
        for e, (force, x0) in enumerate(designs):
            name = f"r{r}e{e}"
            truth[f"x0[{name}]"] = x0
            measured = exact[e] + noise(generator, samples, correlation)
            inputs, outputs = (Input("F", times, force),), (Output("y", times, measured),)
            runs.append(Experiment(name, 0.0, float(times[-1]), inputs, outputs))
    parameters = (
        Parameter("m", 1.0, (0.1, 10.0)),
        Parameter("k", 20.0, (1.0, 200.0), scale="log"),
        Parameter("c", 1.0, (0.0, 10.0)),
        Parameter("x0", 0.0, (-1.0, 1.0), variable="x", per="experiment"),
    )
    names = tuple(p.target for p in parameters)
    solver = Solver("rk4", step=0.01)
    model = Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, names)
    return Problem(model, parameters, tuple(runs)), truth


def fitted(
    repetitions: int, experiments: int, samples: int, seed: int, correlation: float = 0.0
) -> tuple[Runner, list[tuple[SearchSpace, Solution]], dict[str, float]]:
    """Every repetition, fitted."""
    problem, truth = repeated(repetitions, experiments, samples, seed, correlation)
    spaces = [
        make_space(problem, tuple(range(r * experiments, (r + 1) * experiments)))
        for r in range(repetitions)
    ]
    runner = Runner(LocalExecutor.open(problem.model, problem.experiments, 1, None))
    requests = [SearchRequest(f"fit {r}", LeastSquares(), s) for r, s in enumerate(spaces)]
    found = runner.run(requests, at_once=8)
    return runner, list(zip(spaces, found, strict=True)), truth


def covariance_hits(
    repetitions: int, experiments: int = 4, samples: int = 60, correlation: float = 0.0
) -> tuple[Hits, Hits]:
    """Whether the intervals from derivatives hold the truth, and whether those for white noise."""
    _, found, truth = fitted(repetitions, experiments, samples, seed=1, correlation=correlation)
    hits: Hits = defaultdict(list)
    white: Hits = defaultdict(list)
    for space, solution in found:
        assessed = assess(space, solution)
        width = float(stdtrit(assessed.degrees, 0.975))
        for i, interval in enumerate(assessed.intervals):
            unknown = space.unknowns[i]
            value = truth[unknown.label]
            hits[unknown.parameter.name].append(interval.lower95 <= value <= interval.upper95)
            estimate = unknown.to_physical(float(solution.x[i]))
            distance = estimate * np.log(value / estimate) if unknown.log else value - estimate
            inside = abs(distance) <= width * interval.error_white
            white[unknown.parameter.name].append(bool(inside))
    return hits, white


def profile_hits(repetitions: int, experiments: int = 4, samples: int = 60) -> Hits:
    """Whether those of profiles of the shared unknowns do."""
    runner, found, truth = fitted(repetitions, experiments, samples, seed=2)
    hits: Hits = defaultdict(list)
    settings = UncertaintySettings(profiles=("shared",), steps=2)
    for space, solution in found:
        for profile in profiles(runner, space, solution, REFIT, settings):
            hits[profile.label].append(profile.lower <= truth[profile.label] <= profile.upper)
    return hits
