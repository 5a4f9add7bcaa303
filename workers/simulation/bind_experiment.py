"""An experiment bound to a model: its grid, and the FMU's references of its variables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import c_char_p
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from workers.core import library
from workers.core.library import TYPES, Variables
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.grid import SignalGrid, build_grid
from workers.messages import Experiment, FloatArray, Model
from workers.simulation.fixed_step import CommunicationPoints, communication_points, step_lengths

_TYPES_READ_AS = {"Enumeration": "Int64"}
"""Types that are read and written with the functions of another type."""


def variable_access(
    variables: Sequence[ModelVariable | None],
    array_starts: Callable[[ModelVariable], Sequence[float]],
) -> Variables:
    """Assign the columns of a row of numbers to variables of the FMU.

    Parameters
    ----------
    variables
        Variables of the columns; None for a column that is not passed to the FMU.
    array_starts
        Returns start values of all elements of an array, for elements without a column.
    """
    n_reals = 0
    for variable in variables:
        if variable is None or variable.type != "Float64" or variable.size > 1:
            break
        n_reals += 1
    others: list[_ArrayAccess] = []
    for column, variable in enumerate(variables[n_reals:], n_reals):
        if variable is not None:
            _assign_column(variable, column, others)
    elements = [
        (each.code, each.variable.reference, len(each.columns), column, int(bits))
        for each in others
        for column, bits in zip(
            each.columns,
            np.array(array_starts(each.variable), np.float64).view(np.int64),
            strict=True,
        )
    ]
    references = [v.reference for v in variables[:n_reals] if v is not None]
    return (
        Variables(n_reals=n_reals, n_elements=len(elements))
        .hold(np.uint32, reals=references)
        .hold(np.int64, elements=elements)
    )


@dataclass(frozen=True)
class _ArrayAccess:
    """A variable that is accessed by a separate call, and the column of each element, or -1."""

    code: int
    variable: ModelVariable
    columns: list[int]


def _assign_column(variable: ModelVariable, column: int, others: list[_ArrayAccess]) -> None:
    """Assign a column to an element of a variable; an alias has its own call."""
    code = TYPES.index(_TYPES_READ_AS.get(variable.type, variable.type))
    for each in others:
        same = each.code == code and each.variable.reference == variable.reference
        if same and each.columns[variable.element] < 0:
            each.columns[variable.element] = column
            return
    columns = [-1] * variable.size
    columns[variable.element] = column
    others.append(_ArrayAccess(code, variable, columns))


@dataclass(frozen=True)
class BoundExperiment:
    """An experiment bound to a model.

    Attributes
    ----------
    communication
        The FMU's communication points, if it cannot communicate at all times of the grid.
    known_values
        Known start values, which follow the values of the parameters.
    structure
        The experiment as a structure of the core.
    """

    grid: SignalGrid
    communication: CommunicationPoints | None
    outputs: tuple[str, ...]
    known_values: FloatArray
    structure: library.Experiment

    def start_alone(self) -> BoundExperiment:
        """Return the experiment up to its start; `self` must exist while it is simulated."""
        structure = library.Experiment.from_buffer_copy(self.structure)
        structure.n_times = 1
        start = self.grid._replace(times=self.grid.times[:1])
        return replace(self, grid=start, communication=None, structure=structure)


def bind_experiment(
    model: Model,
    description: ModelDescription,
    experiment: Experiment,
    recorded: tuple[str, ...] | None = None,
    *,
    passing: bool = True,
    seen: tuple[str, ...] = (),
) -> BoundExperiment:
    """Bind an experiment to a model: its grid, and the FMU's references of its variables.

    `recorded` are the variables to record; None for those of the experiment. Steps stop at all
    measured times unless `passing`. `seen` are signals whose values are read from the FMU.

    Raises
    ------
    ModelError
        If the FMU has no such variable, or it is of the wrong kind, or cannot communicate at the
        experiment's times.
    """
    where = f"experiment {experiment.id!r}"
    outputs = recorded or experiment.recorded
    experiment = replace(
        experiment,
        inputs=tuple(  # a variable that changes only at events is held between its samples
            replace(each, interpolation="hold") if description.holds(each.variable) else each
            for each in experiment.inputs
        ),
    )
    grid = build_grid(experiment, outputs)
    if not passing:
        grid = grid._replace(passed=np.zeros_like(grid.passed))
    if model.interface == "co_simulation":
        own_step = description.fixed_internal_step or description.default_step
        grid = grid._replace(intervals=step_lengths(grid.times, own_step))
    communication = communication_points(model, description, experiment, outputs, grid.times)
    structure, known_values = _start_values(model, description, experiment)
    array_starts = partial(_array_starts, description)
    inputs = [description.variable(each.variable, where) for each in experiment.inputs]
    structure.hold(
        inputs=variable_access(inputs, array_starts),
        continuous_inputs=variable_access(
            [v if v.is_continuous else None for v in inputs], array_starts
        ),
        outputs=variable_access([description.variable(n, where) for n in outputs], array_starts),
        seen=variable_access(
            [
                description.variable(given.variable, where) if given.variable in seen else None
                for given in (*experiment.inputs, *experiment.signals)
            ],
            array_starts,
        ),
    )
    structure.n_outputs = len(outputs)
    _set_grid(structure, grid if communication is None else communication.grid)
    return BoundExperiment(grid, communication, outputs, known_values, structure)


def _set_grid(structure: library.Experiment, grid: SignalGrid) -> None:
    """Set the times of the steps, the inputs at these times, and the measurements."""
    structure.stop = float(grid.times[-1])
    structure.n_times, structure.n_inputs = grid.inputs.shape
    structure.hold(
        np.float64, times=grid.times, intervals=grid.intervals, values=grid.inputs,
        slopes=grid.slopes, measured=grid.measured, sigmas=grid.sigmas,
    )  # fmt: skip
    structure.hold(np.int64, gather=grid.gather, by_time=grid.by_time, row_ends=grid.row_ends)
    structure.hold(np.uint8, jumps=grid.jumps, passed=grid.passed)


def _start_values(
    model: Model, description: ModelDescription, experiment: Experiment
) -> tuple[library.Experiment, FloatArray]:
    """Return a structure with the values that are set before a simulation, and known values."""
    where = f"experiment {experiment.id!r}"
    given = {n: v for n, v in experiment.values if n not in model.parameters}
    variables = {n: description.variable(n, where) for n in given}
    texts = {n: str(given[n]).encode() for n, v in variables.items() if v.kind == "string"}
    structure = [v for v in variables.values() if v.causality == "structuralParameter"]
    numbers = [v for n, v in variables.items() if n not in texts and v not in structure]
    parameters = [description.variable(n, where) for n in model.parameters]
    array_starts = partial(_array_starts, description)
    behind: list[None] = [None] * (len(parameters) + len(numbers))
    made = library.Experiment(n_strings=len(texts)).hold(
        structure=variable_access([*behind, *structure], array_starts),
        numbers=variable_access([*parameters, *numbers], array_starts),
        texts=(c_char_p * len(texts))(*texts.values()),
    )
    made.hold(np.uint32, strings=[variables[n].reference for n in texts])
    return made, np.array([float(given[v.name]) for v in [*numbers, *structure]], np.float64)


def _array_starts(description: ModelDescription, variable: ModelVariable) -> list[float]:
    """Return the start values of all elements of the array that contains a variable."""
    if variable.size == 1:
        return [variable.start or 0.0]
    own = (variable.reference, variable.type)
    found = [v for v in description.variables.values() if (v.reference, v.type) == own]
    starts = {v.element: v.start or 0.0 for v in found}
    return [starts.get(e, 0.0) for e in range(variable.size)]
