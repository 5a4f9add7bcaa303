"""Comparisons of a simulation with other things than outputs: curves, bounds, functions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.errors import DataError
from workers.messages.checks import as_tuple, check_flag, check_name, check_number, check_text
from workers.messages.equality import by_content
from workers.messages.signals import check_finite, check_length, check_times, kept_floats
from workers.messages.types import FloatArray


@by_content
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
        Empty for that in all columns.

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
                f"curve.tolerances: must be as many as the variables, {len(variables)}, but are "
                f"{len(tolerances)}; write 0 for a variable without one"
            )
        for name, tolerance in zip(variables, tolerances, strict=False):
            check_number(tolerance, f"curve.tolerances of {name!r}", DataError, least=0.0)

    @property
    def names(self) -> tuple[str, ...]:
        """Of its constraints."""
        pairs = zip(self.variables, self.tolerances, strict=False)
        return tuple(f"tolerance of {name}" for name, tolerance in pairs if tolerance != 0.0)


@by_content
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
        """Refuse limits that no signal could keep, naming the first."""
        for side, none in (("lower", -np.inf), ("upper", np.inf)):
            limit = getattr(self, side)
            for i in np.flatnonzero(~np.isfinite(limit)):
                if self.equality or limit[i] != none:
                    other = "" if self.equality else f", or {none} where there is no bound,"
                    raise DataError(
                        f"{where}.{side}, index {i}: must be a finite number{other} but is "
                        f"{limit[i]}; mend it"
                    )
        wrong = self.lower != self.upper if self.equality else self.lower > self.upper
        for i in np.flatnonzero(wrong):
            must = "be upper, because it is an equality," if self.equality else "not be above upper"
            raise DataError(
                f"{where}.lower, index {i}: must {must} but they are {self.lower[i]:g} and "
                f"{self.upper[i]:g}; change one"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Of its constraints: one, or one for each side that it has."""
        if self.equality:
            return (self.name,)
        sides = {"lower": self.lower, "upper": self.upper}
        return tuple(f"{self.name} {s}" for s, values in sides.items() if np.isfinite(values).any())


@dataclass(frozen=True)
class UserFunction:
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

    Raises
    ------
    DataError
        If it has no module or no name, or something is no text.
    """

    module: str
    name: str
    source: str = field(default="", repr=False)
    equality: bool = False
    label: str = ""

    def __post_init__(self) -> None:
        check_name(self.module, "function.module", DataError)
        check_name(self.name, "function.name", DataError)
        for key in ("source", "label"):
            check_text(getattr(self, key), f"function {self.name!r}.{key}", DataError)
        check_flag(self.equality, f"function {self.name!r}.equality", DataError)


def _own_times(values: object, where: str) -> FloatArray:
    """At least one time, as a copy that cannot be written to."""
    times = kept_floats(values, f"{where}.times")
    if not len(times):
        raise DataError(f"{where}.times: must have at least one time but has none; add one")
    check_times(times, f"{where}.times", "index {}".format)
    return times


def _check_points(points: FloatArray, variables: tuple[str, ...]) -> None:
    """Refuse points of a curve that are too few, or are not a number for each variable."""
    if not variables:
        raise DataError("curve.variables: must name at least one variable but are empty; name them")
    for i, name in enumerate(variables):
        check_name(name, f"curve.variables[{i}]", DataError)
    if points.shape[1] != len(variables):
        raise DataError(
            f"curve.points: must have a column for each variable, {len(variables)}, but have "
            f"{points.shape[1]}; change one of the two"
        )
    if len(points) < 2:
        raise DataError(
            f"curve.points: must be at least two but are {len(points)}; a curve goes from one "
            "point to the next"
        )
    for name, column in zip(variables, points.T, strict=True):
        check_finite(column, f"curve.points of {name!r}")
