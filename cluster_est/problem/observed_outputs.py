"""Outputs with a free scale, a detection limit or an order alone: where they make sense."""

from __future__ import annotations

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space.space import SearchSpace
from workers.messages import Experiment, Output

NOT_PLAIN = "free_scale, free_offset, a detection_limit or ordinal values"
"""What an output may have that is not compared value by value, in error messages."""


def besides_plain_outputs(experiment: Experiment) -> list[str]:
    """Name what an experiment has besides outputs that are compared as they are, value by value."""
    there = {
        "a curve": experiment.curve is not None,
        "a cost function": experiment.cost_function is not None,
        "bounds on signals": bool(experiment.bounds),
        "constraint functions": bool(experiment.constraint_functions),
        "an output with a free scale or offset, a detection limit or ordinal values": any(
            not output.is_plain for output in experiment.outputs
        ),
    }
    return [what for what, has in there.items() if has]


def check_observed_outputs(problem: Problem) -> None:
    """Refuse a cost, or a sigma that is none, with which such outputs would mean something else.

    The best scale and the bounds of categories are those of least squares, and a value below a
    detection limit counts by a probability that depends on the noise.

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
                    f"{where}: must go with the cost sse where it has {NOT_PLAIN}, but the cost is "
                    f"{problem.cost.name}; change one of the two"
                )
            if output.detection_limit is not None and not output.has_sigma:
                raise ProblemError(
                    f"{where}: must have a sigma where it has a detection_limit, for how likely a "
                    "value below it is depends on the noise, but has none; add it"
                )
            if output.ordinal and experiment.role == "train":
                _check_categories(output, where)


def refuse_ordinal_outputs(space: SearchSpace, key: str, why: str) -> None:
    """Refuse a feature that needs to know the noise of every output.

    Raises
    ------
    ProblemError
        Opening with `key`; `why` ends in what to do.
    """
    if space.has_ordinal_values:
        raise ProblemError(
            f"{key}: must go with outputs whose noise is known, but an output is ordinal, of which "
            f"the order of the values is known alone; {why}"
        )


def _check_categories(output: Output, where: str) -> None:
    """Refuse values that are all the same, or none but one."""
    count = len(np.unique(output.values))
    if len(output.times) and count < 2:
        raise ProblemError(
            f"{where}: must have at least two different values where it is ordinal, for an order "
            f"is one between them, but all {len(output.values)} are {output.values[0]:g}; use more "
            "of the record, or leave the output out"
        )
