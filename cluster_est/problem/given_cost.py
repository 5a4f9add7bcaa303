"""A cost as Python may give it: an object, a name as in a config, or a function of residuals."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COST_ALIASES, COSTS, Cost
from workers.fmu.description import nearest
from workers.messages import FloatArray, IntArray
from workers.messages.checks import shown


@dataclass(frozen=True)
class FunctionCost(Cost):
    """F = function(residuals), of all residuals of all training experiments.

    It runs in the process that searches, so that it may be a lambda or hold anything. Nothing is
    known of its derivatives by the residuals: `sqp`, `pattern_search`, `nelder_mead` and the
    populations minimise it, least squares cannot.

    Attributes
    ----------
    function
        Of an array (residuals,), each (measured - simulated) / sigma, returning one number.
    """

    name: ClassVar[str] = "function"

    function: Callable[[FloatArray], float]

    @override
    def value(self, residuals: FloatArray, outputs: IntArray) -> float:
        if not len(residuals):
            return 0.0
        found = self.function(np.array(residuals))
        try:
            return float(found)
        except (TypeError, ValueError):
            raise ProblemError(
                "problem.cost: must return one number for an array of residuals, but returned "
                f"{shown(found)}"
            ) from None

    @override
    def weights(self, residuals: FloatArray, outputs: IntArray) -> FloatArray | None:
        return None


def as_cost(given: Any) -> Any:
    """Return a cost of a name or of a function; anything else as it is, for others to refuse.

    Raises
    ------
    ProblemError
        If there is no cost of that name.
    """
    if isinstance(given, str):
        name = COST_ALIASES.get(given, given)
        if name not in COSTS:
            raise ProblemError(f"problem.cost: there is no {given!r}{nearest(given, COSTS)}")
        return COSTS[name]()
    is_function = callable(given) and not isinstance(given, type | Cost)
    return FunctionCost(given) if is_function else given
