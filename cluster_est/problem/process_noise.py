"""Process noise: noise that acts on the states; the simulation is then a Kalman filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.compatibility import besides_plain_outputs
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from workers.messages import Experiment

NEAR_LOWER_BOUND = 1e-6
"""Negligible distance of a strength from its lower bound, over the distance of the bounds."""
FILTERED = (
    "process noise ({names}): errors, curves and residuals come from predictions from each "
    "measured time to the next, which an extended Kalman filter makes, and not from one simulation "
    "of the whole record"
)


def noise_names(problem: Problem) -> list[str]:
    """Return the names of the effects that are process noise."""
    return [effect.name for effect in problem.effects if effect.is_noise]


def noise_parameters(problem: Problem) -> tuple[Parameter, ...]:
    """Return the parameters of the effects that are process noise."""
    names = noise_names(problem)
    return tuple(p for p in problem.parameters if p.name.rpartition(".")[0] in names)


def without_noise(problem: Problem) -> Problem:
    """Return the problem without process noise; no filter then corrects its simulations."""
    names, own = noise_names(problem), noise_parameters(problem)
    return replace(
        problem,
        effects=tuple(effect for effect in problem.effects if effect.name not in names),
        parameters=tuple(p for p in problem.parameters if p not in own),
    )


def process_noise_notes(problem: Problem) -> tuple[str, ...]:
    """Return a note on the meaning of errors if there is process noise."""
    names = noise_names(problem)
    return (FILTERED.format(names=", ".join(names)),) if names else ()


def vanished_noise(
    problem: Problem, values: Mapping[str, float], bounds: Mapping[str, tuple[float, float]]
) -> tuple[str, ...]:
    """Return notes on noise strengths that ended at their lower bound.

    Parameters
    ----------
    problem
        The fitted problem.
    values, bounds
        Values and bounds of the estimates, by label.
    """
    found = []
    for effect in problem.effects:
        own = [label for label in values if label.partition("[")[0] == f"{effect.name}.q"]
        for label in own if effect.is_noise else []:
            lower, upper = bounds[label]
            if values[label] <= lower + NEAR_LOWER_BOUND * (
                upper - lower if np.isfinite(upper) else 1.0
            ):
                found.append(
                    f"{label} ended at its lower bound, {values[label]:.3g}: the data are "
                    "explained equally well without this process noise. The "
                    "intervals of all other values are correct only if there is no such noise; "
                    f"compute a likelihood profile of {label} (uncertainty.profiles), or use more "
                    "data"
                )
    return tuple(found)


def refuse_process_noise(problem: Problem, where: str) -> None:
    """Refuse process noise for a function that needs simulations without a filter.

    Parameters
    ----------
    problem
        The problem to check.
    where
        Start of the error message.

    Raises
    ------
    ProblemError
        If the problem has process noise.
    """
    names = noise_names(problem)
    if names:
        raise ProblemError(
            f"{where}: cannot be used with process noise, but effect {names[0]!r} is process "
            "noise; leave one of the two out"
        )


def check_process_noise(problem: Problem) -> None:
    """Refuse process noise if a Kalman filter cannot be used or its result would be wrong.

    Raises
    ------
    ProblemError
        If the model, the cost, the effects or an experiment do not allow process noise.
    """
    names = noise_names(problem)
    if not names:
        return
    where = f"effect {names[0]!r}: is process noise, which"
    model = problem.model
    if model.interface != "model_exchange":
        raise ProblemError(
            f"{where} needs the states and their derivatives, so model.interface must be "
            f"model_exchange, but is {model.interface}; change it, or leave the effect out"
        )
    if model.solver.name == "cvode":
        raise ProblemError(
            f"{where} corrects the states at every measured time, so model.solver must be "
            "dormand_prince or rk4, but is cvode; change it, or leave the effect out"
        )
    if not isinstance(problem.cost, SumSquared):
        raise ProblemError(
            f'{where} needs cost.name = "sse", with which residuals are those of the likelihood, '
            f"but cost.name is {problem.cost.name!r}; change one of the two"
        )
    acting = [(effect.site, effect.form) for effect in problem.effects if effect.is_noise]
    if len(set(acting)) < len(acting):
        raise ProblemError(
            f"{where} may occur only once at a site in each form (of two, only the sum could be "
            "estimated), but occurs twice; remove one"
        )
    for experiment in problem.experiments:
        _check_experiment(experiment, where)
    _check_beside(problem, where)


def _check_experiment(experiment: Experiment, where: str) -> None:
    found = besides_plain_outputs(experiment)
    if not all(output.has_sigma for output in experiment.outputs):
        found.append("an output without a known sigma")
    for what in found:
        raise ProblemError(
            f"{where} is weighed against the noise of each measured value, but experiment "
            f"{experiment.id!r} has {what}; change that, or leave the effect out"
        )


def _check_beside(problem: Problem, where: str) -> None:
    """Refuse effects at outputs, and effects that change a signal before the simulation."""
    from workers.effects.definition import define_all  # needs SymPy, which is slow to import

    description, interface = problem.describe(), problem.model.interface
    for found in define_all(problem.effects, description, interface, problem.experiments):
        if found.site.kind == "output" or found.form.memory:
            effect = found.effect
            raise ProblemError(
                f"{where} cannot be combined with effect {effect.name!r} at {effect.site}, which "
                "changes a signal after or before the simulation; leave one of the two out"
            )
