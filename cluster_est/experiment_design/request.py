"""A design that is to be made: its models, limits and settings, checked against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.experiment_design.candidates import CandidateInput, CandidateMaker
from cluster_est.experiment_design.criteria import CRITERIA, DesignCriterion
from cluster_est.experiment_design.limits import ExperimentLimits, SignalLimits
from cluster_est.experiment_design.models import CandidateModel, FittedCandidate
from cluster_est.experiment_design.settings import RECORDED, DesignSettings
from cluster_est.problem.problem import Problem
from cluster_est.results.result import Result
from workers.fmu.description import nearest
from workers.messages import Experiment

if TYPE_CHECKING:  # it needs SymPy, which is slow
    from cluster_est.closed_loop.findings.result import LoopResult

ALONE = "the fitted model"
BEYOND = 0.5
"""Of an output's range, by which an experiment may leave it where no limits are given."""


@dataclass(frozen=True)
class DesignRequest:
    """A design that is to be made.

    Attributes
    ----------
    models
        That may be the true one, the one that the run chose first. They share the experiments.
    limits, settings
        Of the experiment, and what it is chosen for.
    seed
        Starts the random generator.
    """

    models: tuple[CandidateModel, ...]
    limits: ExperimentLimits
    settings: DesignSettings
    seed: int = 0

    @property
    def problem(self) -> Problem:
        """Of the first model."""
        return self.models[0].problem


def models_of(result: Result | LoopResult) -> tuple[CandidateModel, ...]:
    """Return the models that a result leaves room for, the chosen one first."""
    competing = getattr(result, "competing", ())
    if competing:
        return tuple(
            CandidateModel(each.name, each.problem, each.values, each.weight) for each in competing
        )
    return (CandidateModel(ALONE, result.problem, result.x),)


def chosen_models(
    models: Sequence[CandidateModel], settings: DesignSettings
) -> tuple[CandidateModel, ...]:
    """Return the first model, and of the others those that are to be told apart.

    Raises
    ------
    ProblemError
        If one that is named is not among them.
    """
    if not settings.rivals:
        return tuple(models)
    names = [model.name for model in models]
    for name in settings.rivals:
        if name not in names:
            raise ProblemError(
                f"rivals: must be of the models that the run leaves room for "
                f"({', '.join(map(repr, names))}) but has {name!r}{nearest(name, names)}"
            )
    return tuple(m for i, m in enumerate(models) if i == 0 or m.name in settings.rivals)


def check_design(request: DesignRequest) -> None:
    """Refuse, before anything is simulated, what does not fit together.

    Raises
    ------
    ClusterEstError
        Saying what to change.
    """
    problem, limits = request.problem, request.limits
    _check_comparable(problem)
    description = problem.describe()
    like = experiment_like(request)
    known = [given.variable for given in like.inputs]
    for name in limits.inputs:
        if name not in known:
            raise ProblemError(
                f"inputs.{name}: must be an input of experiment {like.id!r} but is none"
                f"{nearest(name, known)}"
            )
    for key, names in (("signals", limits.signals), ("start", limits.start)):
        for name in names:
            if name not in description.variables:
                raise ProblemError(
                    f"{key}.{name}: must be a variable of the FMU but there is none of that name"
                    f"{nearest(name, description.variables)}"
                )
    criterion = criterion_of(request)
    if criterion.compares and len(request.models) < 2:
        raise ProblemError(
            f"criterion: {criterion.name!r} must have at least two models to tell apart but the "
            'run leaves one; take "d" or "a", which narrow its parameters'
        )


def _check_comparable(problem: Problem) -> None:
    """Refuse experiments whose residuals are not differences of outputs."""
    for experiment in problem.experiments:
        if experiment.curve is not None or experiment.cost_function is not None:
            raise ProblemError(
                f"experiment {experiment.id!r}: must have outputs at measured times alone for a "
                "design but has a curve or a cost function; make the run without them"
            )
        for output in experiment.outputs:
            if not output.is_plain:
                raise ProblemError(
                    f"experiment {experiment.id!r}: output {output.variable} must be compared as "
                    "it is for a design but has free_scale, free_offset or a detection_limit; make "
                    "the run without it"
                )


def criterion_of(request: DesignRequest) -> DesignCriterion:
    """Return the criterion that is asked for, or the one that suits the models."""
    usual = "discriminate" if len(request.models) > 1 else "d"
    return CRITERIA[request.settings.criterion or usual]


def experiment_like(request: DesignRequest) -> Experiment:
    """Return the experiment of the run that the next one begins like."""
    problem, name = request.problem, request.limits.like
    if not name:
        return problem.experiments[problem.indices("train")[0]]
    known = {experiment.id: experiment for experiment in problem.experiments}
    if name not in known:
        raise ProblemError(
            f"like: must be an experiment of the run but is {name!r}{nearest(name, known)}"
        )
    return known[name]


def candidate_maker(request: DesignRequest, noise: Mapping[str, float]) -> CandidateMaker:
    """Return what makes experiments, with as much noise as the fit has found.

    Parameters
    ----------
    request
        With the limits.
    noise
        Standard deviation of each output's noise over its sigma.
    """
    like = experiment_like(request)
    sigmas = {
        output.variable: max(
            float(np.sqrt(np.mean(output.sigmas**2))) * noise.get(output.variable, 1.0), 1e-12
        )
        for output in like.outputs
        if len(output.times)
    }
    signals = {**seen_ranges(request.problem, tuple(sigmas)), **request.limits.signals}
    return CandidateMaker(request.limits, like, sigmas, request.settings.families, signals)


def seen_ranges(problem: Problem, outputs: Sequence[str]) -> dict[str, SignalLimits]:
    """Return the range of each output over all experiments, and half as much on either side.

    Further out nobody knows whether a model holds, nor whether the plant does.
    """
    found = {}
    for name in outputs:
        measured = np.concatenate(
            [o.values for e in problem.experiments for o in e.outputs if o.variable == name]
        )
        low, high = float(measured.min()), float(measured.max())
        room = BEYOND * max(high - low, 1e-9 * max(abs(low), abs(high), 1e-9))
        found[name] = SignalLimits(low - room, high + room)
    return found


def recorded_candidates(
    request: DesignRequest, maker: CandidateMaker
) -> tuple[CandidateInput, ...]:
    """Return the inputs of the run's experiments that keep the limits, where they may be chosen."""
    wanted = request.settings.waveforms
    if wanted and RECORDED not in wanted:
        return ()
    found = (maker.recorded(experiment) for experiment in request.problem.experiments)
    return tuple(each for each in found if each is not None)


def narrowed_labels(fitted: FittedCandidate, settings: DesignSettings) -> tuple[str, ...]:
    """Return the labels of the unknowns that count.

    Raises
    ------
    ProblemError
        If a name is none of the run's.
    """
    shared = tuple(unknown.label for unknown in fitted.space.unknowns if not unknown.scope)
    if not settings.parameters:
        return shared or fitted.labels
    found: list[str] = []
    for name in settings.parameters:
        own = [u.label for u in fitted.space.unknowns if name in (u.label, u.parameter.name)]
        if not own:
            raise ProblemError(
                f"parameters: must be of what the run has estimated but has {name!r}"
                f"{nearest(name, fitted.labels)}"
            )
        found += own
    return tuple(dict.fromkeys(found))
