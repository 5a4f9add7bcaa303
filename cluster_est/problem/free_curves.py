"""The free curve of an effect: a table of values over points, which may be smooth and monotonic.

Without smoothness, each value is a parameter. With smoothness, the unknowns are the value and the
slope at the first point, and the change of slope at each inner point. The prior of these changes is
normal with mean 0 and a variance that grows with the distance of the points:

    b_i ~ N(0, s^2 (h_(i-1) + h_i) / 2).

This is the integrated Wiener process of smoothing splines, at the points of the table (G. Wahba, J.
R. Stat. Soc. B 40 (1978) 364-372, doi:10.1111/j.2517-6161.1978.tb01050.x). So a table with more
points is not rougher. Expressions compute the values from the unknowns.

A table may be 0 by definition at one or two points. Then the first value, or the first value and
the slope, are computed from the changes of slope.
"""

from __future__ import annotations

import keyword
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Literal, get_args

import numpy as np

from cluster_est.errors import ConfigError, EffectError
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import NormalPrior
from workers.effects.kinds import EffectForm
from workers.messages.checks import check_choice, check_number, is_number, shown, told_apart

FARTHEST_SLOPE_CHANGE = 8.0
"""Bounds of a change of slope, in standard deviations of its prior."""
Monotone = Literal["", "increasing", "decreasing"]
UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True)
class TableShape:
    """The known properties of a table's shape.

    Attributes
    ----------
    slope_change
        Standard deviation of the change of slope over one unit of the abscissa; None for no
        smoothness.
    monotone
        "increasing" or "decreasing" as a constraint; "" for none.
    bounds
        Bounds of all values. With `slope_change`, they are the bounds of the first value. The first
        slope is then at most upper - lower over the shortest interval.
    """

    slope_change: float | None = None
    monotone: Monotone = ""
    bounds: tuple[float, float] = UNBOUNDED

    @property
    def says_something(self) -> bool:
        """Whether any property is given."""
        return self.slope_change is not None or bool(self.monotone) or self.bounds != UNBOUNDED


@dataclass(frozen=True)
class TableUnknown:
    """An unknown of a smooth table; its prior has mean 0 and standard deviation `sd` (or None)."""

    name: str
    start: float
    lower: float
    upper: float
    sd: float | None = None


