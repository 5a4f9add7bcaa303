"""What the screening of a closed loop costs on models of 2, 50 and 200 states: seconds and memory.

A mass on a spring, an electric ladder network (50 states) and a building of 100 rooms (200), each
of which lacks one effect; each with five training experiments of 1,000 samples and one held out.
The data are simulations with the effect, and noise. Each model (`only`) has a process of its own. A
row has what the screening of the declared model's residual took, the peak of the memory up to then,
and what came first beside what is missing.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import cluster_est as ce
from benches import Row
from benches.common import WrittenModel
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.screening.screen import screen
from cluster_est.closed_loop.selection.starts import fit_declared
from cluster_est.closed_loop.workbench import LoopRequest, open_workbench

SAMPLES, NOISE, RECORDS = 1000, 0.01, 6
HELD = 25
"""Samples for which an input is held."""


@dataclass(frozen=True)
class LargeModel:
    """A model, the range of each of its inputs, and what it lacks.

    Attributes
    ----------
    site, form, strength
        The effect that is missing, and its coefficient.
    """

    written: WrittenModel
    ranges: dict[str, tuple[float, float]]
    site: str
    form: str
    strength: float


def spring() -> LargeModel:
    """A mass on a spring that lacks a drag."""
    equations = ("der_x = M(v)", "der_v = M(F) - M(k) * M(x) - M(c) * M(v)")
    given = {"k": 4.0, "c": 0.4}
    model = WrittenModel("spring", given, ("F",), ("x", "v"), ("x",), equations, 49.95, 0.05, 0.1)
    return LargeModel(model, {"F": (-4.0, 4.0)}, "der(v)", "quadratic", 0.3)


def ladder() -> LargeModel:
    """Sections of a coil and a capacitor each; the 13th capacitor lacks a leak that is cubic."""
    count = 25
    coils, capacitors = [], []
    for j in range(1, count + 1):
        before = "source" if j == 1 else f"u{j - 1}"
        after = f"M(i{j + 1})" if j < count else f"M(u{j}) / M(load)"
        coils.append(f"der_i{j} = (M({before}) - M(u{j}) - M(R) * M(i{j})) / M(L)")
        capacitors.append(f"der_u{j} = (M(i{j}) - {after}) / M(C)")
    states = [f"{kind}{j}" for kind in "iu" for j in range(1, count + 1)]
    given = {"R": 0.05, "L": 0.8, "C": 0.8, "load": 1.2}
    shown, equations = ("u5", "u13", "u20", "u25"), (*coils, *capacitors)
    model = WrittenModel("ladder", given, ("source",), states, shown, equations, 99.9, 0.1, 0.1)
    return LargeModel(model, {"source": (-2.0, 2.0)}, "der(u13)", "cubic", 0.15)


def building() -> LargeModel:
    """A hundred rooms, each with its walls, in four heated zones; one lacks a loss."""
    side = 10
    rooms = range(side * side)
    airs, walls = [], []
    for n in rooms:
        row, column = divmod(n, side)
        beside = [n - 1] * (column > 0) + [n + 1] * (column < side - 1)
        beside += [n - side] * (row > 0) + [n + side] * (row < side - 1)
        zone = 2 * (row >= side // 2) + (column >= side // 2)
        flow = " + ".join(f"M(T{r}) - M(T{n})" for r in beside)
        airs.append(
            f"der_T{n} = M(between) * ({flow}) + M(inner) * (M(W{n}) - M(T{n})) + "
            f"{4 - len(beside)}.0 * M(window) * (M(Tout) - M(T{n})) + M(zone{zone})"
        )
        walls.append(f"der_W{n} = M(store) * (M(T{n}) - M(W{n})) + M(outer) * (M(Tout) - M(W{n}))")
    states = [f"{kind}{n}" for kind in "TW" for n in rooms]
    given = {"between": 0.25, "inner": 0.5, "window": 0.1, "store": 0.1, "outer": 0.02}
    ranges = {"Tout": (-8.0, 8.0), **{f"zone{z}": (0.0, 2.0) for z in range(4)}}
    shown, equations = [f"T{n}" for n in rooms[::11]], (*airs, *walls)
    model = WrittenModel("building", given, [*ranges], states, shown, equations, 99.9, 0.1, 0.1)
    return LargeModel(model, ranges, "der(T44)", "quadratic", 0.02)


MODELS = {"spring": spring, "ladder": ladder, "building": building}
OPTIONS = {"only": list(MODELS)}


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each model."""
    context = multiprocessing.get_context("spawn")
    for name in options.only:
        with context.Pool(1) as pool:
            yield pool.apply(screened, (name,))


