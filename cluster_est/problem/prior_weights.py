"""Whether priors can be weighed against the measurements."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.errors import ProblemError
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.toml import dotted


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
            f'{dotted("parameters", name)}.prior: must go with the cost "sse", in which it counts '
            "like a "
            f"measurement, but cost.name is {problem.cost.name!r}; change one of the two"
        )
    refuse_distances(problem, f"{dotted('parameters', name)}.prior")
    need_sigmas(
        problem, f"the prior of parameter {name} is weighed against it by its standard deviation"
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
                    f"{where}: must go with outputs measured over time, each with its sigma, but "
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
                    f"experiment {experiment.id!r}: {dotted('sigma', output.variable)} is missing; "
                    f"{why}; "
                    "give every output its own, and write 1.000001 where it is 1, which stands "
                    "for none"
                )


def without_priors(problem: Problem) -> Problem:
    """Return the problem with no more known of its parameters than their bounds."""
    if all(parameter.prior is None for parameter in problem.parameters):
        return problem
    plain = tuple(replace(parameter, prior=None) for parameter in problem.parameters)
    return replace(problem, parameters=plain)
