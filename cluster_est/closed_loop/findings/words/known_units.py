"""Dimensions of the variables of a problem, as its FMU or its config has their units."""

from __future__ import annotations

from collections.abc import Mapping

from cluster_est.closed_loop.findings.words.dimensions import Dimension
from cluster_est.closed_loop.findings.words.unit_text import dimension_of_text
from workers.effects.site import is_difference, parts_of
from workers.fmu.description import ModelDescription
from workers.fmu.xml import BASE_UNITS, UnitDefinition


class KnownUnits:
    """Units of variables and signals, as dimensions.

    Parameters
    ----------
    description
        Of the FMU, with the units that a config gives to its variables.
    given
        Units that a config names, by variable or signal.
    """

    def __init__(self, description: ModelDescription, given: Mapping[str, str]) -> None:
        self._description, self._given = description, given

    def unit(self, name: str) -> str:
        """Return the unit of a variable, a signal or a difference "a - b"; "" if none is known."""
        name = name if self._has(name) else parts_of(name)[0]
        if name in self._description.variables:
            return self._description.variables[name].unit
        return self._given.get(name, "")

    def of(self, name: str) -> Dimension | None:
        """Return the dimension of a variable, a signal or a difference; None if it is unknown.

        A difference of two dimensions has none. One of two temperatures has its zero in itself.
        """
        if not self._has(name) and is_difference(name):
            first, second, *_ = parts_of(name)
            one, other = self.of(first), self.of(second)
            return one if one is not None and one == other else None
        unit = self.unit(name)
        return dimension_of(unit, self._description.units)

    def _has(self, name: str) -> bool:
        return name in self._description.variables or name in self._given


def dimension_of(unit: str, definitions: Mapping[str, UnitDefinition]) -> Dimension | None:
    """Return the dimension of a unit by an FMU's definition, or by its text.

    Where both are known and contradict each other in more than an angle, which tools often leave
    out, nothing is known.
    """
    by_text = dimension_of_text(unit)
    definition = definitions.get(unit)
    if definition is None:
        return by_text
    kg, m, s, ampere, kelvin, mol, cd, rad = map(float, definition.powers)
    assert len(BASE_UNITS) == len(definition.powers)
    powers = (kg, m, s, ampere, kelvin, mol, cd, rad)
    defined = Dimension(powers, absolute=definition.offset == 0.0)
    if by_text is None:
        return defined
    if by_text.without_angle != defined.without_angle:
        return None
    return by_text if by_text.powers[-1] else defined
