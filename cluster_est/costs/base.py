"""The contract of a cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from workers.messages import FloatArray, IntArray, Reduction


class Cost(ABC):
    """Makes one number F of the residuals of all experiments. Its attributes are its options.

    `outputs` says which residuals belong together: those of one output have one number, counted
    from 0, in all experiments. Costs that treat all residuals alike need not look at it.
    """

    name: ClassVar[str]
    """What the config calls it."""

    smooth: ClassVar[bool] = True
    """Whether it has a gradient everywhere, and so `weights`."""

    reduction: ClassVar[Reduction | None] = None
    """What may take the place of the residuals of an output in an experiment: one number, of which
    `value` is the same. None for a cost that needs each of them, which is most costs."""

    @abstractmethod
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        """The cost of all residuals, both (n,), at one point. It does not depend on their order."""

    @abstractmethod
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        """How a least-squares method should weight the squares of the residuals at this point.

        With weights w (n,) the gradient of F is 2 w r, so that sqrt(w) r and sqrt(w) J make the
        right gradient and, where F bends no more than the squares, a step that lowers F. None for
        a cost that is no function of residuals which a method could use in this way.
        """
