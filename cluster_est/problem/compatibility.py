"""Checks that priors, special outputs and the cost can be combined.

A prior is weighted against the measurements, which needs their sigmas and a sum of squares. Outputs
with a free scale, a detection limit or ordinal values can only be used with some costs and methods.
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
"""Features of outputs that are not compared value by value, for error messages."""


def besides_plain_outputs(experiment: Experiment) -> list[str]:
    """Return the features of an experiment except outputs that are compared value by value."""
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
    """Refuse a cost, or a missing sigma, that does not suit special outputs.

    Free scales and the bounds of categories are computed by least squares. A value below a
    detection limit counts with a probability that depends on the noise.

    Raises
    ------
    ProblemError
        If an output does not suit the cost, or needs a sigma.
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
                    f"{where}: must have a known sigma if it has a detection_limit, but has none; "
                    "add sigma, without sigma_known = false, because the probability of a value "
                    "below the limit depends on the noise"
                )
            if output.ordinal and experiment.role == "train":
                _check_categories(output, where)


def refuse_ordinal_outputs(space: SearchSpace, key: str, why: str) -> None:
    """Refuse a feature that needs the noise of every output, if there are ordinal outputs.

    Raises
    ------
    ProblemError
        If there are ordinal outputs; the message starts with `key` and ends with the advice `why`.
    """
    if space.has_ordinal_values:
        raise ProblemError(
            f"{key}: needs outputs whose noise is known, but an output is ordinal, so only the "
            f"order of its values is known; {why}"
        )


def _check_categories(output: Output, where: str) -> None:
    """Refuse an ordinal output with fewer than two different values."""
    count = len(np.unique(output.values))
    if len(output.times) and count < 2:
        raise ProblemError(
            f"{where}: an ordinal output must have at least two different values (only their order "
            f"counts), but all {len(output.values)} are {output.values[0]:g}; use a longer part of "
            "the record, or remove the output"
        )


def check_priors(problem: Problem) -> None:
    """Refuse priors that cannot be weighted against the measurements.

    A prior counts like one more measurement, in units of its own standard deviation. So the
    measurements must count in units of their sigmas, and with their squares (H. Theil, A. S.
    Goldberger, Int. Econ. Rev. 2 (1961) 65-78, doi:10.2307/2525589).

    Raises
    ------
    ProblemError
        If the cost or an experiment does not allow priors.
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
    """Refuse curves, cost functions and ordinal outputs, whose residuals are not in sigmas.

    Parameters
    ----------
    problem
        The problem to check.
    where
        Start of the error message.

    Raises
    ------
    ProblemError
        If an experiment has one of these.
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
    """Refuse experiments with an output without a sigma.

    Held-out experiments are also checked, because values that only they have are fitted to them.

    Parameters
    ----------
    problem
        The problem to check.
    why
        The reason why a standard deviation is needed.

    Raises
    ------
    ProblemError
        If an output has no sigma.
    """
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if len(output.times) and not output.has_sigma:
                lacks = "missing" if output.sigma_known else "not known, or only a weight"
                raise ProblemError(
                    f"experiment {experiment.id!r}: {dotted('sigma', output.variable)} is {lacks}, "
                    f"but {why}; give every output its own sigma, without sigma_known = false (for "
                    "a sigma of 1, write 1.000001, because 1 means that no sigma is given)"
                )


def without_priors(problem: Problem) -> Problem:
    """Return the problem without priors; only the bounds of its parameters remain."""
    if all(parameter.prior is None for parameter in problem.parameters):
        return problem
    plain = tuple(replace(parameter, prior=None) for parameter in problem.parameters)
    return replace(problem, parameters=plain)
