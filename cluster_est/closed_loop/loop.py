"""The recipe of the closed loop: fit, screen, refine, add, refit, report before and after.

Before the first effect is looked for, the error of the solver is measured beside the noise. With
process noise `noise_passes` is the recipe.

References: score tests with the declared parameters projected out follow C. R. Rao, Proc. Cambridge
Philos. Soc. 44 (1948) 50-57, doi:10.1017/S0305004100023987; growing a model where its residual
points follows N. R. Kristensen, H. Madsen, S. B. Jorgensen, Comput. Chem. Eng. 28 (2004) 1431-1449.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from typing_extensions import override

from cluster_est.closed_loop.account import (
    account,
    best_on_few_rows,
    last_fits,
    last_fits_to_all_rows,
)
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.long_records import (
    CONFIRMED_ON_ALL,
    MANY,
    open_whole_workbench,
    reopened,
    thinned_records,
    with_slim_log,
)
from cluster_est.closed_loop.outliers import open_checked_workbench
from cluster_est.closed_loop.process_noise import (
    SpentSimulations,
    close_loop_under_noise,
    with_all,
)
from cluster_est.closed_loop.search import SearchedModel, search_for_effects
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.so_far import result_so_far
from cluster_est.closed_loop.workbench import LoopRequest, LoopWorkbench, check_arguments
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.problem.thinning import ThinnedProblem, ThinningSettings
from cluster_est.results.interpolation import PreferredInterpolation, preferred_interpolation
from cluster_est.running.arguments import prepared
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.progress_line import Callback
from cluster_est.running.resources import Record, Resources, Show
from cluster_est.running.study import Study, run_study
from cluster_est.shooting.carried_states import with_carried_states


@dataclass(frozen=True)
class ClosedLoop(Study[LoopResult]):
    """The search for what a model lacks.

    Attributes
    ----------
    problem
        The declared model with its parameters and experiments.
    settings
        Thresholds and sizes.
    seed
        Starts every random generator.
    thinning
        Rows of long records that effects are looked for on.
    """

    problem: Problem
    settings: LoopSettings = field(default_factory=LoopSettings)
    seed: int = 0
    thinning: ThinningSettings = field(default_factory=ThinningSettings)

    @override
    def check(self) -> None:
        check_arguments(self.problem, self.settings, self.seed)
        self.problem.describe()
        make_space(self.problem, self.problem.indices("test"))

    @override
    def run(self, environment: RunEnvironment) -> LoopResult:
        rows = self.thinning.most()
        return run_loop(LoopRequest(self.problem, environment, self.settings, self.seed, rows))


def close_loop(
    problem: Problem,
    resources: Resources | Mapping[str, Any] | str | None = None,
    settings: LoopSettings | Mapping[str, Any] | None = None,
    seed: int = 0,
    thinning: ThinningSettings | Mapping[str, Any] | int | None = None,
    *,
    progress: Show | bool | None = None,
    callback: Callback | None = None,
    record: Record | None = None,
) -> LoopResult:
    """Find what a model lacks, add it, and report the error before and after.

    Parameters
    ----------
    problem
        The declared model with its parameters and experiments. Experiments with role "test" choose
        nothing; they can only take a verdict away.
    resources
        Executor of the simulations, and the budget.
    settings
        Thresholds and sizes.
    seed
        Starts every random generator; the result is the same for any number of workers.
    thinning
        Rows of long records that effects are looked for on.
    progress, callback, record
        As for `fit`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    chosen, rows = LoopSettings.of(settings), ThinningSettings.of(thinning)
    study = ClosedLoop(prepared(problem), chosen, seed, rows)
    return run_study(study, resources, progress=progress, callback=callback, record=record)


def run_loop(request: LoopRequest) -> LoopResult:
    """Close the loop with workers, listeners and a budget that somebody else has chosen.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    begin = time.monotonic()
    carried = with_carried_states(request.environment, request.problem)
    request = replace(request, problem=carried)
    if noise_names(request.problem):
        return close_loop_under_noise(request, begin)
    thin = thinned_records(request, request.rows)
    request = replace(request, problem=thin.problem, noise_of_samples=thin.noise)
    if thin.is_thinner:
        slim = with_slim_log(request.environment, MANY)
        request = replace(request, environment=slim)
    with open_checked_workbench(request) as workbench:
        start = FitStart(workbench.problem, {})

        def keep_so_far(found: SelectionResult) -> None:
            kept = request.environment.monitor.reached
            result = None if kept is None else result_so_far(workbench, found, begin, thin.sentence)
            if kept is not None and result is not None:
                kept(result)

        searched = search_for_effects(
            workbench,
            start,
            request.environment.resources,
            keep_so_far,
            thinned=thin.is_thinner,
        )
        workbench.enter("before and after")
        result, other, starts = None, None, []
        if thin.is_thinner:
            starts = best_on_few_rows(workbench, searched.found)
        else:
            fits = last_fits(workbench, searched.found, begin)
            result = account(workbench, searched.found, searched.judged, fits)
        added = searched.found.current.added if result is None else result.effects
        last = searched.error_at(searched.found.current) if added else searched.error
    if result is None:
        result, other = _confirmed_on_all_rows(request, thin, workbench, searched, starts, begin)
    seconds, error = time.monotonic() - begin, searched.error
    known = last if result.effects else error
    said = (*error.notes, *(known.notes_with_effects if known is not error else ()))
    notes = (*said, *result.notes, *expensive_structures(searched.found.path))
    result = replace(result, notes=notes, seconds=seconds, failures_in_search=searched.failures)
    return _with_interpolation(result, other or searched.interpolation)


def _with_interpolation(result: LoopResult, other: PreferredInterpolation | None) -> LoopResult:
    """Say first which input the measurements prefer to be interpolated otherwise.

    What a wrong interpolation leaves is found as a lag or a delay.
    """
    if other is None:
        return result
    message = f"{result.message}; but the measurements prefer {other.key}: set it first"
    return replace(result, message=message, notes=(other.sentence, *result.notes))


def _confirmed_on_all_rows(
    request: LoopRequest,
    thin: ThinnedProblem,
    searching: LoopWorkbench,
    searched: SearchedModel,
    starts: Sequence[FitStart],
    begin: float,
) -> tuple[LoopResult, PreferredInterpolation | None]:
    """Fit both models to convergence on all rows, and put what was found into words.

    The interpolation that the measurements prefer is told from all rows, too.
    """
    found, spent = searched.found, [SpentSimulations.at(searching.fitter)]

    def left() -> LoopRequest:
        used = sum(each.evaluations for each in spent)
        return replace(
            request, environment=request.environment.left(used, time.monotonic() - begin)
        )

    with open_whole_workbench(left(), thin, searching) as whole:
        whole.enter("before and after")
        fits = last_fits_to_all_rows(whole, found, starts, begin)
        spent.append(SpentSimulations.at(whole.fitter))
        noise = whole.noise_in_units(found.noise)
        other = preferred_interpolation(
            whole.space(replace(found.base.start, problem=fits.before.problem)),
            fits.before.solution,
            fits.before.simulations,
            request.environment.resources,
            whole.runner,
        )
    with reopened(left(), searching) as workbench:
        result = account(workbench, found, searched.judged, fits)
    notes = (f"{thin.sentence}; {CONFIRMED_ON_ALL}", *result.notes)
    return with_all(replace(result, noise=noise, notes=notes), spent), other
