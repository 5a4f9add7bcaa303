"""Steps after a search, none of which may take away what the search has found."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

from cluster_est.errors import BudgetError, ClusterEstError
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.uncertainty import Uncertainty, not_assessed

LOG = logging.getLogger("cluster_est")
LOG.addHandler(logging.NullHandler())  # who wants to see the traceback of a fault adds another
Value = TypeVar("Value")
Substitute = TypeVar("Substitute")


class GuardedSteps:
    """Does steps one after the other, and keeps a sentence on each that failed.

    Attributes
    ----------
    failed
        What is missing in the result, and why.
    """

    def __init__(self) -> None:
        self.failed: list[str] = []

    def do(self, what: str, step: Callable[[], Value], instead: Substitute) -> Value | Substitute:
        """Return what a step gives, or something else where it fails.

        Parameters
        ----------
        what
            Which part of the result it makes, as the begin of a sentence.
        step
            Makes it.
        instead
            What the result has in its place.

        Raises
        ------
        BudgetError
            If the budget is used up.
        """
        try:
            return step()
        except BudgetError:  # with a larger one the run goes on
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
        """Return the uncertainty of a solution; one that says that it is not known where it fails.

        Parameters
        ----------
        space, solution
            The space that was searched, and the solution.
        assess
            Computes it.
        """
        nothing = not_assessed(space, solution, "their computation failed")
        return self.do(f"the intervals of {space.size} unknowns", assess, nothing)
