"""The protocol between coordinator and worker: frozen, arrays and strings only.

The coordinator installs a `Model` and its `Experiment`s once on every worker and then sends `Task`s
(one point, one experiment). The worker answers each with an `Outcome`, failures included.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[Any]
Interface = Literal["model_exchange", "co_simulation"]
SolverName = Literal["dormand_prince", "rk4", "cvode", "fmu"]
Interpolation = Literal["linear", "hold"]
Role = Literal["train", "test"]
Reduction = Literal["squares", "absolutes"]
Want = Literal["residuals", "squares", "absolutes", "trajectory", "linearisation", "sensitivities"]
Renewal = Literal["auto", "reset", "instance", "process"]
Value = float | int | bool | str

REDUCTIONS: tuple[Reduction, ...] = get_args(Reduction)
"""What takes the place of the residuals r of an output: the root of the sum of r^2, or the sum of
|r|. Of one number, the sum of squares or of absolute values is that of them all."""
USUAL: tuple[Want, ...] = ("residuals", *REDUCTIONS)
"""What searches ask for: the same simulation, of which less or more is sent back."""


@dataclass(frozen=True)
class Solver:
    """How one simulation is integrated.

    Attributes
    ----------
    name
        "dormand_prince", "rk4" or, for stiff models, "cvode" for model exchange; "fmu" for
        co-simulation, where the FMU brings its own.
    step
        Seconds. The step of "rk4", the longest step of "dormand_prince" and "cvode", the longest
        communication step of "fmu". None: one step from each time in the data to the next ("rk4",
        "fmu"), no limit ("dormand_prince", "cvode").
    rtol, atol
        Tolerances of the error of one step; `atol` is in units of each state's nominal value.
        For "fmu", `rtol` is handed to the FMU, None leaves the choice to it.
    max_steps
        Steps after which a simulation counts as failed.
    """

    name: SolverName
    step: float | None = None
    rtol: float | None = None
    atol: float | None = None
    max_steps: int = 1_000_000


@dataclass(frozen=True)
class Effect:
    """A term that the model lacks, around the FMU.

    Attributes
    ----------
    name
        Chosen by the user; its coefficients are called "NAME.COEFFICIENT".
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form
        Name of a form of the library; empty where `equation` says what it is.
    variables
        What the form is a function of: states, inputs and measured signals by name (at outputs
        also outputs), or the difference of two, "v - w".
    equation
        An equation of the user's own, in the FMU's names, `t`, `s` and `coefficients`.
    coefficients
        (name, neutral value) of the own equation's coefficients; the neutral value is None for a
        shape parameter.
    """

    name: str
    site: str
    form: str = ""
    variables: tuple[str, ...] = ()
    equation: str = ""
    coefficients: tuple[tuple[str, float | None], ...] = ()


@dataclass(frozen=True)
class Model:
    """What a worker simulates: an FMU and how to integrate it.

    Attributes
    ----------
    name
        The file's name, for messages.
    archive
        The bytes of the FMU, so that a worker on another machine needs no file.
    interface, solver
        Which of the FMU's interfaces, and how.
    parameters
        Names of the variables that every task's `values` are for, in that order.
    structure
        (name, value) of structural parameters (FMI 3) that differ from their start values: they
        say how large arrays are, so they are the same in all experiments.
    talks
        Whether the FMU logs all that it can, and its messages go to stderr too as they come.
    renew
        What every simulation begins with: a "reset" of the instance that there is; a new
        "instance", for FMUs whose reset leaves something behind; or a new "process", for those
        whose library does. "auto" leaves the choice to the coordinator; a worker resets.
    """

    name: str
    archive: bytes = field(repr=False)
    interface: Interface
    solver: Solver
    parameters: tuple[str, ...]
    structure: tuple[tuple[str, int], ...] = ()
    talks: bool = False
    renew: Renewal = "auto"

    @cached_property
    def archive_hash(self) -> str:
        """SHA-256 of the FMU, the name of its unpacked folder."""
        return hashlib.sha256(self.archive).hexdigest()

    @cached_property
    def key(self) -> str:
        """Hash of everything that makes a simulation's result, but values and experiment."""
        more = [repr(self.structure)] if self.structure else []
        more += [f"renew {self.renew}"] if self.renew != "auto" else []
        return content_hash(
            [self.archive_hash, self.interface, repr(self.solver), *self.parameters, *more]
        )


