"""Dimensions of quantities: powers of the base units, whatever the size of a unit."""

from __future__ import annotations

from dataclasses import dataclass

BASES = ("mass", "length", "time", "current", "temperature", "amount", "light", "angle")


@dataclass(frozen=True)
class Dimension:
    """The powers of `BASES` in a unit.

    An angle has a power of its own, or the speed of a shaft could not be told from a rate.

    Attributes
    ----------
    powers
        In the order of `BASES`.
    absolute
        0 of the unit is that of the quantity; false for degrees Celsius.
    """

    powers: tuple[float, ...]
    absolute: bool = True

    def __mul__(self, other: Dimension) -> Dimension:
        """Return the dimension of a product."""
        pairs = zip(self.powers, other.powers, strict=True)
        return Dimension(tuple(a + b for a, b in pairs))

    def __truediv__(self, other: Dimension) -> Dimension:
        """Return the dimension of a quotient."""
        pairs = zip(self.powers, other.powers, strict=True)
        return Dimension(tuple(a - b for a, b in pairs))

    def to(self, power: float) -> Dimension:
        """Return the dimension of a power."""
        return Dimension(tuple(power * own for own in self.powers))

    def same_as(self, *others: Dimension) -> bool:
        """Return whether it is one of these, wherever their zeros are."""
        return any(self.powers == other.powers for other in others)

    @property
    def without_angle(self) -> tuple[float, ...]:
        """The powers of all but the angle, which many tools leave out."""
        return self.powers[:-1]


def dimension(**powers: float) -> Dimension:
    """Return a dimension by the names of its bases: `dimension(length=1, time=-1)`."""
    return Dimension(tuple(float(powers.get(name, 0.0)) for name in BASES))


NUMBER = dimension()
TIME = dimension(time=1)
LENGTH, ANGLE = dimension(length=1), dimension(angle=1)
SPEED, TURNING = LENGTH / TIME, ANGLE / TIME
MASS, AMOUNT = dimension(mass=1), dimension(amount=1)
FORCE = MASS * LENGTH / TIME / TIME
TORQUE = FORCE * LENGTH
TEMPERATURE = dimension(temperature=1)
AREA = LENGTH * LENGTH
VOLUME = AREA * LENGTH
PRESSURE = FORCE / AREA
FLOW, MASS_FLOW = VOLUME / TIME, MASS / TIME
POWER = FORCE * SPEED
HEAT_FLUX = POWER / AREA
CURRENT = dimension(current=1)
CHARGE = CURRENT * TIME
DENSITY, CONCENTRATION = MASS / VOLUME, AMOUNT / VOLUME
