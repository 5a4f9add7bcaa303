"""The logarithm of the posterior density of the unknowns, from the cost of a point."""

from __future__ import annotations

import math

import numpy as np

from cluster_est.costs.likelihood import GaussianLikelihood
from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.methods.method import Evaluation
from cluster_est.problem.compatibility import check_priors, need_sigmas, refuse_distances
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import Unknown
from cluster_est.toml import dotted
from workers.messages import FloatArray


def log_density(space: SearchSpace, x: FloatArray, at: Evaluation) -> float:
    """Return ln p(x | measurements) in search coordinates, but for a constant.

    The likelihood is exp(-F / 2) with F the sum of squares over the squared sigmas, or the Gaussian
    likelihood's F, at the sigmas that it estimates. An unknown without a prior is uniform between
    its bounds on its own scale: with a log scale, its logarithm is.

    Parameters
    ----------
    space, x
        The point.
    at
        Its evaluation.
    """
    if not at.feasible or not math.isfinite(at.cost):
        return -math.inf
    own = (_beside_the_cost(u, float(x[i])) for i, u in enumerate(space.unknowns) if u.prior)
    return -0.5 * at.cost + sum(own)


def _beside_the_cost(unknown: Unknown, searched: float) -> float:
    """What the density of a prior has besides the square of its residual, which is in the cost."""
    value, prior = unknown.to_physical(searched), unknown.prior
    assert prior is not None
    change = math.log(value) if unknown.log and value > 0.0 else 0.0
    return prior.log_density(value) + 0.5 * prior.residual(value) ** 2 + change


LEAST_WALKERS = 8
"""Differences of others are taken from half of them."""


def check_posterior(space: SearchSpace, walkers: int = 0) -> None:
    """Refuse to draw where the cost is no likelihood, or there are too few walkers.

    Parameters
    ----------
    space
        Of the unknowns.
    walkers
        Their number; 0 for as many as the unknowns need.

    Raises
    ------
    ProblemError
        With what to change.
    """
    problem, least = space.problem, max(LEAST_WALKERS, 2 * space.size)
    if walkers and walkers < least:
        raise ProblemError(
            f"uncertainty.walkers: must be at least {least}, twice the unknowns and no fewer than "
            f"{LEAST_WALKERS}, but is {walkers}; 0 takes as many as are needed"
        )
    if space.equality.any():
        name = space.constraint_names[int(np.argmax(space.equality))]
        raise ProblemError(
            f"uncertainty.posterior: no draw satisfies the equality {name!r} exactly; make the "
            "parameter follow from the others by an expression, or take uncertainty.profiles"
        )
    check_priors(problem)
    refuse_distances(problem, "uncertainty.posterior")
    if isinstance(problem.cost, SumSquared):
        need_sigmas(
            problem,
            "uncertainty.posterior makes a likelihood of its squares by its standard deviation "
            '(or take cost.name = "likelihood", which estimates it)',
        )
    elif not isinstance(problem.cost, GaussianLikelihood):
        raise ProblemError(
            'uncertainty.posterior: must go with the cost "sse" or "likelihood", which are '
            f"likelihoods, but cost.name is {problem.cost.name!r}; change one of the two"
        )
    for unknown, low, high in zip(space.unknowns, space.lower, space.upper, strict=True):
        if unknown.prior is None and not np.isfinite([low, high]).all():
            parameter = unknown.parameter
            raise ProblemError(
                f"{dotted('parameters', parameter.name)}: must have finite bounds or a prior for "
                f"uncertainty.posterior but has the bounds [{parameter.lower:g}, "
                f"{parameter.upper:g}] on a {parameter.scale} scale; give it one of the two"
            )