@dataclass(frozen=True)
class Input:
    """A measured signal that drives an input variable of the FMU.

    Before its first and after its last sample the signal keeps that sample's value.
    """

    variable: str
    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)
    interpolation: Interpolation = "linear"


@dataclass(frozen=True)
class Output:
    """A measured signal that an output variable of the FMU should follow; no NaN in it."""

    variable: str
    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)
    sigma: float = 1.0


@dataclass(frozen=True)
class Curve:
    """Measured points of a curve without times, such as force over displacement.

    Attributes
    ----------
    variables
        The FMU's variable for each column.
    points : (n, d)
        Measured, in their order along the curve.
    times : (m,)
        When the simulated curve is sampled.
    tolerances : (d,)
        How far a simulated point may lie from the curve in each column; 0 for as far as it likes.
    """

    variables: tuple[str, ...]
    points: FloatArray = field(repr=False)
    times: FloatArray = field(repr=False)
    tolerances: tuple[float, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Of its constraints."""
        pairs = zip(self.variables, self.tolerances, strict=False)
        return tuple(f"tolerance of {name}" for name, tolerance in pairs if tolerance != 0.0)


@dataclass(frozen=True)
class SignalBound:
    """A constraint on a simulated signal y: lower(t) <= y(t) <= upper(t), or y(t) = lower(t).

    Attributes
    ----------
    name
        What tables call it.
    variable
        Of the FMU.
    times : (m,)
        When it must hold.
    lower, upper : (m,)
        Infinite where there is no bound.
    scale
        What a violation is counted in.
    equality
        Whether the signal must be equal to `lower`; `upper` is the same then.
    """

    name: str
    variable: str
    times: FloatArray = field(repr=False)
    lower: FloatArray = field(repr=False)
    upper: FloatArray = field(repr=False)
    scale: float = 1.0
    equality: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of its constraints: one, or one for each side that it has."""
        if self.equality:
            return (self.name,)
        sides = {"lower": self.lower, "upper": self.upper}
        return tuple(f"{self.name} {s}" for s, values in sides.items() if np.isfinite(values).any())


@dataclass(frozen=True)
class Function:
    """A Python function of the user's, which runs on the workers.

    Attributes
    ----------
    module, name
        Where it stands.
    source
        The module's text, where it is a file of the user's; empty if the module is installed.
    equality
        For a constraint: whether what it returns must be 0, else at most 0.
    label
        What tables call it; `name` if empty.
    """

    module: str
    name: str
    source: str = field(default="", repr=False)
    equality: bool = False
    label: str = ""


@dataclass(frozen=True)
class Experiment:
    """One measured run, as a worker needs it.

    Attributes
    ----------
    id
        Name, unique in a problem.
    start, stop
        Simulated interval in seconds. Every output's times lie in it.
    inputs, outputs
        The measured signals.
    values
        Known start values of this run by variable name, written before initialisation.
    role, groups
        Labels for the coordinator: whether the parameters are estimated from this run ("train") or
        only tested on it ("test"), and which group it belongs to under each key. No result depends
        on them.
    signals
        Measured signals that the model has no input for; effects may depend on them by name.
    curve
        Measured points without times, besides or instead of `outputs`.
    bounds
        What simulated signals must satisfy.
    cost_function
        Returns what takes the place of all residuals of this experiment.
    constraint_functions
        Each returns a number that must be at most 0, or 0.
    """

    id: str
    start: float
    stop: float
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]
    values: tuple[tuple[str, Value], ...] = ()
    role: Role = "train"
    groups: tuple[tuple[str, str], ...] = ()
    signals: tuple[Input, ...] = ()
    curve: Curve | None = None
    bounds: tuple[SignalBound, ...] = ()
    cost_function: Function | None = None
    constraint_functions: tuple[Function, ...] = ()

    @property
    def size(self) -> int:
        """Number of residuals; those of a cost function are known only once it has been called."""
        return sum(self.counts)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of residuals of each output, then of the curve, in the order of the residuals."""
        segments = () if self.curve is None else (len(self.curve.points) - 1,)
        return (*(len(output.times) for output in self.outputs), *segments)

    def counts_in(self, want: Want) -> tuple[int, ...]:
        """The same for an answer to `want`, which may have one number for all of an output."""
        return tuple(min(c, 1) for c in self.counts) if want in REDUCTIONS else self.counts

    @cached_property
    def recorded(self) -> tuple[str, ...]:
        """The FMU's variables that a simulation records: outputs first, each once."""
        names = [output.variable for output in self.outputs]
        names += self.curve.variables if self.curve is not None else ()
        return tuple(dict.fromkeys([*names, *(bound.variable for bound in self.bounds)]))

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """Of the constraints that a worker evaluates: curve, bounds, then functions."""
        names = [] if self.curve is None else list(self.curve.names)
        for bound in self.bounds:
            names += bound.names
        return (*names, *(each.label or each.name for each in self.constraint_functions))

    @cached_property
    def equality(self) -> tuple[bool, ...]:
        """Whether each of those must be 0, else at most 0."""
        kinds = [False] * (0 if self.curve is None else len(self.curve.names))
        for bound in self.bounds:
            kinds += [bound.equality] * len(bound.names)
        return (*kinds, *(function.equality for function in self.constraint_functions))

    @cached_property
    def key(self) -> str:
        """Hash of everything in here that a result depends on."""
        signals: list[str | bytes] = [repr((self.start, self.stop, self.values))]
        for given in (*self.inputs, *self.signals):
            signals += [given.variable, given.interpolation]
            signals += [given.times.tobytes(), given.values.tobytes()]
        for output in self.outputs:
            signals += [output.variable, repr(output.sigma)]
            signals += [output.times.tobytes(), output.values.tobytes()]
        if self.curve is not None:
            signals += ["curve", repr(self.curve.variables), repr(self.curve.tolerances)]
            signals += [self.curve.points.tobytes(), self.curve.times.tobytes()]
        for bound in self.bounds:
            signals += ["bound", bound.name, bound.variable, repr((bound.scale, bound.equality))]
            signals += [bound.times.tobytes(), bound.lower.tobytes(), bound.upper.tobytes()]
        for function in (self.cost_function, *self.constraint_functions):
            if function is not None:
                signals += ["function", function.module, function.name, function.source]
                signals += [repr((function.equality, function is self.cost_function))]
        return content_hash(signals)


