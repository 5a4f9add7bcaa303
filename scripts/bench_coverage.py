"""How often 95 % intervals hold the truth, on simulated repetitions of the same experiments.

    python scripts/bench_coverage.py [--repetitions N] [--profiles N] [--bootstraps N] [--draws N]

The data are exact mass-spring-damper responses (linear systems, solved by matrix exponentials, not
by the project) with noise; they are fitted through the FMU in configs/models. For intervals from
derivatives the noise is white, or an autoregression of first order (`--noises`), in as many
experiments as `--experiments` says; beside them stands how often they would hold the truth if the
noise were taken for white. The share of intervals that hold the truth should be between 90 and
99 %. What comes out are counts: they do not depend on the machine.
"""

from __future__ import annotations

import argparse
import os
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.signal import lsim
from scipy.special import stdtrit

from cluster_est import Experiment, Input, LeastSquares, Model, Output, Parameter, Problem, Solver
from cluster_est.executors.local import LocalExecutor
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import UncertaintySettings, assess, bootstrap, profiles
from workers.messages import FloatArray

FMU = Path(__file__).parent.parent / "configs" / "models" / "mass_spring_damper.fmu"
TRUTH = {"m": 1.2, "k": 30.0, "c": 0.6}
STEP = 0.04
NOISE = 0.02
LEAST, MOST = 0.90, 0.99
REFIT = LeastSquares(differences="forward", trials=2)

Hits = dict[str, list[bool]]


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
        Parameter("m", 1.0, 0.1, 10.0),
        Parameter("k", 20.0, 1.0, 200.0, scale="log"),
        Parameter("c", 1.0, 0.0, 10.0),
        Parameter("x0", 0.0, -1.0, 1.0, variable="x", per="experiment"),
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


def bootstrap_hits(
    repetitions: int, draws: int, experiments: int = 20, samples: int = 30
) -> dict[str, Hits]:
    """Whether the three kinds of bootstrap interval do."""
    runner, found, truth = fitted(repetitions, experiments, samples, seed=3)
    hits: dict[str, Hits] = defaultdict(lambda: defaultdict(list))
    settings = UncertaintySettings(bootstrap=draws)
    for r, (space, solution) in enumerate(found):
        generator = np.random.default_rng(r)
        for each in bootstrap(runner, space, solution, REFIT, settings, generator).intervals:
            value = truth[each.label]
            kinds = {
                "bootstrap": (each.lower, each.upper),
                "bootstrap percentile": (each.percentile_lower, each.percentile_upper),
                "bootstrap basic": (each.basic_lower, each.basic_upper),
            }
            for kind, (lower, upper) in kinds.items():
                hits[kind][each.label].append(lower <= value <= upper)
    return hits


def table(hits: dict[str, Hits]) -> Iterable[str]:
    """A line for each kind of interval and parameter, with the standard error of the share."""
    yield f"{'intervals':36}{'parameter':>10}{'held':>12}{'share':>16}  90 to 99 %"
    for kind, found in hits.items():
        for label, held in found.items():
            share, count = float(np.mean(held)), len(held)
            error = float(np.sqrt(max(share * (1.0 - share), 1e-9) / count))
            inside = "yes" if LEAST <= share <= MOST else "no"
            counts = f"{sum(held)} of {count}"
            yield f"{kind:36}{label:>10}{counts:>12}{share:9.1%} +-{error:5.1%}  {inside}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--profiles", type=int, default=200)
    parser.add_argument("--bootstraps", type=int, default=100)
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--noises", type=float, nargs="*", default=[0.0, 0.5, 0.9])
    parser.add_argument("--experiments", type=int, nargs="*", default=[4, 20])
    asked = parser.parse_args()
    hits: dict[str, Hits] = {}
    for correlation in asked.noises:
        for count in asked.experiments:
            name = f"noise {correlation:g}, {count} experiments"
            own, white = covariance_hits(asked.repetitions, count, correlation=correlation)
            hits |= {name: own, f"{name}, as if white": white}
    if asked.profiles:
        hits["profile"] = profile_hits(asked.profiles)
    if asked.bootstraps:
        hits |= bootstrap_hits(asked.bootstraps, asked.draws)
    for line in table(hits):
        print(line)


if __name__ == "__main__":
    main()
