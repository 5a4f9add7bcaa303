"""Dimensions of quantities: what a unit's text or an FMU says that a variable measures.

A dimension is the powers of the base units in a unit, whatever the size of that. An angle has a
power of its own, or the speed of a shaft could not be told from a rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from cluster_est.closed_loop.findings.unit_text import Powers, powers, read_unit
from workers.effects.site import is_difference, parts_of
from workers.fmu.description import ModelDescription
from workers.fmu.xml import UnitDefinition


@dataclass(frozen=True)
class Dimension:
    """The powers of the base units in a unit.

    Attributes
    ----------
    powers
        In the order of `unit_text.BASES`.
    absolute
        0 of the unit is that of the quantity; false for degrees Celsius.
    """

    powers: Powers
    absolute: bool = True

    def same_as(self, *others: Dimension) -> bool:
        """Return whether it is one of these, wherever their zeros are."""
        return any(self.powers == other.powers for other in others)

    @property
    def without_angle(self) -> Powers:
        """The powers of all but the angle, which many tools leave out."""
        return self.powers[:-1]


def dimension(**given: float) -> Dimension:
    """Return a dimension by the names of its bases: `dimension(length=1, time=-1)`."""
    return Dimension(powers(**given))


NUMBER = dimension()
LENGTH, ANGLE = dimension(length=1), dimension(angle=1)
SPEED, TURNING = dimension(length=1, time=-1), dimension(angle=1, time=-1)
ACCELERATION, TURNING_FASTER = dimension(length=1, time=-2), dimension(angle=1, time=-2)
MASS, AMOUNT = dimension(mass=1), dimension(substance=1)
FORCE = dimension(mass=1, length=1, time=-2)
TORQUE = dimension(mass=1, length=2, time=-2)
TEMPERATURE = dimension(temperature=1)
AREA, VOLUME = dimension(length=2), dimension(length=3)
PRESSURE = dimension(mass=1, length=-1, time=-2)
FLOW, MASS_FLOW = dimension(length=3, time=-1), dimension(mass=1, time=-1)
POWER, HEAT_FLUX = dimension(mass=1, length=2, time=-3), dimension(mass=1, time=-3)
CURRENT, CHARGE = dimension(current=1), dimension(current=1, time=1)
DENSITY, CONCENTRATION = dimension(mass=1, length=-3), dimension(substance=1, length=-3)


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
        return dimension_of(self.unit(name), self._description.units)

    def _has(self, name: str) -> bool:
        return name in self._description.variables or name in self._given


def dimension_of(unit: str, definitions: Mapping[str, UnitDefinition]) -> Dimension | None:
    """Return the dimension of a unit by an FMU's definition, or by its text.

    Where both are known and contradict each other in more than an angle, which tools often leave
    out, nothing is known.
    """
    said = read_unit(unit)
    by_text = None if said is None else Dimension(said.powers, said.absolute)
    definition = definitions.get(unit)
    if definition is None:
        return by_text
    defined = Dimension(tuple(map(float, definition.powers)), absolute=definition.offset == 0.0)
    if by_text is None:
        return defined
    if by_text.without_angle != defined.without_angle:
        return None
    return by_text if by_text.powers[-1] else defined
