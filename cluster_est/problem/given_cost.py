"""Costs from Python: an object, a name as in a config, or a function of the residuals."""

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
    """F = function(residuals), with the residuals of all training experiments.

    The function runs in the process of the search, so it may be a lambda. Its derivatives are not
    known. So use `sqp`, `pattern_search`, `nelder_mead` or a population method, and not a
    least-squares method.

    Attributes
    ----------
    function
        A function of an array (residuals,) that returns one number. Each residual is
        (measured - simulated) / sigma.
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
    """Return the cost for a name or a function; return anything else unchanged.

    Raises
    ------
    ProblemError
        If there is no cost with this name.
    """
    if isinstance(given, str):
        name = COST_ALIASES.get(given, given)
        if name not in COSTS:
            raise ProblemError(f"problem.cost: there is no {given!r}{nearest(given, COSTS)}")
        return COSTS[name]()
    is_function = callable(given) and not isinstance(given, type | Cost)
    return FunctionCost(given) if is_function else given
