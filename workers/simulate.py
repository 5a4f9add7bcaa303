"""Model and experiment in, outputs at every time of the grid out: many points in one call."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from workers.description import Description
from workers.errors import ModelError
from workers.fmu import Instance
from workers.grid import Grid, build_grid
from workers.kernels import failure
from workers.kernels.co_simulation import co_simulate_batch
from workers.kernels.dormand_prince import dormand_prince_batch
from workers.kernels.fmi2 import Constants, References, workspace
from workers.kernels.initialise import Settings
from workers.kernels.rk4 import rk4_batch
from workers.messages import Experiment, FloatArray, IntArray, Model

BATCHES = {"fmu": co_simulate_batch, "rk4": rk4_batch, "dormand_prince": dormand_prince_batch}

DEFAULT_RTOL = 1e-8
"""Of Dormand-Prince: on sampled inputs its steps are short anyhow, so accuracy costs little."""


@dataclass(frozen=True)
class Installed:
    """An experiment made ready for one model."""

    grid: Grid
    outputs: tuple[str, ...]
    references: References
    constants: Constants
    known: FloatArray


@dataclass(frozen=True)
class Record:
    """What a batch of simulations gave.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty where a simulation reached its end, else a sentence.
    codes : (points,)
        See `workers.kernels.failure`.
    """

    outputs: FloatArray
    messages: list[str]
    codes: IntArray


class Simulator:
    """One instance of an FMU and the experiments that it can be asked to simulate.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    experiments
        What `run` counts by index.

    Raises
    ------
    ModelError
        If the FMU cannot be loaded, or lacks a variable that an experiment or the model names.
    """

    def __init__(
        self, model: Model, description: Description, experiments: tuple[Experiment, ...]
    ) -> None:
        self._installed = [install(model, description, e) for e in experiments]
        self._settings = _settings(model, description)
        self._batch = BATCHES[model.solver.name]
        widths = {len(e.inputs) for e in experiments}
        self._workspaces = {n: workspace(n, len(description.states)) for n in widths}
        self.instance = Instance(model, description)

    def installed(self, experiment: int) -> Installed:
        return self._installed[experiment]

    def run(self, experiment: int, points: FloatArray) -> Record:
        """Simulate one experiment for many points, a row of `points` each."""
        ready = self._installed[experiment]
        known = np.broadcast_to(ready.known, (len(points), len(ready.known)))
        rows = np.hstack([points, known])
        outputs = np.full((len(rows), len(ready.grid.times), len(ready.outputs)), np.nan)
        codes = np.zeros(len(rows), np.int64)
        stopped_at = np.zeros(len(rows))
        messages = [""] * len(rows)
        tried = 0
        while tried < len(rows):
            self.instance.log.clear()
            first, left = tried, slice(tried, None)
            tried += self._call(ready, rows[left], outputs[left], codes[left], stopped_at[left])
            last = tried - 1
            if codes[last] == failure.FINISHED:
                break
            if last > first and self.instance.log:
                tried = last  # again, alone: its neighbours may have said some of this
            else:
                messages[last] = self._explain(int(codes[last]), float(stopped_at[last]))
            if codes[last] >= failure.FATAL:
                self.instance.renew()
        return Record(outputs, messages, codes)

    def close(self) -> None:
        self.instance.free()

    def _call(
        self,
        ready: Installed,
        rows: FloatArray,
        outputs: FloatArray,
        codes: IntArray,
        stopped_at: FloatArray,
    ) -> int:
        tried: int = self._batch(
            self.instance.component,
            ready.references,
            ready.constants,
            self._settings,
            ready.grid,
            rows,
            self._workspaces[ready.grid.inputs.shape[1]],
            outputs,
            codes,
            stopped_at,
        )
        return tried

    def _explain(self, code: int, time: float) -> str:
        said = " | ".join(dict.fromkeys(self.instance.log))
        sentence = f"{failure.SENTENCES[code % failure.FATAL]} at t = {time:.9g} s"
        return f"{sentence}; it said: {said}" if said else sentence


def install(model: Model, description: Description, experiment: Experiment) -> Installed:
    """Lay an experiment on its grid and look up the FMU's references for it.

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
    outputs = tuple(output.variable for output in experiment.outputs)
    grid = build_grid(experiment)
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


def _settings(model: Model, description: Description) -> Settings:
    solver = model.solver
    rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
    atol = rtol if solver.atol is None else solver.atol
    nominals = [description.variables[name].nominal for name in description.states]
    return Settings(
        step=solver.step or 0.0,
        rtol=rtol,
        atols=atol * np.array(nominals, np.float64),
        max_steps=solver.max_steps,
        fmu_tolerance=solver.rtol or 0.0,
    )
