"""A measured experiment: the signals that drive a simulation and those compared with it.

A simulation may also be compared with a curve, bounds and functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar, get_args

import numpy as np

from workers.errors import DataError
from workers.messages.checks import (
    as_pairs,
    as_tuple,
    check_choice,
    check_flag,
    check_kind,
    check_name,
    check_number,
    check_once,
    few_names,
    is_finite,
    is_number,
    shown,
    told_apart,
)
from workers.messages.signals import (
    Input,
    Output,
    check_finite,
    check_length,
    check_times,
    kept_floats,
)
from workers.messages.types import (
    REDUCTIONS,
    FloatArray,
    GapRule,
    Role,
    Value,
    Want,
    by_content,
    content_hash,
)
from workers.messages.user_function import UserFunction, as_user_function


@by_content
@dataclass(frozen=True)
class Curve:
    """Measured points of a curve without times, such as force over displacement.

    Attributes
    ----------
    variables
        The FMU's variable of each column.
    points : (n, d)
        Measured points, in their order along the curve.
    times : (m,)
        Times at which the simulated curve is sampled.
    tolerances : (d,)
        Largest distance of a simulated point from the curve in each column; 0 for no limit. Empty
        for no limit in any column.

    Raises
    ------
    DataError
        If there are fewer than two points or not a column for each variable, times are not finite
        and increasing, or a tolerance is negative.
    """

    variables: tuple[str, ...]
    points: FloatArray = field(repr=False)
    times: FloatArray = field(repr=False)
    tolerances: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        variables = as_tuple(self.variables, str, "curve.variables", DataError)
        points = kept_floats(self.points, "curve.points", 2)
        tolerances = tuple(kept_floats(self.tolerances, "curve.tolerances").tolist())
        object.__setattr__(self, "variables", variables)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "times", _own_times(self.times, "curve"))
        object.__setattr__(self, "tolerances", tolerances)
        _check_points(points, variables)
        if tolerances and len(tolerances) != len(variables):
            raise DataError(
                f"curve.tolerances: must have a number for each of the {len(variables)} variables, "
                f"but has {len(tolerances)}; write 0 for a variable without a tolerance"
            )
        for name, tolerance in zip(variables, tolerances, strict=False):
            check_number(tolerance, f"curve.tolerances of {name!r}", DataError, least=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its constraints."""
        pairs = zip(self.variables, self.tolerances, strict=False)
        return tuple(f"tolerance of {name}" for name, tolerance in pairs if tolerance != 0.0)


