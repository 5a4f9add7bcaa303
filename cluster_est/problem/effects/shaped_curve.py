"""The free curve of an effect as a table of values, smooth and monotone where that is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import numpy as np

from cluster_est.errors import ConfigError, EffectError
from cluster_est.problem.effects.table_values import (
    Monotone,
    TableShape,
    TableUnknown,
    ValueTable,
    check_table_name,
)
from cluster_est.problem.formulas import ParameterConstraint, parse_constraint
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import NormalPrior
from workers.effects.kinds import EffectForm
from workers.messages.checks import check_choice, check_number, is_number, shown

UNSHAPED = TableShape()
"""Free values: nothing is known of a curve."""
ENDS = ("low", "high")
"""The coefficients between which a free curve has its points."""


@dataclass(frozen=True)
class ShapedCurve:
    """A free curve of which more is known than its form.

    Attributes
    ----------
    name, form
        Of the effect.
    shape
        What is known; something must be.
    coefficients
        Parameters of the form, as they would be without.
    chosen
        Keys, such as "bounds", that were declared of each coefficient beside its start.

    Raises
    ------
    ConfigError
        If the form is no free curve, or what is declared contradicts itself.
    """

    name: str
    form: EffectForm
    shape: TableShape
    coefficients: tuple[Parameter, ...]
    chosen: Mapping[str, Sequence[str]]

    def __post_init__(self) -> None:
        where = f"effects.{self.name}"
        if not self.form.free:
            key = next(key for key in vars(UNSHAPED) if self._says(key))
            raise ConfigError(
                f"{where}.{key}: must go with a free curve, which is a form like table, "
                f"coulomb_table or characteristic, but the form is {self.form.name!r}; leave it out"
            )
        check_table_name(self.name, where, "NAME.k1, NAME.k2, ...")
        if self.form.is_characteristic and self.shape.monotone == "decreasing":
            raise ConfigError(
                f'{where}.monotone: must be "increasing", because beyond its ends a characteristic '
                "is the signal itself, but is 'decreasing'; use one that increases, and an effect "
                "gain that changes the sign"
            )
        if self.shape.slope_change is not None:
            self._check_free_of_keys(where)
        self.table.check()

    def _says(self, key: str) -> bool:
        return bool(getattr(self.shape, key) != getattr(UNSHAPED, key))

    def _check_free_of_keys(self, where: str) -> None:
        """Refuse keys of what follows from other values, or is held."""
        whys = dict.fromkeys(self.form.curve_values, "the value follows from changes of slope")
        whys |= dict.fromkeys(ENDS, "changes of slope are counted over fixed points")
        for name, why in whys.items():
            for key in self.chosen.get(name or "", ()):
                if not (name in ENDS and key == "fixed"):
                    raise ConfigError(
                        f"{where}.parameters.{name}.{key}: must be left out where there is "
                        f"slope_change, because {why}; remove one of the two"
                    )

    @cached_property
    def _starts(self) -> dict[str, float]:
        """Of the coefficients, by their names in the form."""
        cut = len(self.name) + 1
        return {p.name[cut:]: p.start for p in self.coefficients}

    @cached_property
    def table(self) -> ValueTable:
        """The values over their points."""
        low, high = (self._starts[name] for name in ENDS)
        if not low < high:
            raise ConfigError(
                f"effects.{self.name}.parameters.low.start: must be below that of high, {high:g}, "
                f"but is {low:g}; change one"
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
        """The coefficients in their order, with what they follow from before them."""
        if self.shape.slope_change is None:
            return tuple(self._bounded(p) for p in self.coefficients)
        texts = dict(self.table.expressions())
        ends = [f"{self.name}.{end}" for end in ENDS]
        found = [_auxiliary(unknown) for unknown in self.table.unknowns()]
        for p in self.coefficients:
            if p.name in texts:
                found.append(Parameter(p.name, p.start, unit=p.unit, expression=texts[p.name]))
            else:
                found.append(replace(p, fixed=True) if p.name in ends else p)
        return tuple(found)

    def _bounded(self, parameter: Parameter) -> Parameter:
        """A value within the bounds of all, unless it has its own."""
        name = parameter.name[len(self.name) + 1 :]
        if name not in self.form.curve_values or "bounds" in self.chosen.get(name, ()):
            return parameter
        low, high = self.shape.bounds
        return replace(parameter, lower=low, upper=high)

    def constraints(self) -> tuple[ParameterConstraint, ...]:
        """Those of a monotone curve; of a characteristic, that signal and curve together are."""
        known = [*(name for name in self.table.values if name is not None)]
        steps = ""
        if self.form.is_characteristic:
            low, high = (f"{self.name}.{end}" for end in ENDS)
            known += [low, high]
            steps = f"({high} - {low}) / {len(self.table.points) - 1}"
        found = []
        for text in self.table.order(steps):
            found += parse_constraint(text, known, f"effects.{self.name}.monotone")
        return tuple(found)


def checked_shape(
    slope_change: float | None, monotone: Monotone, bounds: Sequence[float] | None
) -> TableShape:
    """Return what is known of a curve, each of the kind that it must be.

    Raises
    ------
    EffectError
        If one is of another kind.
    """
    if slope_change is not None:
        check_number(slope_change, "effect.slope_change", EffectError, above=0.0)
    check_choice(monotone, get_args(Monotone), "effect.monotone", EffectError)
    if bounds is None:
        return TableShape(slope_change, monotone)
    pair = tuple(bounds) if isinstance(bounds, Sequence) else ()
    if len(pair) != 2 or not all(is_number(bound) for bound in pair):
        raise EffectError(
            f"effect.bounds: must be two numbers (lower, upper) but is {shown(bounds)}"
        )
    return TableShape(slope_change, monotone, (float(pair[0]), float(pair[1])))


def _auxiliary(unknown: TableUnknown) -> Parameter:
    return Parameter(
        unknown.name,
        unknown.start,
        unknown.lower,
        unknown.upper,
        auxiliary=True,
        prior=None if unknown.sd is None else NormalPrior(mean=0.0, sd=unknown.sd),
    )
