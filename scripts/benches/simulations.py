"""Speed of simulations, as ratios of medians of interleaved runs in one process.

The core beside `fmpy.simulate_fmu` on a reused instance, `rounds` of each, and what Python adds to
a batch of tiny simulations. `scripts/bench_core.py` counts instructions against loops by hand.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Model, FMU2Slave
from fmus.build import build

from benches import Row
from benches.common import MODELS, by_turns
from workers.core.library import Batch
from workers.fmu.archive import unpack
from workers.fmu.description import describe
from workers.messages import Experiment, Input, Model, Output, Solver
from workers.simulation.batch import simulate
from workers.simulation.simulator import Simulator

OPTIONS = {"rounds": 60}
FMU = MODELS / "mass_spring_damper.fmu"
STEP, COUNT = 0.005, 1001
BATCH = 20
TIMES = np.asarray(np.arange(COUNT) * STEP, np.float64)
FORCE = np.random.default_rng(1).normal(size=COUNT)
DRIVEN = Experiment(
    "bench", 0.0, float(TIMES[-1]), (Input("F", TIMES, FORCE),), (Output("y", TIMES, 0 * TIMES),)
)
VALUES = {"m": 1.0, "k": 25.0, "c": 0.8}
POINTS = np.tile(list(VALUES.values()), (BATCH, 1))


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each solver and reference."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for interface, method in (
            ("co_simulation", "fmu"), ("model_exchange", "rk4"),
            ("model_exchange", "dormand_prince"),
        ):  # fmt: skip
            yield alone(interface, method, options.rounds)
        yield tiny(options.rounds)
        yield driven_beside_fmpy(max(3, options.rounds // 10))
        few = max(3, options.rounds // 3)
        ball, oscillator = (build(n, 2, folder) for n in ("bouncing_ball", "van_der_pol"))
        for solver in ("dormand_prince", "cvode"):
            how = Solver(solver, rtol=1e-6)
            yield from free_beside_fmpy("events", ball, how, {"h": 1.0}, ("height", 3.0), few)
        stiff = Solver("cvode", rtol=1e-6)
        yield from free_beside_fmpy("stiff", oscillator, stiff, {"mu": 1e3}, ("y", 2000.0), few)


def simulator(fmu: Path, model: Model, run: Experiment) -> Simulator:
    made = Simulator(model, describe(fmu.name, model.archive), (run,))
    made.load()
    return made


def driven_model(interface: str, solver: str) -> Model:
    return Model(FMU.name, FMU.read_bytes(), interface, Solver(solver), tuple(VALUES))  # type: ignore[arg-type]


def alone(interface: str, solver: str, rounds: int) -> Row:
    """A solver by itself."""
    made = simulator(FMU, driven_model(interface, solver), DRIVEN)
    medians = by_turns({"core": partial(made.run, 0, POINTS)}, rounds)
    return {"what": f"{interface}, {solver}", "core us": medians["core"] * 1e6 / BATCH}


def tiny(rounds: int) -> Row:
    """Five simulations of two times: the core alone, and all that Python adds."""
    times = TIMES[:2]
    short = Experiment(
        "tiny", 0.0, STEP, (Input("F", times, FORCE[:2]),), (Output("y", times, 0 * times),)
    )
    made = simulator(FMU, driven_model("co_simulation", "fmu"), short)
    integrator, bound = made._integrator, made.bound_experiment(0)
    made.run(0, POINTS[:5])

    def again(batch: Batch) -> int:
        for _ in range(1000):
            tried = simulate(batch)
        return tried

    def by_the_core() -> None:
        integrator.run(bound, POINTS[:5], loop=again)

    def by_python() -> None:
        for _ in range(1000):
            made.run(0, POINTS[:5])

    medians = by_turns({"core": by_the_core, "Python": by_python}, rounds)
    core, whole = medians["core"] * 1e3, medians["Python"] * 1e3
    return {"what": "a batch of 5 tiny ones", "core us": core, "all us": whole,
            "Python us": whole - core}  # fmt: skip


def fmpy_run(model: Model, kind: str, **options: Any) -> Callable[[], None]:
    """One simulation by `fmpy.simulate_fmu`, with instance and description reused."""
    folder = str(unpack(model.name, model.archive, model.archive_hash))
    description = fmpy.read_model_description(folder)
    exchange = kind == "ModelExchange"
    part = description.modelExchange if exchange else description.coSimulation
    instance = (FMU2Model if exchange else FMU2Slave)(
        guid=description.guid, modelIdentifier=part.modelIdentifier, unzipDirectory=folder
    )
    instance.instantiate()

    def run() -> None:
        instance.reset()
        fmpy.simulate_fmu(
            folder,
            model_description=description,
            fmu_instance=instance,
            fmi_type=kind,
            **options,
        )

    return run


def driven_beside_fmpy(rounds: int) -> Row:
    """Co-simulation with a sampled input."""
    model = driven_model("co_simulation", "fmu")
    ours = simulator(FMU, model, DRIVEN)
    table = np.zeros(COUNT, dtype=[("time", float), ("F", float)])
    table["time"], table["F"] = TIMES, FORCE
    options = {"start_values": VALUES, "input": table, "output": ["y"], "stop_time": TIMES[-1]}
    theirs = fmpy_run(model, "CoSimulation", **options, output_interval=STEP)
    return beside("co_simulation", ours, POINTS, theirs, rounds)


def free_beside_fmpy(
    label: str,
    fmu: Path,
    solver: Solver,
    values: dict[str, float],
    seen: tuple[str, float],
    rounds: int,
) -> Iterator[Row]:
    """Model exchange without inputs, here and as `fmpy.simulate_fmu` does it with its CVode."""
    points, (output, stop) = np.tile(list(values.values()), (BATCH, 1)), seen
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", solver, tuple(values))
    for intervals in (100, 1000):
        times = np.linspace(0.0, stop, intervals + 1)
        run = Experiment("free", 0.0, stop, (), (Output(output, times, 0 * times),))
        ours = simulator(fmu, model, run)
        theirs = fmpy_run(
            model,
            "ModelExchange",
            solver="CVode",
            relative_tolerance=solver.rtol,
            start_values=values,
            output=[output],
            stop_time=stop,
            output_interval=stop / intervals,
        )
        yield beside(f"{label}, {solver.name}, {intervals}", ours, points, theirs, rounds)


def beside(
    label: str, ours: Simulator, points: np.ndarray, theirs: Callable[[], None], rounds: int
) -> Row:
    """The core and fmpy by turns."""
    medians = by_turns({"core": partial(ours.run, 0, points), "fmpy": theirs}, rounds)
    core = medians["core"] / BATCH
    return {"what": label, "core us": core * 1e6, "fmpy ms": medians["fmpy"] * 1e3,
            "fmpy / core": medians["fmpy"] / core}  # fmt: skip
