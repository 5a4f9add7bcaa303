"""Tasks of workers with their limits, and the outcomes that they return."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from workers.messages.model import Effect
from workers.messages.types import FloatArray, IntArray, Want, by_content


@by_content
@dataclass(frozen=True, slots=True)
class Task:
    """One point and one experiment: the unit of distribution.

    Attributes
    ----------
    id
        Chosen by the coordinator; the outcome repeats it.
    experiment
        Index of the experiment among those that the worker has.
    values
        Physical values of `Model.parameters`, then of the coefficients of each effect.
    want
        "residuals"; "squares" or "absolutes" for one number in place of those of each output (not
        with a cost function), see `REDUCTIONS`; "trajectory" for the outputs at every time of the
        simulation's grid too; "linearisation" for the model's derivatives there (model exchange
        only); or "sensitivities" for the derivatives of the residuals by the parameters, where the
        model can give them.
    effects
        What is added to the model.
    bound
        Sum of squared residuals above which nobody needs to know more: the simulation may end as
        soon as its sum so far is above it, with `Status.ENDED_EARLY`. It does where all residuals
        are those of plain outputs and no effects act; elsewhere it goes to its end.
    """

    id: int
    experiment: int
    values: FloatArray
    want: Want = "residuals"
    effects: tuple[Effect, ...] = ()
    bound: float = math.inf


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits beyond which a simulation in a process of its own is ended from outside.

    Attributes
    ----------
    seconds
        Longest that one simulation may take on the wall's clock.
    stall
        Seconds for which it may stand still: no step ends, though the system lets it run, or it
        sleeps. It has to happen twice.
    memory
        Most bytes that the process may have in memory.
    growth
        Bytes by which it may grow over many simulations before it is replaced by a fresh one.
    """

    seconds: float = 600.0
    stall: float = 60.0
    memory: float = float("inf")
    growth: float = 256.0 * 2**20


@by_content
@dataclass(frozen=True, slots=True)
class MatrixSeries:
    """A matrix at each of n times; entries that are 0 at all of them are not kept.

    In a model of many states each acts on few others. `numpy.asarray` gives all entries.

    Attributes
    ----------
    shape
        (n, rows, columns).
    rows, columns : (k,)
        Of the entries that are kept, ascending by row, then by column.
    values : (n, k)
        Of those entries.
    """

    shape: tuple[int, int, int]
    rows: IntArray
    columns: IntArray
    values: FloatArray

    @classmethod
    def of(cls, matrices: FloatArray) -> Self:
        """From all entries, (n, rows, columns)."""
        rows, columns = np.nonzero((matrices != 0.0).any(axis=0))
        n, height, width = matrices.shape
        return cls((n, height, width), rows, columns, matrices[:, rows, columns])

    def at(self, time: int) -> FloatArray:
        """(rows, columns): all entries at one of the times."""
        return self._filled(self.values[time])

    def largest(self) -> FloatArray:
        """(rows, columns): the largest absolute value of each entry."""
        return self._filled(np.abs(self.values).max(axis=0))

    def row(self, row: int) -> FloatArray:
        """(n, columns): one row at all times."""
        found = np.zeros((self.shape[0], self.shape[2]))
        own = self.rows == row
        found[:, self.columns[own]] = self.values[:, own]
        return found

    def _filled(self, values: FloatArray) -> FloatArray:
        found = np.zeros(self.shape[1:])
        found[self.rows, self.columns] = values
        return found

    def __array__(
        self, dtype: npt.DTypeLike | None = None, copy: bool | None = None
    ) -> npt.NDArray[np.float64]:
        """All entries; numpy calls this."""
        if copy is False:
            raise ValueError("entries that are not kept can only be copied")
        found = np.zeros(self.shape)
        found[:, self.rows, self.columns] = self.values
        return found if dtype is None else found.astype(dtype)


class Status(enum.StrEnum):
    """The ending of a task. A member's text is what a person reads."""

    OK = "ok"
    SOLVER_FAILURE = "solver failure"
    NOT_FINITE = "not finite"
    TIMEOUT = "timeout"
    OUT_OF_MEMORY = "out of memory"
    CRASH = "crash"
    LOST_WORKER = "lost worker"
    NOT_RUN = "not run"
    ENDED_EARLY = "ended early"

    @property
    def is_failure(self) -> bool:
        """False where a simulation reached its end, or was ended because its cost was too high."""
        return self not in (Status.OK, Status.ENDED_EARLY)


