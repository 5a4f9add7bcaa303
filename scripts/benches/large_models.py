"""What the screening of a closed loop costs on models of 2, 50 and 200 states: seconds and memory.

A mass on a spring, an electric ladder network (50 states) and a building of 100 rooms (200), each
of which lacks one effect; each with five training experiments of 1,000 samples and one held out.
The data come from SciPy's integrators and the equations here, with noise. Each model (`only`) has a
process of its own. A row has what the screening of the declared model's residual took, the peak of
the memory up to then, and what came first beside what is missing.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

import cluster_est as ce
from benches import Row
from benches.common import WrittenModel
from cluster_est.closed_loop.prepare import LoopRequest, open_workbench
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.workbench import FitStart
from workers.messages import FloatArray, Role

OPTIONS = {"only": ["spring", "ladder", "building"]}
SAMPLES, NOISE = 1000, 0.01
ROLES: tuple[Role, ...] = (*("train",) * 5, "test")
HELD = 25
"""Samples for which an input is held."""

Rates = Callable[[FloatArray, FloatArray], FloatArray]


@dataclass(frozen=True)
class LargeModel:
    """A model as equations in C and in NumPy, and what the one in C lacks.

    Attributes
    ----------
    step
        Between samples.
    parameters
        True values by name.
    inputs
        The range of each.
    states, outputs
        Names; an output "y_X" shows the state X.
    equations
        In C, of the model that lacks the effect.
    rates
        Of the states with the effect: f(x, u).
    missing
        The effect, in words.
    """

    name: str
    step: float
    parameters: dict[str, float]
    inputs: dict[str, tuple[float, float]]
    states: tuple[str, ...]
    outputs: tuple[str, ...]
    equations: tuple[str, ...]
    rates: Rates
    missing: str

    @property
    def times(self) -> FloatArray:
        return np.asarray(np.arange(SAMPLES) * self.step, float)

    def archive(self) -> bytes:
        """The FMU."""
        written = WrittenModel(
            self.name, self.parameters, list(self.inputs), self.states, self.outputs,
            self.equations, float(self.times[-1]), self.step, 0.1,
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            return written.build(Path(folder)).read_bytes()


def spring() -> LargeModel:
    """A mass on a spring that lacks a drag."""

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        return np.array([x[1], u[0] - 4.0 * x[0] - 0.4 * x[1] - 0.3 * x[1] * abs(x[1])])

    equations = ("der_x = M(v)", "der_v = M(F) - M(k) * M(x) - M(c) * M(v)")
    given = {"k": 4.0, "c": 0.4}
    return LargeModel("spring", 0.05, given, {"F": (-4.0, 4.0)}, ("x", "v"), ("x",), equations,
                      rates, "quadratic at der(v)")  # fmt: skip


def ladder() -> LargeModel:
    """Sections of a coil and a capacitor each; the 13th capacitor lacks a leak that is cubic."""
    count, leaking = 25, 13

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        i, v = x[:count], x[count:]
        before = np.concatenate([u, v[:-1]])
        after = np.append(i[1:], v[-1] / 1.2)
        found = np.concatenate([(before - v - 0.05 * i) / 0.8, (i - after) / 0.8])
        found[count + leaking - 1] -= 0.15 * v[leaking - 1] ** 3
        return found

    coils, capacitors = [], []
    for j in range(1, count + 1):
        before = "source" if j == 1 else f"u{j - 1}"
        after = f"M(i{j + 1})" if j < count else f"M(u{j}) / M(load)"
        coils.append(f"der_i{j} = (M({before}) - M(u{j}) - M(R) * M(i{j})) / M(L)")
        capacitors.append(f"der_u{j} = (M(i{j}) - {after}) / M(C)")
    states = tuple(f"{kind}{j}" for kind in "iu" for j in range(1, count + 1))
    given = {"R": 0.05, "L": 0.8, "C": 0.8, "load": 1.2}
    return LargeModel("ladder", 0.1, given, {"source": (-2.0, 2.0)}, states,
                      ("u5", "u13", "u20", "u25"), (*coils, *capacitors), rates,
                      f"cubic at der(u{leaking})")  # fmt: skip


def building() -> LargeModel:
    """A hundred rooms, each with its walls, in four heated zones; one lacks a loss."""
    side, lossy = 10, 44
    rooms = range(side * side)
    beside = [
        [r for r, ok in ((n - 1, n % side), (n + 1, (n + 1) % side), (n - side, n >= side),
                         (n + side, n < side * (side - 1))) if ok]
        for n in rooms
    ]  # fmt: skip
    zone = [2 * (n // side >= side // 2) + (n % side >= side // 2) for n in rooms]
    outside = np.array([4 - len(own) for own in beside], float)
    joined = np.zeros((len(rooms), len(rooms)))
    for n, own in enumerate(beside):
        joined[n, own] = 1.0
        joined[n, n] = -len(own)
    heated = np.array(zone)

    def rates(x: FloatArray, u: FloatArray) -> FloatArray:
        air, wall = x[: len(rooms)], x[len(rooms) :]
        found = 0.25 * (joined @ air) + 0.5 * (wall - air) + 0.1 * outside * (u[0] - air)
        found += u[1 + heated]
        found[lossy] -= 0.02 * air[lossy] * abs(air[lossy])
        walls = 0.1 * (air - wall) + 0.02 * (u[0] - wall)
        return np.concatenate([found, walls])

    airs, walls = [], []
    for n, own in enumerate(beside):
        flow = " + ".join(f"M(T{r}) - M(T{n})" for r in own)
        airs.append(
            f"der_T{n} = M(between) * ({flow}) + M(inner) * (M(W{n}) - M(T{n})) + "
            f"{outside[n]:.1f} * M(window) * (M(Tout) - M(T{n})) + M(zone{zone[n]})"
        )
        walls.append(f"der_W{n} = M(store) * (M(T{n}) - M(W{n})) + M(outer) * (M(Tout) - M(W{n}))")
    states = tuple(f"{kind}{n}" for kind in "TW" for n in rooms)
    given = {"between": 0.25, "inner": 0.5, "window": 0.1, "store": 0.1, "outer": 0.02}
    inputs = {"Tout": (-8.0, 8.0), **{f"zone{z}": (0.0, 2.0) for z in range(4)}}
    shown = tuple(f"T{n}" for n in range(0, side * side, 11))
    return LargeModel("building", 0.1, given, inputs, states, shown, (*airs, *walls), rates,
                      f"quadratic at der(T{lossy})")  # fmt: skip


MODELS = {"spring": spring, "ladder": ladder, "building": building}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each model."""
    context = multiprocessing.get_context("spawn")
    for name in options.only:
        with context.Pool(1) as pool:
            yield pool.apply(screened, (name,))


