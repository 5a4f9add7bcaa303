"""Process noise that is held during a search, so that innovations are its residuals.

With the noise of a fitted model, innovations over their standard deviations are white and of
variance 1 where that model is right: the residuals that all tests of the loop are made for. What a
missing effect leaves in them the noise has partly taken up; as the noise is held too large then, a
test sees less of it, but not what is not there. Fitted again with what was found, the noise is
smaller, and under that noise the search is done again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_parameters
from cluster_est.problem.search_space import make_space
from cluster_est.toml import dotted

WITH_NOISE = LeastSquares(trials=2, max_iterations=40, ftol=1e-8, xtol=1e-8)


@dataclass(frozen=True)
class HeldNoise:
    """A problem whose process noise is held where a fit found it.

    Attributes
    ----------
    problem
        The declared model, its noise fixed, and in each experiment the `log_spread` of that fit.
    values
        Of its unknowns, to start from.
    """

    problem: Problem = field(repr=False)
    values: Mapping[str, float]

    @property
    def start(self) -> FitStart:
        return FitStart(self.problem, self.values)


def check_noise_parameters(problem: Problem) -> None:
    """Refuse noise whose strength is not one number of its own.

    Raises
    ------
    ProblemError
        With what to change.
    """
    for parameter in noise_parameters(problem):
        for key, given in (("per", parameter.per), ("expression", parameter.expression)):
            if given:
                raise ProblemError(
                    f"close-loop: {dotted('parameters', parameter.name)}.{key}: must be left out, "
                    "because a "
                    f"search holds process noise by one number, but is {given!r}; remove it"
                )


def released(start: FitStart, declared: Problem) -> FitStart:
    """Return a model with the noise parameters of the declared one, from where they were held."""
    own = {p.name: p for p in noise_parameters(declared)}
    held = {p.name: p.start for p in start.problem.parameters if p.name in own}
    parameters = tuple(
        replace(own[p.name], start=p.start) if p.name in own else p
        for p in start.problem.parameters
    )
    problem = replace(start.problem, parameters=parameters)
    return FitStart(problem, {**held, **start.values}, start.added)


def hold_noise(
    workbench: LoopWorkbench, declared: Problem, start: FitStart, known: Mapping[str, float]
) -> HeldNoise:
    """Fit a model with its noise, and hold the noise of that fit in the declared one.

    Parameters
    ----------
    workbench
        Its experiments are those of the declared model, with any `log_spread`.
    declared
        As the user has given it.
    start
        The model, with noise that is free.
    known
        Values of the declared unknowns to start from; those of the fit where they are not given.

    Raises
    ------
    ProblemError
        If the model cannot be simulated.
    """
    (fitted,) = workbench.fit(LoopStage.PROCESS_NOISE, [start], WITH_NOISE)
    if fitted is None:
        raise ProblemError(
            "close-loop: the model cannot be simulated with its process noise from its start "
            "values; try cluster-est check, and other start values"
        )
    estimates = fitted.estimates
    spreads = _log_spreads(workbench, fitted)
    own = {p.name for p in noise_parameters(declared)}
    parameters = tuple(
        replace(p, start=float(estimates.get(p.name, p.start)), fixed=True) if p.name in own else p
        for p in declared.parameters
    )
    experiments = tuple(
        replace(each, log_spread=spread)
        for each, spread in zip(declared.experiments, spreads, strict=True)
    )
    problem = replace(declared, parameters=parameters, experiments=experiments)
    added = {p.name for p in fitted.problem.parameters} - {p.name for p in declared.parameters}
    values = {k: v for k, v in estimates.items() if k not in own and k not in added}
    return HeldNoise(problem, {**values, **known})


def _log_spreads(workbench: LoopWorkbench, fitted: FittedModel) -> list[float]:
    """Return the `log_spread` of every experiment at a fit; 0 where it cannot be simulated."""
    problem = fitted.problem
    everything = tuple(range(len(problem.experiments)))
    space = make_space(problem, everything, fitted.estimates)
    outcomes = workbench.runner.simulate(
        space.physical(space.start),
        everything,
        "linearisation",
        LoopStage.PROCESS_NOISE.value,
        problem.effects,
    )
    found = [outcome.linearisation for outcome in outcomes]
    return [0.0 if linear is None else linear.log_spread for linear in found]
