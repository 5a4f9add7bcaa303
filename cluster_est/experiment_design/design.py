"""The recipe of a design: fit the models, draw inputs, simulate them, keep the best.

References: A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
doi:10.1093/biomet/62.1.57; A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental
Designs, with SAS (2007).
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from cluster_est.errors import BudgetError, ProblemError
from cluster_est.experiment_design.findings.result import DesignResult, make_result
from cluster_est.experiment_design.first_candidates import candidate_maker, recorded_candidates
from cluster_est.experiment_design.limits import ExperimentLimits
from cluster_est.experiment_design.models import fit_candidates
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
from cluster_est.experiment_design.target_predictions import with_predictions
from cluster_est.results.result import Result
from cluster_est.running.arguments import check_resources
from cluster_est.running.environment import Monitor, RunEnvironment
from cluster_est.running.records import Note, Record, Show
from cluster_est.running.resources import Resources, one_blas_thread
from cluster_est.running.shared_pools import SharedPools
from workers.messages.checks import check_kind, check_number

if TYPE_CHECKING:  # it needs SymPy, which is slow
    from cluster_est.closed_loop.findings.result import LoopResult


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
