"""Tasks of workers with their limits, and the outcomes that workers return."""

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
        Index of the experiment among those of the worker.
    values
        Physical values of `Model.parameters`, then of the coefficients of each effect.
    want
        "residuals"; "squares" or "absolutes" for one number instead of the residuals of each output
        (not with a cost function), see `REDUCTIONS`; "trajectory" for also the outputs at every
        time of the simulation's grid; "linearisation" for also the model's derivatives there (model
        exchange only); or "sensitivities" for also the derivatives of the residuals by the
        parameters, if the model provides them.
    effects
        Effects that are added to the model.
    bound
        Sum of squared residuals above which the result is not needed. As soon as the sum so far
        exceeds it, the simulation may end with `Status.ENDED_EARLY`. It does so if all outputs are
        plain and no effects act; otherwise it continues to its end.
    step_limit
        Number of solver steps after which the simulation fails; 0 for no limit. It applies to
        solvers that choose their steps ("dormand_prince", "cvode"), to simulations without process
        noise, and not if a linearisation or sensitivities are wanted.
    """

    id: int
    experiment: int
    values: FloatArray
    want: Want = "residuals"
    effects: tuple[Effect, ...] = ()
    bound: float = math.inf
    step_limit: int = 0


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits beyond which a simulation in a separate process is stopped.

    Attributes
    ----------
    seconds
        Longest wall-clock time of one simulation.
    stall
        Longest time in seconds without progress: no step ends, although the process runs or sleeps.
        A simulation fails if it happens twice.
    memory
        Most bytes that the process may have in memory.
    growth
        Bytes by which it may grow over many simulations before it is replaced by a new process.
    """

    seconds: float = 600.0
    stall: float = 60.0
    memory: float = float("inf")
    growth: float = 256.0 * 2**20


@by_content
@dataclass(frozen=True, slots=True)
class MatrixSeries:
    """A matrix at each of n times, without the entries that are 0 at all times.

    In a model with many states, each state acts on few others. `numpy.asarray` returns all entries.

    Attributes
    ----------
    shape
        (n, rows, columns).
    rows, columns : (k,)
        Indices of the stored entries, ascending by row, then by column.
    values : (n, k)
        Values of these entries.
    """

    shape: tuple[int, int, int]
    rows: IntArray
    columns: IntArray
    values: FloatArray

    @classmethod
    def of(cls, matrices: FloatArray) -> Self:
        """Create a series from all entries, (n, rows, columns)."""
        rows, columns = np.nonzero((matrices != 0.0).any(axis=0))
        n, height, width = matrices.shape
        return cls((n, height, width), rows, columns, matrices[:, rows, columns])

    def at(self, time: int) -> FloatArray:
        """Return all entries at one of the times, (rows, columns)."""
        return self._filled(self.values[time])

    def largest(self) -> FloatArray:
        """Return the largest absolute value of each entry, (rows, columns)."""
        return self._filled(np.abs(self.values).max(axis=0))

    def row(self, row: int) -> FloatArray:
        """Return one row at all times, (n, columns)."""
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
        """Return all entries; NumPy calls this."""
        if copy is False:
            raise ValueError("entries that are not kept can only be copied")
        found = np.zeros(self.shape)
        found[:, self.rows, self.columns] = self.values
        return found if dtype is None else found.astype(dtype)


class Status(enum.StrEnum):
    """The result of a task. The text of a member is shown to users."""

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
        """False if a simulation reached its end, or was ended because its cost was too high."""
        return self not in (Status.OK, Status.ENDED_EARLY)


@by_content
@dataclass(frozen=True, slots=True)
class Trajectory:
    """Simulated outputs; `values[i, j]` is `variables[j]` at `times[i]`."""

    variables: tuple[str, ...]
    times: FloatArray
    values: FloatArray

    def at(self, variable: str, times: FloatArray) -> FloatArray:
        """Return an output at times that are times of the simulation."""
        rows = np.searchsorted(self.times, times)
        return np.asarray(self.values[rows, self.variables.index(variable)])


@by_content
@dataclass(frozen=True, slots=True)
class Linearisation:
    """The model with its effects, linearised along a simulation: dx/dt = f(t, x, u, p), y = g(...).

    With it, the response to any small disturbance follows from a linear time-varying system,
    without another simulation.

    States are those of the FMU, then those of the effects ("EFFECT:STATE"). Inputs are all real
    inputs of the FMU that are not parameters, first those of the experiment. The derivatives are
    with respect to an input *as it reaches the FMU*, after all effects. Parameters are the tunable
    ones of `Model.parameters`. The derivatives are with respect to the current value, which an
    effect may vary. The derivatives are central differences, or one-sided at a bound that the FMU
    declares.

    Effects at outputs are applied to the recorded outputs. `outputs` includes them;
    `plain_outputs`, C, D and Q do not. `inputs` already includes a delay or backlash of an input.
    If effects add times, the times between those of the experiment's grid are omitted.

    Attributes
    ----------
    times : (n,)
        The grid.
    states, derivatives : (n, x)
        x and f.
    inputs, effective_inputs : (n, u)
        Inputs before and after the effects.
    outputs, plain_outputs : (n, y)
        The experiment's outputs with effects at outputs, and without.
    A, B, P : (n, x, x), (n, x, u), (n, x, p)
        df/dx, df/du, df/dp.
    C, D, Q : (n, y, x), (n, y, u), (n, y, p)
        dg/dx, dg/du, dg/dp.
    state_names, input_names, output_names, parameter_names
        Names along the axes.
    log_spread
        With process noise, the states are those that a Kalman filter has corrected. This is the sum
        of log(S / sigma^2) over all measured values; see `Experiment`.
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
        If the status is not OK, or if sensitivities are not available, the message says what
        happened, where and at which time.
    residuals
        (measured - simulated) / sigma, output after output, then those of the curve; or the values
        that the task requested instead. None unless `status` is OK.
    constraints
        In the order of `Experiment.constraint_names`; empty unless `status` is OK.
    trajectory, linearisation
        Only if the task requested them.
    sensitivities : (residuals + constraints, parameters)
        Derivatives of both by the values of `Model.parameters`, if the task requested them. A
        column is NaN if its parameter has no derivatives. None, with a message, if the model does
        not provide them; the simulation itself may be OK.
    seconds
        Time of this simulation: its share of the time of the batch.
    steps
        Steps of the solver, which are the same on every machine; 0 if unknown.
    worker
        Name of the worker.
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
        """Whether the status is neither OK nor ended early."""
        return self.status.is_failure
