"""Speed of the simulation kernels, as ratios of medians of interleaved runs in one process.

The compiled loops beside the same loops in C (built here with the system's compiler), and beside
`fmpy.simulate_fmu` on a reused instance; `rounds` of each.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import sys
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
from workers.fmu.archive import unpack
from workers.fmu.description import describe
from workers.messages import Experiment, Input, Model, Output, Solver
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

FUNCTIONS = (
    "handle", "reset", "setup_experiment", "enter_initialization_mode", "exit_initialization_mode",
    "set_real", "get_real", "set_time", "set_continuous_states", "get_continuous_states",
    "get_derivatives", "update_discrete_states", "enter_continuous_time_mode",
    "completed_integrator_step", "do_step", "set_real_input_derivatives",
)  # fmt: skip


class CFmu(ctypes.Structure):
    """An instance and its functions as the C loops see them."""

    _fields_ = [(name, ctypes.c_void_p) for name in FUNCTIONS]


def rows(options: argparse.Namespace) -> Iterator[Row]:
    """A row for each solver and reference."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loops = compiled_loops(folder)
        yield beside_c("co_simulation", "fmu", loops.co_simulate, options.rounds)
        yield beside_c("model_exchange", "rk4", loops.rk4, options.rounds)
        yield beside_c("model_exchange", "dormand_prince", None, options.rounds)
        yield driven_beside_fmpy(max(3, options.rounds // 10))
        few = max(3, options.rounds // 3)
        ball, oscillator = (build(n, 2, folder) for n in ("bouncing_ball", "van_der_pol"))
        for solver in ("dormand_prince", "cvode"):
            how = Solver(solver, rtol=1e-6)
            yield from free_beside_fmpy("events", ball, how, {"h": 1.0}, ("height", 3.0), few)
        stiff = Solver("cvode", rtol=1e-6)
        yield from free_beside_fmpy("stiff", oscillator, stiff, {"mu": 1e3}, ("y", 2000.0), few)


def compiled_loops(folder: Path) -> ctypes.CDLL:
    library = folder / "loops.so"
    source = Path(__file__).with_name("loops.c")
    command = ["gcc", "-O2", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def simulator(fmu: Path, model: Model, run: Experiment) -> Simulator:
    made = Simulator(model, describe(fmu.name, model.archive), (run,))
    made.load()
    return made


def driven_model(interface: str, solver: str) -> Model:
    return Model(FMU.name, FMU.read_bytes(), interface, Solver(solver), tuple(VALUES))  # type: ignore[arg-type]


def beside_c(interface: str, solver: str, c_loop: Callable[..., int] | None, rounds: int) -> Row:
    """The kernel, and where given the same loop in C on an instance of its own."""
    model = driven_model(interface, solver)
    ours, theirs = simulator(FMU, model, DRIVEN), simulator(FMU, model, DRIVEN)
    runs: dict[str, Callable[[], object]] = {"kernel": lambda: ours.run(0, POINTS)}
    outputs = np.zeros(COUNT)
    if c_loop is not None:
        runs["C"] = in_c(theirs, c_loop, outputs)
    medians = by_turns(runs, rounds)
    row: Row = {"what": f"{interface}, {solver}", "kernel us": medians["kernel"] * 1e6 / BATCH}
    if c_loop is not None:
        difference = np.abs(ours.run(0, POINTS).outputs[0, :, 0] - outputs).max()
        row |= {"C us": medians["C"] * 1e6 / BATCH, "kernel / C": medians["kernel"] / medians["C"],
                "largest difference": float(difference)}  # fmt: skip
    return row


def in_c(made: Simulator, c_loop: Callable[..., int], outputs: np.ndarray) -> Callable[[], None]:
    """A batch of simulations by a loop in C, which writes the outputs."""
    addresses = made.instance.component._asdict()
    fmu = CFmu(*[addresses[name] for name in FUNCTIONS])
    ready, states, values = made.bound_experiment(0), 2, POINTS[0].copy()

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    def run() -> None:
        for _ in range(BATCH):
            status = c_loop(
                ctypes.byref(fmu),
                pointer(ready.starts.numbers.reals),
                ctypes.c_size_t(len(values)),
                pointer(values),
                ctypes.c_uint32(int(ready.references.inputs.reals[0])),
                ctypes.c_uint32(int(ready.references.outputs.reals[0])),
                pointer(TIMES),
                pointer(FORCE),
                ctypes.c_size_t(COUNT),
                pointer(outputs),
                ctypes.c_size_t(states),
            )
            if status >= 2:
                sys.exit(f"the loop in C failed with status {status}")

    return run


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
    """A kernel and fmpy by turns."""
    medians = by_turns({"kernel": partial(ours.run, 0, points), "fmpy": theirs}, rounds)
    kernel = medians["kernel"] / BATCH
    return {"what": label, "kernel us": kernel * 1e6, "fmpy ms": medians["fmpy"] * 1e3,
            "fmpy / kernel": medians["fmpy"] / kernel}  # fmt: skip