@dataclass(frozen=True)
class ValueTable:
    """A table of values.

    Attributes
    ----------
    where
        Start of error messages.
    prefix
        Start of the names of a smooth table's unknowns.
    values
        Names of the parameters that are the values; None for a value that is 0 by definition.
    points
        Increasing abscissas of the values.
    starts
        Start value at each point.
    shape
        Known properties of the shape.
    """

    where: str
    prefix: str
    values: tuple[str | None, ...]
    points: tuple[float, ...]
    starts: tuple[float, ...]
    shape: TableShape

    @property
    def _widths(self) -> list[float]:
        return [b - a for a, b in pairwise(self.points)]

    @property
    def _zeros(self) -> list[int]:
        """Indices of the values that are 0 by definition."""
        return [i for i, name in enumerate(self.values) if name is None]

    def check(self) -> None:
        """Refuse contradictory properties.

        Raises
        ------
        ConfigError
            If points, start values, bounds and shape contradict each other.
        """
        low, high = self.shape.bounds
        if not all(a < b for a, b in pairwise(self.points)):
            raise ConfigError(
                f"{self.where}.points: must increase, but do not; sort them together with their "
                "values"
            )
        if not low < high:
            raise ConfigError(
                f"{self.where}.bounds: must be [lower, upper] with lower below upper, but are "
                f"{[low, high]}; swap them"
            )
        for start in self.starts:
            if not low <= start <= high:
                raise ConfigError(
                    f"{self.where}.start: must lie within the bounds {[low, high]}, but has "
                    f"{start:g}; change one of the two"
                )
        smooth = self.shape.slope_change is not None
        if smooth and not (math.isfinite(low) and math.isfinite(high)):
            raise ConfigError(
                f"{self.where}.bounds: must be finite with slope_change, but are {[low, high]}; "
                "give the range of the values"
            )

    def unknowns(self) -> Iterator[TableUnknown]:
        """Yield the unknowns of a smooth table: first value, first slope, and changes of slope."""
        change = self.shape.slope_change
        assert change is not None
        (low, high), widths, zeros = self.shape.bounds, self._widths, self._zeros
        slopes = [(b - a) / h for (a, b), h in zip(pairwise(self.starts), widths, strict=True)]
        steepest = (high - low) / min(widths)
        if not zeros:
            yield TableUnknown(f"{self.prefix}level", self.starts[0], low, high)
        if len(zeros) < 2:
            yield TableUnknown(f"{self.prefix}slope", slopes[0], -steepest, steepest)
        pairs = zip(pairwise(slopes), pairwise(widths), strict=True)
        for i, ((before, after), pair) in enumerate(pairs, 1):
            sd = change * math.sqrt(0.5 * sum(pair))
            most = FARTHEST_SLOPE_CHANGE * sd
            start = min(max(after - before, -most), most)
            yield TableUnknown(self._bend(i), start, -most, most, sd)

    def expressions(self) -> Iterator[tuple[str, str]]:
        """Yield name and expression of each value of a smooth table."""
        widths = self._widths
        texts = [self._first(), f"{self._value(0)} + {widths[0]!r} * ({self._slope()})"]
        for i, (before, width) in enumerate(pairwise(widths), 1):
            slope = f"({self._value(i)} - {self._value(i - 1)}) / {before!r}"
            texts.append(f"{self._value(i)} + {width!r} * ({slope} + {self._bend(i)})")
        for name, text in zip(self.values, texts, strict=True):
            if name is not None:
                yield name, text

    def order(self, steps: str = "") -> Iterator[str]:
        """Yield the constraints of a monotonic table, as texts.

        Parameters
        ----------
        steps
            A formula that is added to the step from each value to the next.
        """
        sign = "<=" if self.shape.monotone == "increasing" else ">="
        for i in range(len(self.values) - 1) if self.shape.monotone else ():
            more = f" + {steps}" if steps else ""
            yield f"{self._value(i)} {sign} {self._value(i + 1)}{more}"

    def _bend(self, i: int) -> str:
        """Return the name of the change of slope at point i; names count from 1."""
        return f"{self.prefix}bend_{i + 1}"

    def _value(self, i: int) -> str:
        """Return the value at a point for a formula."""
        return self.values[i] or "0"

    def _bent(self, i: int) -> str:
        """Return the contribution of earlier changes of slope to the value at a point."""
        terms = [
            f"{self.points[i] - self.points[j]!r} * {self._bend(j)}"
            for j in range(1, min(i, len(self.points) - 1))
        ]
        return " + ".join(terms) or "0"

    def _first(self) -> str:
        """Return the first value: an unknown, or such that the table is 0 at its zero."""
        if not self._zeros:
            return f"{self.prefix}level"
        zero = self._zeros[0]
        distance = self.points[zero] - self.points[0]
        return f"-({distance!r} * ({self._slope()}) + {self._bent(zero)})"

    def _slope(self) -> str:
        """Return the first slope: an unknown, or such that the table is 0 at its second zero."""
        if len(self._zeros) < 2:
            return f"{self.prefix}slope"
        first, second = self._zeros
        distance = self.points[second] - self.points[first]
        return f"(({self._bent(first)}) - ({self._bent(second)})) / {distance!r}"


def check_table_name(name: str, where: str, made: str) -> None:
    """Refuse a name that formulas cannot contain.

    Parameters
    ----------
    name
        Name of a map or an effect.
    where
        Start of the error message.
    made
        The names of the values.

    Raises
    ------
    ConfigError
        If the name cannot be part of a formula.
    """
    if not all(part.isidentifier() and not keyword.iskeyword(part) for part in name.split(".")):
        raise ConfigError(
            f"{where}: the name must consist of letters, digits and _ (its values are named "
            f"{made}), but is {name!r}; rename it"
        )


UNSHAPED = TableShape()
"""Free values without known properties."""
CURVE_END_COEFFICIENTS = ("low", "high")
"""The coefficients between which a free curve has its points."""