def screened(name: str) -> Row:
    """Screen one model."""
    model = MODELS[name]()
    with open_workbench(LoopRequest(made_problem(model))) as bench:
        fitted = fit_declared(
            bench.fitter, FitStart(bench.fitter.problem, {}), bench.settings.starts
        )
        begin = time.perf_counter()
        screening = screen(bench.fitter, bench.settings, fitted, 1)
        seconds = time.perf_counter() - begin
    best = screening.ranking.leaders(screening.ranking.plain, 1)[0]
    first = screening.ranking.trials[best].candidate
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"model": name, "states": len(model.written.states), "candidates": screening.count,
            "seconds": seconds, "peak MB": peak, "first": f"{first.form.name} at {first.site}",
            "missing": f"{model.form} at {model.site}"}  # fmt: skip


def made_problem(model: LargeModel) -> ce.Problem:
    """The declared model with noisy data, its parameters some way off."""
    written = model.written
    times = np.asarray(written.step * np.arange(SAMPLES), np.float64)
    with tempfile.TemporaryDirectory() as folder:
        archive = written.build(Path(folder)).read_bytes()
    solver = ce.Solver("dormand_prince", rtol=1e-6, atol=1e-8)
    names = tuple(written.parameters)
    fmu = ce.Model(written.name, archive, "model_exchange", solver, names)
    blank = tuple(ce.Output(f"y_{name}", times, np.zeros(SAMPLES)) for name in written.outputs)
    runs = []
    for number in range(RECORDS):
        random = np.random.default_rng([17, number])
        inputs = tuple(
            ce.Input(name, times, np.repeat(random.uniform(*ends, SAMPLES // HELD), HELD), "hold")
            for name, ends in model.ranges.items()
        )
        role = "train" if number < RECORDS - 1 else "test"
        stop = float(times[-1])
        runs.append(ce.Experiment(f"e{number}", 0.0, stop, inputs, blank, role=role))  # type: ignore[arg-type]
    true = [ce.Parameter(name, value) for name, value in written.parameters.items()]
    true.append(ce.Parameter("more.k", model.strength))
    effects = (ce.Effect("more", model.site, model.form),)
    curves = [
        [each.outcome.trajectory.at(f"y_{name}", times) for name in written.outputs]  # type: ignore[union-attr]
        for each in ce.simulate(ce.Problem(fmu, tuple(true), tuple(runs), effects=effects)).values()
    ]
    sigmas = NOISE * np.std(curves, axis=(0, 2))
    experiments = []
    for number, (run, curve) in enumerate(zip(runs, curves, strict=True)):
        noise = np.random.default_rng([18, number]).standard_normal((len(blank), SAMPLES))
        outputs = tuple(
            replace(output, values=values + sigma * own, sigma=float(sigma))
            for output, values, sigma, own in zip(blank, curve, sigmas, noise, strict=True)
        )
        experiments.append(replace(run, outputs=outputs))
    parameters = tuple(
        ce.Parameter(name, 1.15 * value, (0.1 * value, 10.0 * value))
        for name, value in written.parameters.items()
    )
    return ce.Problem(fmu, parameters, tuple(experiments))
