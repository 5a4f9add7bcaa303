"""Design of an experiment: fit the models, draw and simulate inputs, refit to the best, select one.

A search selects the inputs with the largest expected value. If outputs are nonlinear in the
parameters, the expectation is too high for some of them. So the leading inputs are checked before
one is selected. The outputs predicted by one model replace measurements, and each other model is
fitted to them and to the earlier experiments. The increase of its sum of squares is twice the
evidence.

References: A. C. Atkinson, V. V. Fedorov, Biometrika 62 (1975) 57-70,
doi:10.1093/biomet/62.1.57; A. C. Atkinson, A. N. Donev, R. D. Tobias, Optimum Experimental
Designs, with SAS (2007).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from typing_extensions import override

from cluster_est.errors import BudgetError, ProblemError
from cluster_est.experiment_design.candidate_inputs import RECORDED, CandidateInput, CandidateMaker
from cluster_est.experiment_design.criteria import expected_probabilities
from cluster_est.experiment_design.design_result import DesignResult, make_result
from cluster_est.experiment_design.input_search import (
    CandidateScorer,
    ScoredCandidate,
    ranked,
    search,
)
from cluster_est.experiment_design.limits import ExperimentLimits, SignalLimits
from cluster_est.experiment_design.models import FittedCandidate, NoiseOfOutputs, fit_candidates
from cluster_est.experiment_design.predicted_outputs import (
    DesignQueue,
    own_starts,
    with_predictions,
)
from cluster_est.experiment_design.request import (
    DesignRequest,
    DesignSettings,
    check_design,
    chosen_models,
    models_of,
    narrowed_labels,
)
from cluster_est.experiment_design.waveforms import WAVEFORMS
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.results.result import Result
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.progress_line import Callback
from cluster_est.running.resources import Record, Resources, Show, one_blas_thread
from cluster_est.running.search_state import SearchRequest
from cluster_est.running.study import Study, run_study
from workers.messages import Experiment, FloatArray, Output
from workers.messages.checks import check_number

if TYPE_CHECKING:
    from cluster_est.closed_loop.findings.result import LoopResult


REFIT = LeastSquares(trials=1, max_iterations=10, ftol=1e-5, xtol=1e-5, differences="forward")
MOST_REPEATED_INPUTS = 3
"""Largest number of inputs that are checked by refits."""
CONFIRMED = 0.02
"""Amount by which the expected probability may be lower than before the refits."""
ALLOWED_EXCURSION = 0.5
"""Share of an output's range by which an experiment may leave it without given limits."""
UNCONFIRMED = (
    "the budget was too small to fit the rivals to the predictions for the best input; the "
    "expected values are therefore estimates from derivatives, and may be too high"
)


def design(
    result: Result | LoopResult,
    limits: ExperimentLimits | Mapping[str, Any],
    resources: Resources | Mapping[str, Any] | str | None = None,
    settings: DesignSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
    *,
    progress: Show | bool | None = None,
    callback: Callback | None = None,
    record: Record | None = None,
) -> DesignResult:
    """Choose the next experiment: the most informative input within limits.

    Parameters
    ----------
    result
        Result of a fit or of a closed loop. For a loop, the design discriminates between rivals of
        its effects.
    limits
        Limits of the experiment.
    resources
        Executor of the simulations, and the budget.
    settings
        Purpose of the experiment, and effort of the search.
    seed
        Seed of the random generator; the result is the same for any number of workers.
    progress, callback, record
        As for `fit`.

    Raises
    ------
    ClusterEstError
        If limits, models and machine do not fit together, or no input satisfies the limits.
    """
    settings, limits = DesignSettings.of(settings), ExperimentLimits.of(limits)
    check_number(seed, "design.seed", ProblemError, least=0, whole=True)
    models = chosen_models(models_of(result), settings)
    study = Design(DesignRequest(models, limits, settings, seed))
    return run_study(study, resources, progress=progress, callback=callback, record=record)


@dataclass(frozen=True)
class Design(Study[DesignResult]):
    """The choice of the next experiment for a `request`, which contains models and limits."""

    request: DesignRequest

    @override
    def check(self) -> None:
        check_design(self.request)

    @override
    def run(self, environment: RunEnvironment) -> DesignResult:
        return make_design(environment, self.request)


def make_design(environment: RunEnvironment, request: DesignRequest) -> DesignResult:
    """Choose the next experiment with the workers and the budget of an environment.

    Raises
    ------
    ClusterEstError
        If limits, models and machine do not fit together, or no input satisfies the limits.
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
        units = {v.name: v.unit for v in request.problem.describe().variables.values()}
        if request.targets:
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
    result = make_result(scorer, found, maker, chosen, units)
    return replace(
        result,
        remarks=(*result.remarks, *remarks),
        evaluations=queue.evaluations,
        simulated=queue.simulations,
        failures=queue.failures,
        seconds=time.monotonic() - begin,
    )


def candidate_maker(request: DesignRequest, noise: NoiseOfOutputs) -> CandidateMaker:
    """Return the maker of experiments, with the noise found by the fit."""
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
    """Return the median of an output's sigma over the training experiments."""
    runs = [problem.experiments[e] for e in problem.indices("train")]
    own = [o for run in runs for o in run.outputs if o.variable == output and len(o.times)]
    return float(np.median([np.sqrt(np.mean(o.sigmas**2)) for o in own])) if own else 1.0