@dataclass(frozen=True)
class ShapedCurve:
    """A free curve with known properties of its shape.

    Attributes
    ----------
    name, form
        Name and form of the effect.
    shape
        The known properties; at least one.
    coefficients
        The parameters of the form without these properties.
    chosen
        Keys, such as "bounds", that were declared for each coefficient in addition to its start.

    Raises
    ------
    ConfigError
        If the form is not a free curve, or if the declared properties contradict each other.
    """

    name: str
    form: EffectForm
    shape: TableShape
    coefficients: tuple[Parameter, ...]
    chosen: Mapping[str, Sequence[str]]

    def __post_init__(self) -> None:
        where = f"effects.{self.name}"
        if not self.form.values:
            key = next(key for key in vars(UNSHAPED) if self._says(key))
            raise ConfigError(
                f"{where}.{key}: is only for a form that is a free curve, such as table, "
                f"coulomb_table or characteristic, but the form is {self.form.name!r}; leave {key} "
                "out"
            )
        check_table_name(self.name, where, "NAME.k1, NAME.k2, ...")
        if self.form.is_characteristic and self.shape.monotone == "decreasing":
            raise ConfigError(
                f'{where}.monotone: must be "increasing" (outside its range, a characteristic is '
                'the signal itself), but is "decreasing"; use "increasing" and an effect gain that '
                "changes the sign"
            )
        if self.shape.slope_change is not None:
            self._check_free_of_keys(where)
        self.table.check()

    def _says(self, key: str) -> bool:
        return bool(getattr(self.shape, key) != getattr(UNSHAPED, key))

    def _check_free_of_keys(self, where: str) -> None:
        """Refuse keys of coefficients that are computed from others or fixed."""
        whys = dict.fromkeys(self.form.curve_values, "the value follows from changes of slope")
        whys |= dict.fromkeys(
            CURVE_END_COEFFICIENTS, "changes of slope are defined between fixed points"
        )
        for name, why in whys.items():
            for key in self.chosen.get(name or "", ()):
                if not (name in CURVE_END_COEFFICIENTS and key == "fixed"):
                    raise ConfigError(
                        f"{where}.parameters.{name}.{key}: must not be used with slope_change, "
                        f"because {why}; remove one of the two"
                    )

    @cached_property
    def _starts(self) -> dict[str, float]:
        """Return the start values of the coefficients, by their names in the form."""
        cut = len(self.name) + 1
        return {p.name[cut:]: p.start for p in self.coefficients}

    @cached_property
    def table(self) -> ValueTable:
        """The table of the curve's values over their points."""
        low, high = (self._starts[name] for name in CURVE_END_COEFFICIENTS)
        if not low < high:
            least, most = told_apart(low, high)
            raise ConfigError(
                f"effects.{self.name}.parameters.low.start: must be below the start of high, which "
                f"is {most}, but is {least}; change one of them"
            )
        names = self.form.curve_values
        return ValueTable(
            f"effects.{self.name}",
            f"{self.name}.",
            tuple(None if name is None else f"{self.name}.{name}" for name in names),
            tuple(np.linspace(low, high, len(names)).tolist()),
            tuple(0.0 if name is None else self._starts[name] for name in names),
            self.shape,
        )

    def parameters(self) -> tuple[Parameter, ...]:
        """Return the coefficients in their order, after the unknowns from which they follow."""
        if self.shape.slope_change is None:
            return tuple(self._bounded(p) for p in self.coefficients)
        texts = dict(self.table.expressions())
        ends = [f"{self.name}.{end}" for end in CURVE_END_COEFFICIENTS]
        found = [_auxiliary(unknown) for unknown in self.table.unknowns()]
        for p in self.coefficients:
            if p.name in texts:
                found.append(Parameter(p.name, p.start, unit=p.unit, expression=texts[p.name]))
            else:
                found.append(replace(p, fixed=True) if p.name in ends else p)
        return tuple(found)

    def _bounded(self, parameter: Parameter) -> Parameter:
        """Return a value with the bounds of the shape, unless it has its own bounds."""
        name = parameter.name[len(self.name) + 1 :]
        if name not in self.form.curve_values or "bounds" in self.chosen.get(name, ()):
            return parameter
        return replace(parameter, bounds=self.shape.bounds)

    def constraints(self) -> tuple[ParameterConstraint, ...]:
        """Return constraints for a monotonic curve; for a characteristic, of signal plus curve."""
        known = [*(name for name in self.table.values if name is not None)]
        steps = ""
        if self.form.is_characteristic:
            low, high = (f"{self.name}.{end}" for end in CURVE_END_COEFFICIENTS)
            known += [low, high]
            steps = f"({high} - {low}) / {len(self.table.points) - 1}"
        found = []
        for text in self.table.order(steps):
            found += parse_constraint(text, known, f"effects.{self.name}.monotone")
        return tuple(found)


def checked_shape(
    slope_change: float | None, monotone: Monotone, bounds: Sequence[float] | None
) -> TableShape:
    """Return the properties of a curve after a check of their types.

    Raises
    ------
    EffectError
        If a property has a wrong type.
    """
    if slope_change is not None:
        check_number(slope_change, "effect.slope_change", EffectError, above=0.0)
    check_choice(monotone, get_args(Monotone), "effect.monotone", EffectError)
    if bounds is None:
        return TableShape(slope_change, monotone)
    pair = tuple(bounds) if isinstance(bounds, Sequence) else ()
    if len(pair) != 2 or not all(is_number(bound) for bound in pair):
        raise EffectError(
            f"effect.bounds: must be two numbers (lower, upper), but is {shown(bounds)}"
        )
    return TableShape(slope_change, monotone, (float(pair[0]), float(pair[1])))


def _auxiliary(unknown: TableUnknown) -> Parameter:
    return Parameter(
        unknown.name,
        unknown.start,
        (unknown.lower, unknown.upper),
        auxiliary=True,
        prior=None if unknown.sd is None else NormalPrior(mean=0.0, sd=unknown.sd),
    )
