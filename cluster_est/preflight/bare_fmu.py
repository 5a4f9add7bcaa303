"""An FMU without a config: its own start values, its own experiment."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from cluster_est.errors import ModelError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from workers.fmu.description import ModelDescription, describe
from workers.fmu.variable import ModelVariable
from workers.messages import Experiment, Interface, Model, Output, Solver

MOST_PARAMETERS, MOST_OUTPUTS = 12, 50
TIMES = 101
DEFAULT_STOP = 1.0
"""Seconds, where the FMU names no stop."""


def bare_problem(path: Path) -> Problem:
    """Return a problem to check: all outputs, and the first real parameters as if to be estimated.

    Raises
    ------
    ModelError
        If it cannot be read, or there is nothing to record.
    """
    try:
        archive = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read ({error.strerror}); check the path") from error
    description = describe(path.name, archive)
    interface: Interface = description.interfaces[0]
    exchange = interface == "model_exchange"
    parameters = tuple(_parameter(v) for v in _parameters(description))
    solver = Solver("dormand_prince" if exchange else "fmu")
    model = Model(path.name, archive, interface, solver, tuple(p.name for p in parameters))
    return Problem(model, parameters, (_experiment(description),))


def _parameters(description: ModelDescription) -> list[ModelVariable]:
    found = [
        v
        for v in description.variables.values()
        if v.causality == "parameter" and v.kind == "real" and v.settable and v.start is not None
    ]
    constants = {v.name for v in description.variables.values() if v.variability == "constant"}
    own = [v for v in found if v.alias_of is None and not v.is_tool_setting]
    once = {v.aliases or (v.name,): v for v in reversed(own)}  # the first of several names
    kept = [v for v in own if once[v.aliases or (v.name,)] is v]
    return [v for v in kept if constants.isdisjoint(v.aliases)][:MOST_PARAMETERS]


def _parameter(variable: ModelVariable) -> Parameter:
    return Parameter(variable.name, variable.start or 0.0)


def _experiment(description: ModelDescription) -> Experiment:
    names = dict.fromkeys([*description.outputs, *description.states])
    numbers = [n for n in names if description.variables[n].is_computed]
    numbers = numbers or _moving(description)
    if not numbers:
        raise ModelError(
            f"{description.file}: must have an output, a state or another number that changes, "
            "so that it can be compared, but has none; name what is measured in a config"
        )
    start = description.default_start or 0.0
    stop = description.default_stop
    stop = start + DEFAULT_STOP if stop is None or not stop > start else stop
    times = np.linspace(start, stop, TIMES, dtype=np.float64)
    step = description.default_step
    if not description.variable_steps and step:
        count = max(1, math.floor((stop - start) / step + 1e-9))
        times = np.asarray(start + step * np.arange(1 + count), np.float64)
        stop = float(times[-1])
    nothing = np.zeros(len(times))
    outputs = tuple(Output(name, times, nothing) for name in numbers[:MOST_OUTPUTS])
    return Experiment("default", start, stop, (), outputs)


def _moving(description: ModelDescription) -> list[str]:
    """Return what an FMU computes without calling it an output, and that may change."""
    moves = ("continuous", "discrete")
    own = [v for v in description.variables.values() if v.alias_of is None and v.is_computed]
    return [v.name for v in own if v.variability in moves and not v.is_tool_setting]
