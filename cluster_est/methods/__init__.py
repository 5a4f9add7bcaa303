"""Methods: what picks the next points. One file a method.

A new method is one file with a subclass of `Method` and one line here.
"""

from __future__ import annotations

from cluster_est.methods.base import Method
from cluster_est.methods.least_squares import LeastSquares
from cluster_est.methods.scipy_least_squares import ScipyLeastSquares

METHODS: dict[str, type[Method]] = {
    LeastSquares.name: LeastSquares,
    ScipyLeastSquares.name: ScipyLeastSquares,
}

ALIASES = {"lsqnonlin": LeastSquares.name}
"""Names that users of other tools know."""

__all__ = ["ALIASES", "METHODS", "Method"]
