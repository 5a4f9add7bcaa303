"""The contract of a cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from workers.messages import FloatArray


class Cost(ABC):
    """Makes one number of the residuals of all experiments."""

    name: ClassVar[str]
    """What the config calls it."""

    sum_of_squares: ClassVar[bool]
    """Whether `value` is the sum of squares of `terms`, which least-squares methods need."""

    @abstractmethod
    def terms(self, residuals: FloatArray) -> FloatArray:
        """The residuals as a least-squares method should see them; (n,) to (n,)."""

    @abstractmethod
    def value(self, residuals: FloatArray) -> float:
        """The cost of all residuals, (n,), at one point. It does not depend on their order."""