@by_content
@dataclass(frozen=True)
class SignalBound:
    """A constraint on a simulated signal y: lower(t) <= y(t) <= upper(t), or y(t) = lower(t).

    Attributes
    ----------
    name
        Name in tables.
    variable
        The FMU's variable.
    times : (m,)
        Times at which it must hold.
    lower, upper : (m,)
        Limits; infinite for no bound.
    scale
        Unit of a violation.
    equality
        Whether the signal must be equal to `lower`; then `upper` is the same.

    Raises
    ------
    DataError
        If times are not finite and increasing, there is not a limit for each, `lower` is above
        `upper`, or the scale is not positive.
    """

    name: str
    variable: str
    times: FloatArray = field(repr=False)
    lower: FloatArray = field(repr=False)
    upper: FloatArray = field(repr=False)
    scale: float = 1.0
    equality: bool = False

    def __post_init__(self) -> None:
        check_name(self.name, "bound.name", DataError)
        where = f"bound {self.name!r}"
        check_name(self.variable, f"{where}.variable", DataError)
        check_flag(self.equality, f"{where}.equality", DataError)
        check_number(self.scale, f"{where}.scale", DataError, above=0.0)
        times = _own_times(self.times, where)
        object.__setattr__(self, "times", times)
        for side in ("lower", "upper"):
            limit = kept_floats(getattr(self, side), f"{where}.{side}")
            check_length(limit, times, f"{where}.{side}:")
            object.__setattr__(self, side, limit)
        self._check_limits(where)

    def _check_limits(self, where: str) -> None:
        """Check that a signal can satisfy the limits; the error names the first wrong limit."""
        for side, none in (("lower", -np.inf), ("upper", np.inf)):
            limit = getattr(self, side)
            for i in np.flatnonzero(~np.isfinite(limit)):
                if self.equality or limit[i] != none:
                    other = "" if self.equality else f", or {none} for no bound"
                    raise DataError(
                        f"{where}.{side}, index {i}: must be a finite number{other}, but is "
                        f"{limit[i]}; correct it"
                    )
        wrong = self.lower != self.upper if self.equality else self.lower > self.upper
        for i in np.flatnonzero(wrong):
            must = (
                "be equal to upper, because the constraint is an equality"
                if self.equality
                else "not be above upper"
            )
            low, high = told_apart(self.lower[i], self.upper[i])
            raise DataError(
                f"{where}.lower, index {i}: must {must}, but they are {low} and {high}; change one "
                "of the two"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its constraints: one, or one for each side with a limit."""
        if self.equality:
            return (self.name,)
        sides = {"lower": self.lower, "upper": self.upper}
        return tuple(f"{self.name} {s}" for s, values in sides.items() if np.isfinite(values).any())


def _own_times(values: object, where: str) -> FloatArray:
    """Return at least one time, as a read-only copy."""
    times = kept_floats(values, f"{where}.times")
    if not len(times):
        raise DataError(f"{where}.times: must have at least one time, but has none; add one")
    check_times(times, f"{where}.times", "index {}".format)
    return times


def _check_points(points: FloatArray, variables: tuple[str, ...]) -> None:
    """Check that a curve has enough points, and a column for each variable."""
    if not variables:
        raise DataError("curve.variables: must name at least one variable, but names none; add one")
    for i, name in enumerate(variables):
        check_name(name, f"curve.variables[{i}]", DataError)
    if points.shape[1] != len(variables):
        raise DataError(
            f"curve.points: must have a column for each of the {len(variables)} variables, but has "
            f"{points.shape[1]}; change one of the two"
        )
    if len(points) < 2:
        raise DataError(
            "curve.points: must have at least two rows (a curve connects points), but has "
            f"{len(points)}; add points"
        )
    for name, column in zip(variables, points.T, strict=True):
        check_finite(column, f"curve.points of {name!r}")


@dataclass(frozen=True)
class OwnStart:
    """A start value that is estimated only for one experiment, because it begins after a gap.

    Attributes
    ----------
    variable
        A state of the FMU.
    start, lower, upper
        Start of the estimation, and bounds; a label like `role`.
    """

    variable: str
    start: float
    lower: float = -math.inf
    upper: float = math.inf

    def __post_init__(self) -> None:
        check_name(self.variable, "own_starts.variable", DataError)
        check_number(self.start, f"own_starts of {self.variable!r}: start", DataError)


@by_content
@dataclass(frozen=True)
class Experiment:
    """One measured run, as a worker needs it.

    Attributes
    ----------
    id
        Name, unique in a problem.
    start, stop
        Simulated interval in seconds. It contains the times of every output.
    inputs, outputs
        The measured signals.
    values
        Known start values of this run by variable name, set before initialisation. Like `groups`,
        they may be given as a dict.
    role, groups
        Labels for the coordinator: whether the parameters are estimated from this run ("train") or
        only tested on it ("test"), and its group under each key. No result depends on them.
    signals
        Measured signals that are not inputs of the model; effects may depend on them by name.
    curve
        Measured points without times, in addition to `outputs` or instead of them.
    bounds
        Constraints on simulated signals.
    cost_function
        Replaces all residuals of this experiment. It may be given as a plain function of a
        `SimulatedRun`; the workers receive a copy.
    constraint_functions
        Each returns a number that must be at most 0, or equal to 0. They may be given like
        `cost_function`.
    record
        Name of the experiment with which it shares values of parameters that differ between
        experiments, because both are parts of one record; "" if it has its own values. A label.
    gaps
        Treatment of gaps in the record. With "split", the part after a gap starts with its own
        initial states if the inputs in the gap are unknown. With "bridge", the inputs are
        interpolated. A label.
    own_starts
        Initial states that are estimated only for this experiment, because it begins after a gap of
        its record. A label.
    log_spread
        With process noise: a constant that is subtracted from the sum of log(S / sigma^2) in
        -2 log likelihood, with the variances S predicted by a Kalman filter. It changes no
        estimate. With the sum of a fitted model, residuals near that model are innovations over
        their standard deviations.

    Raises
    ------
    DataError
        If its signals contradict it or each other.
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
    cost_function: UserFunction | None = None
    constraint_functions: tuple[UserFunction, ...] = ()
    record: str = ""
    gaps: GapRule = "split"
    own_starts: tuple[OwnStart, ...] = ()
    log_spread: float = 0.0

    def __repr__(self) -> str:
        inputs = few_names([given.variable for given in self.inputs])
        outputs = few_names([output.variable for output in self.outputs])
        span = f"{self.start:g} to {self.stop:g} s"
        return f"Experiment({self.id}: {inputs or 'no input'} -> {outputs}; {span}; {self.role})"

    from_table: ClassVar[Callable[..., Experiment]]
    """Create an experiment from a table of pandas, polars or pyarrow, or from a dict of columns.
    The coordinator assigns this method, because a worker reads no tables."""
    hold_out: ClassVar[Callable[..., tuple[Experiment, Experiment]]]
    """Return its training part and a test experiment with the measurements within windows. The
    coordinator assigns this method too."""

    def __post_init__(self) -> None:
        check_name(self.id, "experiment.id", DataError)
        where = f"experiment {self.id!r}"
        for key, kind in _EXPERIMENT_LISTS.items():
            given = getattr(self, key)
            if key == "constraint_functions" and isinstance(given, Sequence):
                given = [as_user_function(each, f"{where}.{key}") for each in given]
            object.__setattr__(self, key, as_tuple(given, kind, f"{where}.{key}", DataError))
        for key in ("values", "groups"):
            given = getattr(self, key)
            object.__setattr__(self, key, as_pairs(given, f"{where}.{key}", DataError))
        check_choice(self.role, get_args(Role), f"{where}.role", DataError)
        check_choice(self.gaps, get_args(GapRule), f"{where}.gaps", DataError)
        if self.record:
            check_name(self.record, f"{where}.record", DataError)
        _check_values(self.values, f"{where}.values")
        check_once([output.variable for output in self.outputs], f"{where}.outputs", DataError)
        if self.curve is not None:
            check_kind(self.curve, Curve, f"{where}.curve", DataError)
        if self.cost_function is not None:
            function = as_user_function(self.cost_function, f"{where}.cost_function")
            check_kind(function, UserFunction, f"{where}.cost_function", DataError)
            object.__setattr__(self, "cost_function", function)
        check_number(self.log_spread, f"{where}.log_spread", DataError)
        _check_interval(self, where)

    @property
    def record_id(self) -> str:
        """Name of the record that it is, or that it is a part of."""
        return self.record or self.id

    def estimates_alone(self, variable: str) -> bool:
        """Return whether a start value is estimated only for this experiment."""
        return any(each.variable == variable for each in self.own_starts)

    @property
    def size(self) -> int:
        """Number of residuals; that of a cost function is known only after its first call."""
        return sum(self.counts)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of residuals of each output, then of the curve, in the order of the residuals."""
        segments = () if self.curve is None else (len(self.curve.points) - 1,)
        return (*(len(output.times) for output in self.outputs), *segments)

    def counts_in(self, want: Want) -> tuple[int, ...]:
        """Return the lengths of an answer to `want`, which may have one number for each output."""
        return tuple(min(c, 1) for c in self.counts) if want in REDUCTIONS else self.counts

    @cached_property
    def recorded(self) -> tuple[str, ...]:
        """The FMU's variables that a simulation records: first the outputs, without duplicates."""
        names = [output.variable for output in self.outputs]
        names += self.curve.variables if self.curve is not None else ()
        return tuple(dict.fromkeys([*names, *(bound.variable for bound in self.bounds)]))

    @cached_property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of the constraints that a worker evaluates: curve, bounds, then functions."""
        names = [] if self.curve is None else list(self.curve.names)
        for bound in self.bounds:
            names += bound.names
        return (*names, *(each.label or each.name for each in self.constraint_functions))

    @cached_property
    def equality(self) -> tuple[bool, ...]:
        """Whether each constraint must be 0; the others must be at most 0."""
        kinds = [False] * (0 if self.curve is None else len(self.curve.names))
        for bound in self.bounds:
            kinds += [bound.equality] * len(bound.names)
        return (*kinds, *(function.equality for function in self.constraint_functions))

    @cached_property
    def key(self) -> str:
        """Hash of all contents on which a result depends."""
        signals: list[str | bytes] = [repr((self.start, self.stop, self.values))]
        for given in (*self.inputs, *self.signals):
            signals += [given.variable, given.interpolation]
            signals += [given.times.tobytes(), given.values.tobytes()]
        for output in self.outputs:
            relative = (output.relative_sigma,) if output.relative_sigma else ()
            signals += [output.variable, repr(output.sigma), *map(repr, relative)]
            signals += [] if output.sigma_known else ["sigma is not known"]
            if not output.is_plain:
                how = (output.free_scale, output.free_offset, output.detection_limit)
                signals += ["observed", repr(how), *(["ordinal"] if output.ordinal else [])]
            if output.learns and output.reference is not None:
                before = output.reference
                signals += ["reference", repr((before.sigma, before.relative_sigma))]
                signals += [before.times.tobytes(), before.values.tobytes()]
            signals += [output.times.tobytes(), output.values.tobytes()]
            factors = output.noise_factors
            signals += [] if factors is None else ["noise factors", factors.tobytes()]
        if self.curve is not None:
            signals += ["curve", repr(self.curve.variables), repr(self.curve.tolerances)]
            signals += [self.curve.points.tobytes(), self.curve.times.tobytes()]
        for bound in self.bounds:
            signals += ["bound", bound.name, bound.variable, repr((bound.scale, bound.equality))]
            signals += [bound.times.tobytes(), bound.lower.tobytes(), bound.upper.tobytes()]
        for function in (self.cost_function, *self.constraint_functions):
            if function is not None:
                signals += ["function", function.module, function.name, function.source]
                signals += [function.pickled] if function.pickled else []
                signals += [repr((function.equality, function is self.cost_function))]
        if self.log_spread:
            signals += ["log_spread", repr(self.log_spread)]
        return content_hash(signals)


_EXPERIMENT_LISTS: dict[str, type] = {
    "inputs": Input,
    "outputs": Output,
    "signals": Input,
    "bounds": SignalBound,
    "constraint_functions": UserFunction,
    "own_starts": OwnStart,
}
"""The lists of an experiment, and the types of their elements."""


def _check_values(values: tuple[tuple[str, Value], ...], where: str) -> None:
    """Check that known values are finite numbers, Booleans or text."""
    for name, value in values:
        fits = isinstance(value, bool | str | np.bool_) or is_number(value)
        if not fits or (is_number(value) and not is_finite(value)):
            raise DataError(
                f"{where}.{name}: must be a finite number, true, false or text, but is "
                f"{shown(value)}"
            )


def _check_interval(experiment: Experiment, where: str) -> None:
    """Check that the interval is not empty and contains all measured times."""
    start, stop = experiment.start, experiment.stop
    for key, time in (("start", start), ("stop", stop)):
        check_number(time, f"{where}.{key}", DataError)
    if not start < stop:
        begin, end = told_apart(start, stop)
        raise DataError(
            f"{where}.start: must be before stop, which is {end} s, but is {begin} s; change one "
            "of the two"
        )
    timed = [(f"outputs.{output.variable}", output.times) for output in experiment.outputs]
    timed += [
        (f"outputs.{output.variable}.reference", output.reference.times)
        for output in experiment.outputs
        if output.reference is not None
    ]
    timed += [(f"bounds.{bound.name}", bound.times) for bound in experiment.bounds]
    timed += [] if experiment.curve is None else [("curve", experiment.curve.times)]
    for key, times in timed:
        if len(times) and not start <= times[0] <= times[-1] <= stop:
            begin, end, first, last = told_apart(start, stop, times[0], times[-1])
            raise DataError(
                f"{where}.{key}: the times must lie between start and stop, {begin} to {end} s, "
                f"but go from {first} to {last} s; change start or stop, or leave those samples out"
            )
