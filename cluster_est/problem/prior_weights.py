"""Whether priors can be weighed against the measurements."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem


def check_priors(problem: Problem) -> None:
    """Refuse priors that have no measure in common with the measurements.

    A prior counts like one more measurement, in its own standard deviations. So the measurements
    must count in theirs, and by their squares (H. Theil, A. S. Goldberger, Int. Econ. Rev. 2 (1961)
    65-78, doi:10.2307/2525589).

    Raises
    ------
    ProblemError
        With what to change.
    """
    name = next((p.name for p in problem.parameters if p.prior is not None), "")
    if not name:
        return
    if not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            f'parameters.{name}.prior: must go with the cost "sse", in which it counts like a '
            f"measurement, but cost.name is {problem.cost.name!r}; change one of the two"
        )
    for e in problem.indices("train"):
        for output in problem.experiments[e].outputs:
            if len(output.times) and not output.has_sigma:
                where = f"experiment {problem.experiments[e].id!r}: sigma.{output.variable}"
                raise ProblemError(
                    f"{where} is missing; the prior of parameter {name} is weighed against the "
                    "measurements by their standard deviations, so give each output its own"
                )


def without_priors(problem: Problem) -> Problem:
    """Return the problem with no more known of its parameters than their bounds."""
    if all(parameter.prior is None for parameter in problem.parameters):
        return problem
    plain = tuple(replace(parameter, prior=None) for parameter in problem.parameters)
    return replace(problem, parameters=plain)
