"""Speed of the simulation kernels, as ratios of medians of interleaved runs in one process.

    python scripts/bench_kernels.py [--rounds 60] [--skip-ray]

Compares the compiled loops with the same loops in C (built here with the system's compiler) and
with `fmpy.simulate_fmu` on a reused instance, and two Ray workers with one local core.
"""

from __future__ import annotations

import argparse
import ctypes
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Model, FMU2Slave

from cluster_est.executors import Executor, executor_class
from workers.fmu.archive import unpack
from workers.fmu.description import describe
from workers.messages import Experiment, Input, Model, Output, Solver, Task
from workers.simulation.simulator import Simulator

HERE = Path(__file__).parent
sys.path.append(str(HERE.parent / "tests"))
FMU = HERE.parent / "configs" / "models" / "mass_spring_damper.fmu"
BALL, OSCILLATOR = "bouncing_ball", "van_der_pol"
STEP, COUNT = 0.005, 1001
BATCH = 20
PARAMETERS = ("m", "k", "c")
VALUES = np.array([1.0, 25.0, 0.8])


FUNCTIONS = (
    "handle", "reset", "setup_experiment", "enter_initialization_mode", "exit_initialization_mode",
    "set_real", "get_real", "set_time", "set_continuous_states", "get_continuous_states",
    "get_derivatives", "update_discrete_states", "enter_continuous_time_mode",
    "completed_integrator_step", "do_step", "set_real_input_derivatives",
)  # fmt: skip


class CFmu(ctypes.Structure):
    """An instance and its functions as the C loops see them."""

    _fields_ = [(name, ctypes.c_void_p) for name in FUNCTIONS]