def seen_ranges(problem: Problem, outputs: Sequence[str]) -> dict[str, SignalLimits]:
    """Return the range of each output over all experiments, extended by half of it on either side.

    Outside this range, neither the model nor the plant is known to be valid.
    """
    found = {}
    for name in outputs:
        measured = np.concatenate(
            [o.values for e in problem.experiments for o in e.outputs if o.variable == name]
        )
        low, high = float(measured.min()), float(measured.max())
        room = ALLOWED_EXCURSION * max(high - low, 1e-9 * max(abs(low), abs(high), 1e-9))
        found[name] = SignalLimits(lower=low - room, upper=high + room)
    return found


def recorded_candidates(
    request: DesignRequest, maker: CandidateMaker
) -> tuple[CandidateInput, ...]:
    """Return the inputs of the run's experiments that satisfy the limits, if they may be chosen."""
    wanted = request.settings.waveforms
    if wanted and RECORDED not in wanted:
        return ()
    found = (maker.recorded(experiment) for experiment in request.problem.experiments)
    return tuple(each for each in found if each is not None)


def confirmed_choice(
    queue: DesignQueue,
    models: Sequence[FittedCandidate],
    ranked: Sequence[ScoredCandidate],
    noise: NoiseOfOutputs,
) -> tuple[ScoredCandidate, FloatArray]:
    """Return the best input by refits, and its evidence, (true model, rival).

    If the value of an input is lower than expected, the next best input is checked too.

    Parameters
    ----------
    queue, models, noise
        Queue of the fits, the models, and the noise.
    ranked
        Scored inputs, the best first; at least one.
    """
    weights = np.array([fitted.model.weight for fitted in models])
    best: tuple[float, ScoredCandidate, FloatArray] | None = None
    for each in ranked[:MOST_REPEATED_INPUTS]:
        if best is not None and best[0] >= each.value - CONFIRMED:
            break
        evidence = refitted_evidence(queue, models, each, noise)
        value = float(np.average(expected_probabilities(evidence, weights), weights=weights))
        if best is None or value > best[0]:
            best = (value, each, evidence)
    assert best is not None
    return best[1], best[2]


def refitted_evidence(
    queue: DesignQueue,
    models: Sequence[FittedCandidate],
    scored: ScoredCandidate,
    noise: NoiseOfOutputs,
) -> FloatArray:
    """Return the evidence of one input for each model against each rival, by refits.

    If a rival cannot be fitted, its evidence is computed from derivatives.
    """
    count = len(models)
    found = np.zeros((count, count))
    earlier = _weighted(models[0], noise)
    measured = [_as_measured(scored, i) for i in range(count)]
    alone, spaces, pairs = [], [], []
    for j, rival in enumerate(models):
        problem = replace(rival.model.problem, experiments=(*earlier, *measured), cost=SumSquared())
        first = tuple(range(len(earlier)))
        alone.append(make_space(problem, first, starts=rival.space.estimates(rival.x)))
        for i in range(count):
            if i != j:
                starts = own_starts(rival, measured[i].id)
                spaces.append(make_space(problem, (*first, len(earlier) + i), starts=starts))
                pairs.append((i, j))
    requests = [SearchRequest("refits", REFIT, space) for space in (*alone, *spaces)]
    solutions = queue.use(
        (*earlier, *measured), "checking the best input", lambda runner: runner.run(requests)
    )
    before = [solution.cost for solution in solutions[:count]]
    for (i, j), solution in zip(pairs, solutions[count:], strict=True):
        if np.isfinite([solution.cost, before[j]]).all():
            found[i, j] = max(0.5 * (solution.cost - before[j]), 0.0)
        else:
            found[i, j] = scored.evidence[i, j]
    return found


def _weighted(fitted: FittedCandidate, noise: NoiseOfOutputs) -> tuple[Experiment, ...]:
    """Return the training experiments with the assumed noise as sigmas."""
    problem = fitted.model.problem
    return tuple(
        replace(
            problem.experiments[e],
            outputs=tuple(_with_noise(o, noise) for o in problem.experiments[e].outputs),
        )
        for e in problem.indices("train")
    )


def _with_noise(output: Output, noise: NoiseOfOutputs) -> Output:
    factor = noise.over_sigma(output.variable)
    relative = output.relative_sigma * factor
    return replace(output, sigma=output.sigma * factor, relative_sigma=relative)


def _as_measured(scored: ScoredCandidate, model: int) -> Experiment:
    """Return the experiment with a model's prediction instead of measurements."""
    experiment, outputs = scored.candidate.experiment, []
    first = 0
    for output in experiment.outputs:
        rows = slice(first, first + len(output.times))
        values = output.sigma * scored.predicted[model].outputs[rows]
        outputs.append(replace(output, values=np.ascontiguousarray(values)))
        first = rows.stop
    name = f"{experiment.id} as predicted by model {model + 1}"
    return replace(experiment, id=name, outputs=tuple(outputs), bounds=())
