"""An experiment made ready for one model: its grid, and the FMU's references for its variables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workers.description import Description
from workers.errors import ModelError
from workers.grid import Grid, build_grid
from workers.kernels.fmi2 import Constants, References
from workers.messages import Experiment, FloatArray, IntArray, Model


@dataclass(frozen=True)
class Installed:
    """An experiment made ready for one model."""

    grid: Grid
    outputs: tuple[str, ...]
    references: References
    constants: Constants
    known: FloatArray


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
    known = [(n, v) for n, v in experiment.values if n not in model.parameters]
    reals = [(n, float(v)) for n, v in known if _kind(description, n, where) == "real"]
    integers = [(n, int(v)) for n, v in known if _kind(description, n, where) == "integer"]
    booleans = [(n, int(bool(v))) for n, v in known if _kind(description, n, where) == "boolean"]
    outputs = recorded or experiment.recorded
    grid = build_grid(experiment, outputs)
    if model.interface == "co_simulation" and not description.variable_steps:
        _check_equal_steps(model, description, grid, where)

    def references(names: list[str]) -> IntArray:
        return np.array([description.variable(n, where).reference for n in names], np.uint32)

    return Installed(
        grid=grid,
        outputs=outputs,
        references=References(
            start_reals=references([*model.parameters, *(n for n, _ in reals)]),
            start_integers=references([n for n, _ in integers]),
            start_booleans=references([n for n, _ in booleans]),
            inputs=references([given.variable for given in experiment.inputs]),
            outputs=references(list(outputs)),
        ),
        constants=Constants(
            integers=np.array([v for _, v in integers], np.int32),
            booleans=np.array([v for _, v in booleans], np.int32),
        ),
        known=np.array([v for _, v in reals], np.float64),
    )


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


def _kind(description: Description, name: str, where: str) -> str:
    kind = description.variable(name, where).kind
    if kind == "string":
        raise ModelError(
            f"{where}: {name!r} is a string variable of {description.file}, which cannot be set "
            "yet; choose its value when exporting the FMU"
        )
    return kind
