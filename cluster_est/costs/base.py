"""The interface of a cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from cluster_est.plug_in import check_class_attributes
from workers.messages import FloatArray, IntArray, Reduction


class Cost(ABC):
    """Makes one number F of the residuals of all experiments. Its attributes are its options.

    `outputs` says which residuals belong together: those of one output have one number, counted
    from 0, in all experiments. It is empty where nobody knows, as where a Python function returns
    the residuals, and all of them count as one output's then. Costs that treat all residuals alike
    need not look at it.
    """

    name: ClassVar[str]
    """Its name in a config."""

    reduction: ClassVar[Reduction | None] = None
    """A number that may take the place of the residuals of an output in an experiment, because
    `value` of it is the same. None for a cost that needs each residual, as most costs do."""

    is_logarithm: ClassVar[bool] = False
    """Whether it is the logarithm of something that has units, as a log likelihood is."""

    def __init_subclass__(cls) -> None:
        check_class_attributes(cls)

    @abstractmethod
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        """Return the cost of all residuals (n,) at one point.

        It does not depend on their order, and is 0 without any, as in a search for a point that
        satisfies constraints.
        """

    @abstractmethod
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        """Return the weights of the residuals' squares for a least-squares method at this point.

        With weights w (n,) the gradient of F is 2 w r, so that sqrt(w) r and sqrt(w) J make the
        right gradient and, where the curvature of F is at most that of the squares, a step that
        lowers F. None for a cost that is no function of residuals which a method could use in this
        way.
        """
