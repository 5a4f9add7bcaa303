"""An experiment made ready for one model: its grid, and the FMU's references for its variables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.access import access
from workers.description import Description
from workers.errors import ModelError
from workers.grid import Grid, build_grid
from workers.kernels.component import References, Starts
from workers.messages import Experiment, FloatArray, Input, IntArray, Model
from workers.variables import Variable


@dataclass(frozen=True)
class Installed:
    """An experiment made ready for one model."""

    grid: Grid
    outputs: tuple[str, ...]
    starts: Starts
    references: References
    known: FloatArray
    held: IntArray
    """The memory that strings stand in."""


def install(
    model: Model,
    description: Description,
    experiment: Experiment,
    recorded: tuple[str, ...] | None = None,
) -> Installed:
    """Lay an experiment on its grid and look up the FMU's references for it.

    `recorded` are the variables to record; the experiment's own if None.

    Raises
    ------
    ModelError
        If the FMU has no such variable, or it is of the wrong kind.
    """
    where = f"experiment {experiment.id!r}"
    given = {n: v for n, v in experiment.values if n not in model.parameters}
    chosen = {n: description.variable(n, where) for n in given}
    texts = {n: str(given[n]) for n, v in chosen.items() if v.kind == "string"}
    structure = [v for v in chosen.values() if v.causality == "structuralParameter"]
    known = [v for n, v in chosen.items() if n not in texts and v not in structure]
    outputs = recorded or experiment.recorded
    experiment = replace(
        experiment, inputs=tuple(_held(description, each) for each in experiment.inputs)
    )
    grid = build_grid(experiment, outputs)
    if model.interface == "co_simulation" and not description.variable_steps:
        _check_equal_steps(model, description, grid, where)

    def bases(variable: Variable) -> list[float]:
        own = (variable.reference, variable.type)
        found = [v for v in description.variables.values() if (v.reference, v.type) == own]
        starts = {v.element: v.start or 0.0 for v in found}
        return [starts.get(e, 0.0) for e in range(variable.size)]

    def at(names: Sequence[str]) -> list[Variable]:
        return [description.variable(n, where) for n in names]

    inputs = at([each.variable for each in experiment.inputs])
    moving = [v if v.moves else None for v in inputs]
    first = len(model.parameters) + len(known)
    return Installed(
        grid=grid,
        outputs=outputs,
        starts=Starts(
            structure=access([*[None] * first, *structure], bases),
            numbers=access([*at(model.parameters), *known], bases),
            strings=np.array([chosen[n].reference for n in texts], np.uint32),
            texts=(held := _texts(list(texts.values())))[0],
        ),
        references=References(
            inputs=access(inputs, bases),
            moving=access(moving, bases),
            outputs=access(at(outputs), bases),
        ),
        known=np.array([float(given[v.name]) for v in [*known, *structure]], np.float64),
        held=held[1],
    )


def _held(description: Description, given: Input) -> Input:
    """An input whose variable changes at events alone cannot be in between two samples."""
    variable = description.variables.get(given.variable)
    if variable is None or variable.moves:
        return given
    return replace(given, interpolation="hold")


def _texts(texts: Sequence[str]) -> tuple[IntArray, IntArray]:
    """Addresses of strings that end with a zero byte, and the memory that holds them."""
    encoded = [text.encode() + b"\0" for text in texts]
    memory = np.frombuffer(bytearray(b"".join(encoded)) or bytearray(1), np.uint8)
    begins = np.cumsum([0, *(len(each) for each in encoded)], dtype=np.int64)[:-1]
    return begins + memory.ctypes.data, memory


def _check_equal_steps(model: Model, description: Description, grid: Grid, where: str) -> None:
    """Refuse a grid that an FMU with a fixed communication step cannot stand on.

    The loops cut each interval of the grid into equal steps of at most `Solver.step`; here they
    must all come out the same.
    """
    intervals = np.diff(grid.times)
    step = model.solver.step or float(intervals.min())
    steps = intervals / step
    if np.abs(steps - np.round(steps)).max() > 1e-6 or steps.min() < 0.5:
        usual = description.default_step
        advice = f" (its own default is {usual:g} s)" if usual else ""
        raise ModelError(
            f"{where}: {description.file} needs one communication step of fixed length, but the "
            f"times of inputs and measurements are {intervals.min():g} to {intervals.max():g} s "
            f"apart and no multiples of {step:g} s; set model.step to a divisor of them all"
            f"{advice}, or resample the data"
        )
