"""Outputs with a free scale or a detection limit: the problems that they make sense in."""

from __future__ import annotations

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem
from workers.messages import Experiment


def besides_plain_outputs(experiment: Experiment) -> list[str]:
    """Name what an experiment has besides outputs that are compared as they are, value by value."""
    there = {
        "a curve": experiment.curve is not None,
        "a cost function": experiment.cost_function is not None,
        "bounds on signals": bool(experiment.bounds),
        "constraint functions": bool(experiment.constraint_functions),
        "an output with a free scale or offset, or a detection limit": any(
            not output.is_plain for output in experiment.outputs
        ),
    }
    return [what for what, has in there.items() if has]


def check_observed_outputs(problem: Problem) -> None:
    """Refuse a cost, or a sigma that is none, with which such outputs would mean something else.

    The best scale is that of least squares, and a value below a detection limit counts by a
    probability that depends on the noise.

    Raises
    ------
    ProblemError
        With what to change.
    """
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if output.is_plain:
                continue
            where = f"experiment {experiment.id!r}: output {output.variable}"
            if not isinstance(problem.cost, SumSquared):
                raise ProblemError(
                    f"{where}: must go with the cost sse where it has free_scale, free_offset or a "
                    f"detection_limit, but the cost is {problem.cost.name}; change one of the two"
                )
            if output.detection_limit is not None and not output.has_sigma:
                raise ProblemError(
                    f"{where}: must have a sigma where it has a detection_limit, for how likely a "
                    "value below it is depends on the noise, but has none; add it"
                )
