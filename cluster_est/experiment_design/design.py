"""The recipe of a design: fit the models, draw inputs, simulate them, keep the best.

References: A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
doi:10.1093/biomet/62.1.57; A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental
Designs, with SAS (2007).
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cluster_est.errors import BudgetError, ProblemError
from cluster_est.experiment_design.candidates import RECORDED, CandidateInput, CandidateMaker
from cluster_est.experiment_design.findings.result import DesignResult, make_result
from cluster_est.experiment_design.limits import ExperimentLimits, SignalLimits
from cluster_est.experiment_design.models import NoiseOfOutputs, fit_candidates
from cluster_est.experiment_design.prediction import with_predictions
from cluster_est.experiment_design.queue import DesignQueue
from cluster_est.experiment_design.refits import confirmed_choice
from cluster_est.experiment_design.request import (
    DesignRequest,
    check_design,
    chosen_models,
    models_of,
    narrowed_labels,
)
from cluster_est.experiment_design.search import CandidateScorer, ranked, search
from cluster_est.experiment_design.settings import DesignSettings
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.problem.problem import Problem
from cluster_est.results.result import Result
from cluster_est.running.arguments import check_resources
from cluster_est.running.environment import Monitor, RunEnvironment
from cluster_est.running.records import Note, Record, Show
from cluster_est.running.resources import Resources, one_blas_thread
from cluster_est.running.shared_pools import SharedPools
from workers.messages.checks import check_kind, check_number

if TYPE_CHECKING:
    from cluster_est.closed_loop.findings.result import LoopResult


BEYOND = 0.5
"""Of an output's range, by which an experiment may leave it where no limits are given."""


def candidate_maker(request: DesignRequest, noise: NoiseOfOutputs) -> CandidateMaker:
    """Return what makes experiments, with as much noise as the fit has found."""
    problem, like = request.problem, request.like
    sigmas = {
        output.variable: noise.over_sigma(output.variable) * usual_sigma(problem, output.variable)
        for output in like.outputs
        if len(output.times)
    }
    variables = problem.describe().variables
    wanted = request.settings.waveforms
    return CandidateMaker(
        request.limits,
        like,
        sigmas,
        tuple(name for name in WAVEFORMS if not wanted or name in wanted),
        {**seen_ranges(problem, tuple(sigmas)), **request.limits.signals},
        frozenset(
            name for name in request.limits.inputs if not variables[name].type.startswith("Float")
        ),
    )


def usual_sigma(problem: Problem, output: str) -> float:
    """Return the median over the training experiments of an output's sigma."""
    runs = [problem.experiments[e] for e in problem.indices("train")]
    own = [o for run in runs for o in run.outputs if o.variable == output and len(o.times)]
    return float(np.median([np.sqrt(np.mean(o.sigmas**2)) for o in own])) if own else 1.0


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


UNCONFIRMED = (
    "the budget left no room to fit the rivals to what each model predicts of the best input: what "
    "is expected of it rests on derivatives alone, and may be too much"
)


def make_design(environment: RunEnvironment, request: DesignRequest) -> DesignResult:
    """Choose the next experiment with workers and a budget that somebody else has chosen.

    Raises
    ------
    ClusterEstError
        If limits, models and machine do not fit together, or no input keeps the limits.
    """
    begin = time.monotonic()
    check_design(request)
    queue = DesignQueue(environment, request.problem)
    with one_blas_thread():
        fitted, noise = queue.use(
            request.problem.experiments,
            "fitting the models",
            lambda runner: fit_candidates(runner, request.models, request.seed),
        )
        if request.targets:
            units = {v.name: v.unit for v in request.problem.describe().variables.values()}
            fitted[0] = with_predictions(queue, fitted[0], request.targets, units)
        labels = tuple(each for each in narrowed_labels(request) if each not in fitted[0].held)
        scorer = CandidateScorer(fitted, request.criterion, labels, queue)
        maker = candidate_maker(request, noise)
        found = search(
            scorer,
            maker,
            recorded_candidates(request, maker),
            request.settings.candidates,
            np.random.default_rng(request.seed),
        )
        leading = ranked(found.scored)
        remarks: tuple[str, ...] = ()
        chosen = (leading[0], leading[0].evidence)
        if request.criterion.compares:
            try:
                chosen = confirmed_choice(queue, fitted, leading, noise)
            except BudgetError:
                remarks = (UNCONFIRMED,)
    result = make_result(scorer, found, maker, chosen)
    return replace(
        result,
        remarks=(*result.remarks, *remarks),
        evaluations=queue.evaluations,
        simulated=queue.simulations,
        failures=queue.failures,
        seconds=time.monotonic() - begin,
    )


def design(
    result: Result | LoopResult,
    limits: ExperimentLimits,
    resources: Resources | None = None,
    settings: DesignSettings | None = None,
    seed: int = 0,
    *,
    record: Record | None = None,
    show: Show | None = None,
    note: Note | None = None,
) -> DesignResult:
    """Choose the next experiment: the input that tells most, within limits.

    Parameters
    ----------
    result
        Of a fit or of a closed loop. The effects of a loop have rivals, which are told apart.
    limits
        Of the experiment.
    resources
        Where simulations run, and the budget.
    settings
        What the experiment is chosen for, and how hard it is searched for.
    seed
        Starts the random generator; the result is the same for any number of workers.
    record, show, note
        Called for each simulation, whenever something came back, and for each iteration; see
        `Runner`.

    Raises
    ------
    ClusterEstError
        If limits, models and machine do not fit together, or no input keeps the limits.
    """
    settings = DesignSettings() if settings is None else settings
    resources = Resources() if resources is None else resources
    check_kind(limits, ExperimentLimits, "limits", ProblemError)
    check_kind(settings, DesignSettings, "settings", ProblemError)
    check_resources(resources)
    check_number(seed, "design.seed", ProblemError, least=0, whole=True)
    models = chosen_models(models_of(result), settings)
    request = DesignRequest(models, limits, settings, seed)
    with SharedPools() as pools:  # a cluster is joined once
        environment = RunEnvironment(resources, Monitor(record, show, note), source=pools)
        return make_design(environment, request)
