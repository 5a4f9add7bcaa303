"""A case of the benchmark as a problem of cluster_est: what a method may see, and nothing else."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from closed_loop_benchmark.data import Data, Experiment
from closed_loop_benchmark.system import Array, System
from cluster_est import Input, Model, Output, Parameter, Problem, Solver
from workers.messages import Experiment as MeasuredRun

MODELS = Path(__file__).resolve().parents[2] / "configs" / "models"
WIDTH = 4.0
"""A parameter may be so many times as large as its start value, or as small."""


def make_problem(data: Data) -> Problem:
    """Return the problem that a method is given.

    Parameters
    ----------
    data
        The data of a case.

    Returns
    -------
    Problem
        With the FMU, and without any effect.
    """
    system = data.system
    parameters = [_parameter(name, value) for name, value in data.start_parameters.items()]
    parameters += [_start(data, state) for state in system.unknown_starts]
    model = Model(
        name=system.fmu,
        archive=_read(system.fmu),
        interface=system.interface,
        solver=_solver(system),
        parameters=tuple(p.target for p in parameters),
    )
    runs = tuple(_run(data, n) for n in range(len(data.experiments)))
    return Problem(model=model, parameters=tuple(parameters), experiments=runs)


def run_name(number: int, run: Experiment) -> str:
    """What a run is called in the problem."""
    return f"{number + 1} {run.waveform}"


def start_label(state: str, number: int, run: Experiment) -> str:
    """What the unknown initial state of a run is called in an estimate."""
    return f"{state}_start[{run_name(number, run)}]"


@cache
def _read(file: str) -> bytes:
    return (MODELS / file).read_bytes()


def _solver(system: System) -> Solver:
    if system.interface == "co_simulation":
        return Solver("fmu")
    return Solver("dormand_prince", rtol=1e-7)


def _parameter(name: str, start: float) -> Parameter:
    low, high = sorted((start / WIDTH, start * WIDTH))
    return Parameter(name, start, low, high, "log" if start > 0.0 else "linear")


def _start(data: Data, state: str) -> Parameter:
    """Return an unknown initial state: it has one start for all runs, and room for each guess."""
    guesses = np.array([run.starts[state] for run in data.experiments])
    room = 0.5 * np.abs(guesses)
    return Parameter(
        name=f"{state}_start",
        start=float(guesses.mean()),
        lower=float((guesses - room).min()),
        upper=float((guesses + room).max()),
        variable=state,
        per="experiment",
    )


def _run(data: Data, number: int) -> MeasuredRun:
    run, system, times = data.experiments[number], data.system, data.times
    known = {s: v for s, v in run.starts.items() if s not in system.unknown_starts}
    outputs = tuple(
        Output(name, times, np.ascontiguousarray(column), float(sigma))
        for name, column, sigma in zip(system.outputs, run.outputs.T, data.sigma, strict=True)
    )
    return MeasuredRun(
        id=run_name(number, run),
        start=float(times[0]),
        stop=float(times[-1]),
        inputs=_signals(system.inputs, times, run.inputs),
        outputs=outputs,
        values=tuple({**system.constants, **known}.items()),
        role=run.role,
        signals=_signals(system.signals, times, run.signals),
    )


def _signals(names: tuple[str, ...], times: Array, columns: Array) -> tuple[Input, ...]:
    pairs = zip(names, columns.T, strict=True)
    return tuple(Input(name, times, np.ascontiguousarray(column)) for name, column in pairs)