def build_test_fmu(name: str, folder: Path) -> Path:
    """One of the FMUs that the tests are made with."""
    from fmus.build import build as build_own

    return build_own(name, 2, folder)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--rounds", type=int, default=60)
    arguments.add_argument("--skip-ray", action="store_true")
    options = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        loops = compile_loops(Path(folder))
        compare_interface("co_simulation", "fmu", loops.co_simulate, options.rounds)
        compare_interface("model_exchange", "rk4", loops.rk4, options.rounds)
        compare_interface("model_exchange", "dormand_prince", None, options.rounds)
        ball, oscillator = (build_test_fmu(n, Path(folder)) for n in (BALL, OSCILLATOR))
        few = max(3, options.rounds // 3)
        for solver in ("dormand_prince", "cvode"):
            how = Solver(solver, rtol=1e-6)
            compare_exchange("events", ball, how, {"h": 1.0}, "height", 3.0, few)
        stiff = Solver("cvode", rtol=1e-6)
        compare_exchange("stiff", oscillator, stiff, {"mu": 1000.0}, "y", 2000.0, few)
    compare_fmpy(max(3, options.rounds // 10))
    if not options.skip_ray:
        compare_ray(max(3, options.rounds // 10))


def compile_loops(folder: Path) -> ctypes.CDLL:
    library = folder / "loops.so"
    source = HERE / "bench_loops.c"
    command = ["gcc", "-O2", "-shared", "-fPIC", str(source), "-o", str(library)]
    subprocess.run(command, check=True)
    return ctypes.CDLL(str(library))


def signals() -> tuple[np.ndarray, np.ndarray]:
    times = np.arange(COUNT) * STEP
    return times, np.random.default_rng(1).normal(size=COUNT)


def model(interface: str, solver: str) -> Model:
    return Model(FMU.name, FMU.read_bytes(), interface, Solver(solver), PARAMETERS)  # type: ignore[arg-type]


def simulator(interface: str, solver: str) -> Simulator:
    asked = model(interface, solver)
    simulator = Simulator(asked, describe(FMU.name, asked.archive), (experiment(),))
    simulator.load()
    return simulator


def experiment() -> Experiment:
    times, force = signals()
    inputs, outputs = (Input("F", times, force),), (Output("y", times, 0 * times),)
    return Experiment("bench", 0.0, float(times[-1]), inputs, outputs)


def compare_interface(
    interface: str, solver: str, c_loop: Callable[..., int] | None, rounds: int
) -> None:
    """The kernel, and where given the same loop in C on an instance of its own."""
    ours, theirs = simulator(interface, solver), simulator(interface, solver)
    points = np.tile(VALUES, (BATCH, 1))
    runs: dict[str, Callable[[], object]] = {"kernel": lambda: ours.run(0, points)}
    if c_loop is not None:
        c_run, c_outputs = prepare_c(theirs, c_loop)
        runs["C"] = c_run
    medians = interleave(runs, rounds, BATCH)
    line = f"{interface:15s} {solver:15s} kernel {medians['kernel'] * 1e6:8.1f} us"
    if c_loop is not None:
        difference = np.abs(ours.run(0, points).outputs[0, :, 0] - c_outputs).max()
        ratio = medians["kernel"] / medians["C"]
        line += f"   C {medians['C'] * 1e6:8.1f} us   ratio {ratio:5.3f}"
        line += f"   largest difference {difference:.1e}"
    print(line)


def prepare_c(
    simulator: Simulator, c_loop: Callable[..., int]
) -> tuple[Callable[[], None], np.ndarray]:
    component = simulator.instance.component
    addresses = component._asdict()
    fmu = CFmu(*[addresses[name] for name in FUNCTIONS])
    ready = simulator.bound_experiment(0)
    times, force = signals()
    outputs = np.zeros(COUNT)
    states = 2

    def pointer(array: np.ndarray) -> ctypes.c_void_p:
        return ctypes.c_void_p(array.ctypes.data)

    def run() -> None:
        for _ in range(BATCH):
            status = c_loop(
                ctypes.byref(fmu),
                pointer(ready.starts.numbers.reals),
                ctypes.c_size_t(len(VALUES)),
                pointer(VALUES),
                ctypes.c_uint32(int(ready.references.inputs.reals[0])),
                ctypes.c_uint32(int(ready.references.outputs.reals[0])),
                pointer(times),
                pointer(force),
                ctypes.c_size_t(COUNT),
                pointer(outputs),
                ctypes.c_size_t(states),
            )
            if status >= 2:
                sys.exit(f"the loop in C failed with status {status}")

    run()
    return run, outputs


def compare_fmpy(rounds: int) -> None:
    """`fmpy.simulate_fmu` in co-simulation with instance and description reused."""
    ours = simulator("co_simulation", "fmu")
    asked = model("co_simulation", "fmu")
    folder = str(unpack(asked.name, asked.archive, asked.archive_hash))
    description = fmpy.read_model_description(folder)
    instance = FMU2Slave(
        guid=description.guid,
        modelIdentifier=description.coSimulation.modelIdentifier,
        unzipDirectory=folder,
    )
    instance.instantiate()
    times, force = signals()
    table = np.zeros(COUNT, dtype=[("time", float), ("F", float)])
    table["time"], table["F"] = times, force

    def run_fmpy() -> None:
        instance.reset()
        fmpy.simulate_fmu(
            folder,
            model_description=description,
            fmu_instance=instance,
            fmi_type="CoSimulation",
            start_values=dict(zip(PARAMETERS, VALUES, strict=True)),
            input=table,
            output=["y"],
            stop_time=times[-1],
            output_interval=STEP,
        )

    points = np.tile(VALUES, (BATCH, 1))
    medians = interleave({"kernel": lambda: ours.run(0, points)}, rounds, BATCH)
    medians |= interleave({"fmpy": run_fmpy}, rounds, 1)
    print(
        f"co_simulation   one simulation  kernel {medians['kernel'] * 1e6:8.1f} us   "
        f"fmpy.simulate_fmu, instance reused {medians['fmpy'] * 1e3:.2f} ms   "
        f"ratio {medians['fmpy'] / medians['kernel']:.0f}"
    )


def compare_exchange(
    label: str,
    fmu: Path,
    solver: Solver,
    values: dict[str, float],
    output: str,
    stop: float,
    rounds: int,
) -> None:
    """Model exchange without inputs, here and as `fmpy.simulate_fmu` does it with its CVode."""
    names, points = tuple(values), np.tile(list(values.values()), (BATCH, 1))
    asked = Model(fmu.name, fmu.read_bytes(), "model_exchange", solver, names)
    folder = str(unpack(asked.name, asked.archive, asked.archive_hash))
    description = fmpy.read_model_description(folder)
    instance = FMU2Model(
        guid=description.guid,
        modelIdentifier=description.modelExchange.modelIdentifier,
        unzipDirectory=folder,
    )
    instance.instantiate()
    for intervals in (100, 1000):
        times = np.linspace(0.0, stop, intervals + 1)
        run = Experiment("free", 0.0, stop, (), (Output(output, times, 0 * times),))
        ours = Simulator(asked, describe(asked.name, asked.archive), (run,))
        ours.load()

        def run_fmpy(step: float = stop / intervals) -> None:
            instance.reset()
            fmpy.simulate_fmu(
                folder,
                model_description=description,
                fmu_instance=instance,
                fmi_type="ModelExchange",
                solver="CVode",
                relative_tolerance=solver.rtol,
                start_values=values,
                output=[output],
                stop_time=stop,
                output_interval=step,
            )

        seconds: dict[str, list[float]] = {"kernel": [], "fmpy": []}
        for _ in range(rounds):
            measured = interleave({"kernel": partial(ours.run, 0, points)}, 1, BATCH)
            measured |= interleave({"fmpy": run_fmpy}, 1, 1)
            for name, value in measured.items():
                seconds[name].append(value)
        kernel, theirs = (statistics.median(seconds[name]) for name in ("kernel", "fmpy"))
        print(
            f"model_exchange  {solver.name:15s} kernel {kernel * 1e6:8.1f} us   {label}, "
            f"{intervals} intervals: fmpy.simulate_fmu {theirs * 1e3:.2f} ms   "
            f"ratio {theirs / kernel:.0f}"
        )


def compare_ray(rounds: int) -> None:
    """Two Ray workers against one local core, through the executors that a fit uses."""
    for label, step, simulations in (("50 us", STEP, 6000), ("5 ms", STEP / 60.0, 600)):
        asked = replace(model("model_exchange", "rk4"), solver=Solver("rk4", step=step))
        experiments = (experiment(),)
        with (
            executor_class("local").open(asked, experiments, 1, None) as local,
            executor_class("ray").open(asked, experiments, 2, None) as ray_pool,
        ):
            runs = {
                "local": partial(answer, local, simulations),
                "ray": partial(answer, ray_pool, simulations),
            }
            medians = interleave(runs, rounds, simulations)
        print(
            f"{label:>5s} simulation  one local core {1.0 / medians['local']:8.0f}/s   "
            f"two Ray workers {1.0 / medians['ray']:8.0f}/s   "
            f"ratio {medians['local'] / medians['ray']:.2f}"
        )


def answer(executor: Executor, simulations: int) -> None:
    """Have an executor answer as many tasks."""
    executor.submit([Task(i, 0, VALUES) for i in range(simulations)])
    answered = 0
    while answered < simulations:
        answered += len(executor.completed())


def interleave(
    runs: Mapping[str, Callable[[], object]], rounds: int, simulations: int
) -> dict[str, float]:
    """Median seconds a simulation of each run, measured in turns."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.perf_counter()
            run()
            seconds[name].append((time.perf_counter() - begin) / simulations)
    return {name: statistics.median(measured) for name, measured in seconds.items()}


if __name__ == "__main__":
    main()
