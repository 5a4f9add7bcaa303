"""A table of values over points, of which it may be known that it is smooth or monotone.

Without smoothness each value is a parameter of its own. With it, the unknowns are the value and the
slope at the first point and the change of slope at each point between, of which a prior says that
it is normal about 0 with a variance that grows with the distance of the points,

    b_i ~ N(0, s^2 (h_(i-1) + h_i) / 2),

the integrated Wiener process that smoothing splines stand for, as far as the points show it (G.
Wahba, J. R. Stat. Soc. B 40 (1978) 364-372, doi:10.1111/j.2517-6161.1978.tb01050.x). So more points
make a table no rougher. The values follow from the unknowns by expressions.

A table may be 0 by definition at one point or two. Then the first value, or the slope too, follow
from the changes of slope.
"""

from __future__ import annotations

import keyword
import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from cluster_est.errors import ConfigError

FARTHEST = 8.0
"""Standard deviations up to which a change of slope is searched."""
Monotone = Literal["", "increasing", "decreasing"]
UNBOUNDED = (-math.inf, math.inf)


@dataclass(frozen=True)
class TableShape:
    """What is known of the shape of a table.

    Attributes
    ----------
    slope_change
        Standard deviation of the change of its slope over one unit of the abscissa; None for no
        smoothness.
    monotone
        "increasing" or "decreasing": a constraint; "" for neither.
    bounds
        Of every value; with `slope_change` of the first one, and of what the others may differ from
        it by in one interval.
    """

    slope_change: float | None = None
    monotone: Monotone = ""
    bounds: tuple[float, float] = UNBOUNDED

    @property
    def says_something(self) -> bool:
        """Whether there is more to it than free values."""
        return self.slope_change is not None or bool(self.monotone) or self.bounds != UNBOUNDED


@dataclass(frozen=True)
class TableUnknown:
    """What is searched for a smooth table; `sd` is that of its prior about 0, None without one."""

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
        Opens messages.
    prefix
        Begins the names of the unknowns of a smooth table.
    values
        Names of the parameters that are its values; None where a value is 0 by definition.
    points
        Where they hold, increasing.
    starts
        One for each point.
    shape
        What is known of it.
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
        """Positions of the values that are 0 by definition."""
        return [i for i, name in enumerate(self.values) if name is None]

    def check(self) -> None:
        """Refuse what contradicts itself.

        Raises
        ------
        ConfigError
            Saying what to change.
        """
        low, high = self.shape.bounds
        if not all(a < b for a, b in pairwise(self.points)):
            raise ConfigError(
                f"{self.where}.points: must increase but do not; sort them with their values"
            )
        if not low < high:
            raise ConfigError(
                f"{self.where}.bounds: must be [lower, upper] but are {[low, high]}; swap them"
            )
        for start in self.starts:
            if not low <= start <= high:
                raise ConfigError(
                    f"{self.where}.start: must lie within the bounds {[low, high]} but has "
                    f"{start:g}; move one of the two"
                )
        smooth = self.shape.slope_change is not None
        if smooth and not (math.isfinite(low) and math.isfinite(high)):
            raise ConfigError(
                f"{self.where}.bounds: must be finite where slope_change says how smooth it is, "
                f"but are {[low, high]}; say between which values it lies"
            )

    def unknowns(self) -> Iterator[TableUnknown]:
        """What a smooth table is made of: first value, first slope, and changes of slope."""
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
            most = FARTHEST * sd
            start = min(max(after - before, -most), most)
            yield TableUnknown(self._bend(i), start, -most, most, sd)

    def expressions(self) -> Iterator[tuple[str, str]]:
        """Each value of a smooth table by its name, from the unknowns and the values before it."""
        widths = self._widths
        texts = [self._first(), f"{self._value(0)} + {widths[0]!r} * ({self._slope()})"]
        for i, (before, width) in enumerate(pairwise(widths), 1):
            slope = f"({self._value(i)} - {self._value(i - 1)}) / {before!r}"
            texts.append(f"{self._value(i)} + {width!r} * ({slope} + {self._bend(i)})")
        for name, text in zip(self.values, texts, strict=True):
            if name is not None:
                yield name, text

    def order(self, steps: str = "") -> Iterator[str]:
        """The constraints of a monotone table, as texts.

        Parameters
        ----------
        steps
            A formula of what every value has more than the one before it, besides the table's own.
        """
        sign = "<=" if self.shape.monotone == "increasing" else ">="
        for i in range(len(self.values) - 1) if self.shape.monotone else ():
            more = f" + {steps}" if steps else ""
            yield f"{self._value(i)} {sign} {self._value(i + 1)}{more}"

    def _bend(self, i: int) -> str:
        """The change of slope at a point, by its position; its name counts from 1."""
        return f"{self.prefix}bend_{i + 1}"

    def _value(self, i: int) -> str:
        """The value at a point in a formula."""
        return self.values[i] or "0"

    def _bent(self, i: int) -> str:
        """What the changes of slope before a point make of the value there."""
        terms = [
            f"{self.points[i] - self.points[j]!r} * {self._bend(j)}"
            for j in range(1, min(i, len(self.points) - 1))
        ]
        return " + ".join(terms) or "0"

    def _first(self) -> str:
        """The first value: a level of its own, or such that the table is 0 where it must be."""
        if not self._zeros:
            return f"{self.prefix}level"
        zero = self._zeros[0]
        distance = self.points[zero] - self.points[0]
        return f"-({distance!r} * ({self._slope()}) + {self._bent(zero)})"

    def _slope(self) -> str:
        """The first slope: one of its own, or such that the table is 0 at its second zero too."""
        if len(self._zeros) < 2:
            return f"{self.prefix}slope"
        first, second = self._zeros
        distance = self.points[second] - self.points[first]
        return f"(({self._bent(first)}) - ({self._bent(second)})) / {distance!r}"


def check_table_name(name: str, where: str, made: str) -> None:
    """Refuse a name that formulas cannot mention.

    Parameters
    ----------
    name
        Of a map or of an effect.
    where
        Opens the message.
    made
        What the values are called.

    Raises
    ------
    ConfigError
        With what to do.
    """
    if not all(part.isidentifier() and not keyword.iskeyword(part) for part in name.split(".")):
        raise ConfigError(
            f"{where}: must have a name of letters, digits and _, because its values are called "
            f"{made}, but is {name!r}; rename it"
        )
