"""Steps after a search; if one of them fails, the result of the search is still returned."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from cluster_est.errors import BudgetError, ClusterEstError
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty import Uncertainty, not_assessed

LOG = logging.getLogger("cluster_est")
LOG.addHandler(logging.NullHandler())  # to see the traceback of a fault, add another handler
Value = TypeVar("Value")
Substitute = TypeVar("Substitute")


class GuardedSteps:
    """Runs steps, and keeps a sentence on each step that failed.

    Attributes
    ----------
    failed
        Sentences: what is missing in the result, and why.
    """

    def __init__(self) -> None:
        self.failed: list[str] = []

    def do(self, what: str, step: Callable[[], Value], instead: Substitute) -> Value | Substitute:
        """Return the value of a step, or a substitute if the step fails.

        Parameters
        ----------
        what
            The part of the result that the step computes, as the subject of a sentence.
        step
            Computes this part.
        instead
            The substitute.

        Raises
        ------
        BudgetError
            If the budget is used up.
        """
        try:
            return step()
        except BudgetError:  # the run can be continued with a larger budget
            raise
        except ClusterEstError as error:
            self.failed.append(f"{what} could not be computed: {error}")
        except Exception as error:
            LOG.error("%s could not be computed", what, exc_info=True)
            self.failed.append(
                f"{what} could not be computed because of a fault in cluster-est; the estimates "
                f"are not affected; please report this error ({type(error).__name__}: {error})"
            )
        return instead

    def assessed(
        self, space: SearchSpace, solution: Solution, assess: Callable[[], Uncertainty]
    ) -> Uncertainty:
        """Return the uncertainty of a solution, marked as unknown if its computation fails.

        Parameters
        ----------
        space, solution
            The search space, and the solution.
        assess
            Computes the uncertainty.
        """
        nothing = not_assessed(space, solution, "their computation failed")
        return self.do(f"the intervals of {space.size} unknowns", assess, nothing)