def screened(name: str) -> Row:
    """Screen one model."""
    model = MODELS[name]()
    problem = make_problem(model, model.archive())
    with open_workbench(LoopRequest(problem)) as bench:
        fitted = fit_declared(bench, FitStart(bench.problem, {}))
        begin = time.perf_counter()
        screening = screen(bench, fitted, 1)
        seconds = time.perf_counter() - begin
    best = screening.ranking.leaders(screening.ranking.plain, 1)[0]
    first = screening.ranking.trials[best].candidate
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"model": name, "states": len(model.states), "candidates": screening.count,
            "seconds": seconds, "peak MB": peak, "first": f"{first.form.name} at {first.site}",
            "missing": model.missing}  # fmt: skip


def simulate(model: LargeModel, number: int) -> tuple[tuple[ce.Input, ...], FloatArray]:
    """The inputs of an experiment, held for a while, and the true outputs, (samples, outputs)."""
    random = np.random.default_rng([17, number])
    times = model.times
    given = {
        name: np.repeat(random.uniform(*ends, SAMPLES // HELD), HELD)
        for name, ends in model.inputs.items()
    }
    held = np.array(list(given.values()))
    states = np.zeros((SAMPLES, len(model.states)))
    for first in range(0, SAMPLES, HELD):
        last = min(first + HELD, SAMPLES - 1)
        u = held[:, first]
        found = solve_ivp(
            lambda _, x, u=u: model.rates(x, u),
            (times[first], times[last]),
            states[first],
            t_eval=times[first : last + 1],
            rtol=1e-8,
            atol=1e-9,
        )
        states[first : last + 1] = found.y.T
    inputs = tuple(ce.Input(name, times, values, "hold") for name, values in given.items())
    return inputs, states[:, [model.states.index(name) for name in model.outputs]]


def make_problem(model: LargeModel, archive: bytes) -> ce.Problem:
    """The declared model with noisy data, its parameters some way off."""
    solver = ce.Solver("dormand_prince", rtol=1e-6, atol=1e-8)
    fmu = ce.Model(model.name, archive, "model_exchange", solver, tuple(model.parameters))
    parameters = tuple(
        ce.Parameter(name, 1.15 * value, 0.1 * value, 10.0 * value)
        for name, value in model.parameters.items()
    )
    runs = [simulate(model, number) for number in range(len(ROLES))]
    sigmas = NOISE * np.std([curves for _, curves in runs], axis=(0, 1))
    experiments = []
    for number, ((inputs, curves), role) in enumerate(zip(runs, ROLES, strict=True)):
        noise = np.random.default_rng([18, number]).standard_normal(curves.shape)
        noisy = (curves + sigmas * noise).T
        outputs = tuple(
            ce.Output(f"y_{name}", model.times, values, float(sigma))
            for name, values, sigma in zip(model.outputs, noisy, sigmas, strict=True)
        )
        stop = float(model.times[-1])
        experiments.append(ce.Experiment(f"e{number}", 0.0, stop, inputs, outputs, role=role))
    return ce.Problem(fmu, parameters, tuple(experiments))