@dataclass(frozen=True, slots=True)
class Task:
    """One point and one experiment: the unit of distribution.

    Attributes
    ----------
    id
        Chosen by the coordinator; the outcome repeats it.
    experiment
        Index into the installed experiments.
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
    """

    id: int
    experiment: int
    values: FloatArray
    want: Want = "residuals"
    effects: tuple[Effect, ...] = ()


@dataclass(frozen=True, slots=True)
class Limits:
    """When a simulation in a process of its own is ended from outside.

    Attributes
    ----------
    seconds
        Longest that one simulation may take.
    patience
        How many times as long as usual it may take, beyond a second; 0 for no such limit.
    memory
        Most bytes that the process may have in memory.
    growth
        Bytes by which it may grow over many simulations before it is replaced by a fresh one.
    """

    seconds: float = 600.0
    patience: float = 50.0
    memory: float = float("inf")
    growth: float = 256.0 * 2**20


class Status(enum.StrEnum):
    """How a task ended. A member's text is what a person reads."""

    OK = "ok"
    SOLVER_FAILURE = "solver failure"
    NOT_FINITE = "not finite"
    TIMEOUT = "timeout"
    OUT_OF_MEMORY = "out of memory"
    CRASH = "crash"
    LOST_WORKER = "lost worker"
    NOT_RUN = "not run"


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Simulated outputs, `values[i, j]` being `variables[j]` at `times[i]`."""

    variables: tuple[str, ...]
    times: FloatArray
    values: FloatArray


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
    states, slopes : (n, x)
        x and f.
    inputs, edited : (n, u)
        Inputs before and after the effects.
    outputs, plain_outputs : (n, y)
        With effects at outputs, and without: the experiment's outputs.
    A, B, P : (n, x, x), (n, x, u), (n, x, p)
        df/dx, df/du, df/dp.
    C, D, Q : (n, y, x), (n, y, u), (n, y, p)
        dg/dx, dg/du, dg/dp.
    state_names, input_names, output_names, parameter_names
        What the axes stand for.
    """

    times: FloatArray
    states: FloatArray
    slopes: FloatArray
    inputs: FloatArray
    edited: FloatArray
    outputs: FloatArray
    plain_outputs: FloatArray
    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    P: FloatArray
    Q: FloatArray
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    parameter_names: tuple[str, ...]


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

    @property
    def ok(self) -> bool:
        return self.status is Status.OK


def content_hash(parts: Iterable[str | bytes]) -> str:
    """SHA-256 over parts, each preceded by its length so that no two lists collide."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little"))
        digest.update(data)
    return digest.hexdigest()