@by_content
@dataclass(frozen=True, slots=True)
class Trajectory:
    """Simulated outputs, `values[i, j]` being `variables[j]` at `times[i]`."""

    variables: tuple[str, ...]
    times: FloatArray
    values: FloatArray

    def at(self, variable: str, times: FloatArray) -> FloatArray:
        """Return what an output was at times that are among those of the simulation."""
        rows = np.searchsorted(self.times, times)
        return np.asarray(self.values[rows, self.variables.index(variable)])


@by_content
@dataclass(frozen=True, slots=True)
class Linearisation:
    """The model with its effects, linear around one simulation: dx/dt = f(t, x, u, p), y = g(...).

    With it, the response to any small forcing follows from a linear time-varying system, without
    another simulation.

    States are the FMU's, then those of the effects ("EFFECT:STATE"). Inputs are all real inputs of
    the FMU but those that a parameter sets, the experiment's first; the derivatives are by an input
    *as it reaches the FMU*, behind all effects. Parameters are the tunable ones of
    `Model.parameters`; the derivatives are by the value that holds at that time, where an effect
    varies it. The derivatives are central differences, one-sided at a bound that the FMU declares.

    Effects at outputs act on the record afterwards. `outputs` has them; `plain_outputs`, C, D and Q
    do not. What a delay or backlash makes of an input is in `inputs` already. Where effects bring
    times of their own, those between the times of the experiment's grid are left out.

    Attributes
    ----------
    times : (n,)
        The grid.
    states, derivatives : (n, x)
        x and f.
    inputs, effective_inputs : (n, u)
        Inputs before and after the effects.
    outputs, plain_outputs : (n, y)
        With effects at outputs, and without: the experiment's outputs.
    A, B, P : (n, x, x), (n, x, u), (n, x, p)
        df/dx, df/du, df/dp.
    C, D, Q : (n, y, x), (n, y, u), (n, y, p)
        dg/dx, dg/du, dg/dp.
    state_names, input_names, output_names, parameter_names
        What the axes stand for.
    log_spread
        With process noise, where states are those that a Kalman filter has corrected, the sum of
        log(S / sigma^2) over all measured values; see `Experiment`.
    """

    times: FloatArray
    states: FloatArray
    derivatives: FloatArray
    inputs: FloatArray
    effective_inputs: FloatArray
    outputs: FloatArray
    plain_outputs: FloatArray
    A: MatrixSeries
    B: FloatArray
    C: FloatArray
    D: FloatArray
    P: FloatArray
    Q: FloatArray
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    log_spread: float = 0.0


@by_content
@dataclass(frozen=True, slots=True)
class Outcome:
    """The answer to a task.

    Attributes
    ----------
    task
        The id of the task.
    status, message
        Anything but OK, and sensitivities that were not to be had, comes with a sentence that says
        what happened, where and at which time.
    residuals
        (measured - simulated) / sigma, output after output, then those of the curve, or what the
        task wanted in their place; None unless `status` is OK.
    constraints
        In the order of `Experiment.constraint_names`; empty unless `status` is OK.
    trajectory, linearisation
        Only where the task wanted it.
    sensitivities : (residuals + constraints, parameters)
        Derivatives of both by the values of `Model.parameters`, where the task wanted them; NaN in
        the columns of parameters by which there are none. None, with a message that says why, where
        the model cannot give them: the simulation itself may be OK then.
    seconds
        What this simulation cost: its share of the batch that it ran in.
    steps
        Steps of the solver: the same on every machine, however busy; 0 where it is not known.
    worker
        Who ran it.
    """

    task: int
    status: Status
    residuals: FloatArray | None = None
    trajectory: Trajectory | None = None
    message: str = ""
    seconds: float = 0.0
    worker: str = ""
    linearisation: Linearisation | None = None
    constraints: FloatArray = field(default_factory=lambda: np.zeros(0))
    sensitivities: FloatArray | None = None
    steps: int = 0

    @property
    def ok(self) -> bool:
        return self.status is Status.OK

    @property
    def failed(self) -> bool:
        """True unless the status is one that was asked for: OK, or ended early."""
        return self.status.is_failure
