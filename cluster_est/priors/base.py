"""The contract of a prior: what is known of a value counts like one more measurement of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from cluster_est.errors import ProblemError
from cluster_est.plug_in import check_class_attributes


class Prior(ABC):
    """What is known of a parameter before the measurements.

    A prior is normal in some function of the value, so that it counts in a sum of squares like a
    measurement of that: by residual(value)^2. The derivatives of its residual need no simulation.

    A subclass is a frozen dataclass whose fields are the keys of a config.
    """

    name: ClassVar[str]
    """As a config names it."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @property
    @abstractmethod
    def centre(self) -> float:
        """The value with the largest density, in the parameter's unit."""

    @abstractmethod
    def residual(self, value: float) -> float:
        """How far a value lies from the centre, in standard deviations, with its sign."""

    @abstractmethod
    def slope(self, value: float) -> float:
        """Return d residual / d value."""

    @abstractmethod
    def log_density(self, value: float) -> float:
        """Return ln p(value), but for a constant: of the value itself, whatever is normal."""

    @abstractmethod
    def said(self) -> str:
        """Return it in words, for messages: "normal, 2 +- 0.1"."""

    def check(self, where: str, start: float, lower: float, upper: float) -> None:
        """Refuse a prior that does not go with the start and the bounds of its parameter.

        Raises
        ------
        ProblemError
            With what to change.
        """
        del start  # a prior may ask more of it
        if not lower <= self.centre <= upper:
            raise ProblemError(
                f"{where}.prior: must have its centre within the bounds [{lower:g}, {upper:g}] but "
                f"is {self.said()}; move one of the two"
            )
