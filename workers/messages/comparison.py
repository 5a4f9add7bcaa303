"""Comparisons of a simulation with other things than outputs: curves, bounds, functions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages.types import FloatArray


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
    """

    module: str
    name: str
    source: str = field(default="", repr=False)
    equality: bool = False
    label: str = ""
