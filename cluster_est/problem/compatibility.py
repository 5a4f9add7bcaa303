"""Whether priors, outputs that are not compared as they are, and the cost go together.

A prior is weighed against the measurements, which takes their sigmas and a sum of squares. An
output with a free scale, a detection limit or an order alone makes sense with some costs and
methods only.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.toml import dotted
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
    """Refuse a cost, or a missing sigma, with which such outputs would mean something else.

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
                    f'{where}: has {NOT_PLAIN}, so cost.name must be "sse", but it is '
                    f'"{problem.cost.name}"; change one of the two'
                )
            if output.detection_limit is not None and not output.has_sigma:
                raise ProblemError(
                    f"{where}: must have a sigma if it has a detection_limit, but has none; add "
                    "sigma, because the probability of a value below the limit depends on the noise"
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
            f"{key}: needs outputs whose noise is known, but an output is ordinal, so only the "
            f"order of its values is known; {why}"
        )


def _check_categories(output: Output, where: str) -> None:
    """Refuse values that are all the same, or none but one."""
    count = len(np.unique(output.values))
    if len(output.times) and count < 2:
        raise ProblemError(
            f"{where}: an ordinal output must have at least two different values, because only "
            f"their order counts, but all {len(output.values)} are {output.values[0]:g}; use a "
            "longer part of the record, or remove the output"
        )


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
            f'{dotted("parameters", name)}.prior: needs the cost "sse", in which a prior counts '
            f"like a measurement, but cost.name is {problem.cost.name!r}; change one of the two"
        )
    refuse_distances(problem, f"{dotted('parameters', name)}.prior")
    need_sigmas(
        problem,
        f"the prior of parameter {name} is weighed against the measurements by their "
        "standard deviation",
    )


def refuse_distances(problem: Problem, where: str) -> None:
    """Refuse curves, cost functions and ordinal outputs: they are in no measurement's sigmas.

    Parameters
    ----------
    problem
        Whose experiments are looked at.
    where
        Opens the message.

    Raises
    ------
    ProblemError
        With what to change.
    """
    for experiment in problem.experiments:
        for key, there in (
            ("a curve", experiment.curve is not None),
            ("a cost.function", experiment.cost_function is not None),
            ("an ordinal output", any(output.ordinal for output in experiment.outputs)),
        ):
            if there:
                raise ProblemError(
                    f"{where}: needs outputs that are measured over time and have a sigma, but "
                    f"experiment {experiment.id!r} has {key}; remove one of the two"
                )


def need_sigmas(problem: Problem, why: str) -> None:
    """Refuse experiments with an output whose noise is not declared.

    Held-out ones too: values that only they have are fitted to them.

    Parameters
    ----------
    problem
        Whose experiments are looked at.
    why
        What a standard deviation is needed for.

    Raises
    ------
    ProblemError
        With what to add.
    """
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if len(output.times) and not output.has_sigma:
                raise ProblemError(
                    f"experiment {experiment.id!r}: {dotted('sigma', output.variable)} is missing, "
                    f"but {why}; give every output its own sigma (for a sigma of 1, write "
                    "1.000001, because 1 means that no sigma is given)"
                )


def without_priors(problem: Problem) -> Problem:
    """Return the problem with no more known of its parameters than their bounds."""
    if all(parameter.prior is None for parameter in problem.parameters):
        return problem
    plain = tuple(replace(parameter, prior=None) for parameter in problem.parameters)
    return replace(problem, parameters=plain)
