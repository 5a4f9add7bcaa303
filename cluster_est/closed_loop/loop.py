"""The recipe of the closed loop: fit, screen, refine, add, refit, report before and after.

Before the first effect is looked for, the error of the solver is measured beside the noise. With
process noise `noise_passes` is the recipe.

References: score tests with the declared parameters projected out follow C. R. Rao, Proc. Cambridge
Philos. Soc. 44 (1948) 50-57, doi:10.1017/S0305004100023987; growing a model where its residual
points follows N. R. Kristensen, H. Madsen, S. B. Jorgensen, Comput. Chem. Eng. 28 (2004) 1431-1449.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from typing_extensions import override

from cluster_est.closed_loop.account import (
    LastFits,
    account,
    best_on_few_rows,
    last_fits,
    last_fits_to_all_rows,
    result_so_far,
)
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.findings.verdict import CLAIMS, veto
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.long_records import (
    CONFIRMED_ON_ALL,
    MANY,
    open_on_all_rows,
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
from cluster_est.closed_loop.selection.answer import undetermined_sentence
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.workbench import LoopRequest, LoopWorkbench, check_arguments
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.problem.thinning import ThinnedProblem, ThinningSettings
from cluster_est.results.interpolation import PreferredInterpolation, preferred_interpolation
from cluster_est.running.arguments import prepared
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import Note, Record, Resources, Show
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
    resources: Resources | None = None,
    settings: LoopSettings | None = None,
    seed: int = 0,
    thinning: ThinningSettings | None = None,
    *,
    record: Record | None = None,
    show: Show | None = None,
    note: Note | None = None,
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
    record, show, note
        Called for each simulation, whenever something came back, and for each iteration; see
        `Runner`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    settings = LoopSettings() if settings is None else settings
    thinning = ThinningSettings() if thinning is None else thinning
    study = ClosedLoop(prepared(problem), settings, seed, thinning)
    return run_study(study, resources, record=record, show=show, note=note)


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
        fitter, start = workbench.fitter, FitStart(workbench.fitter.problem, {})
        scope = workbench.scope

        def keep_so_far(found: SelectionResult) -> None:
            keep = request.environment.monitor.reached
            if keep is None:
                return
            result = result_so_far(fitter, found, begin, scope, thin.sentence)
            if result is not None:
                keep(result)

        searched = search_for_effects(
            workbench,
            start,
            request.environment.resources,
            keep_so_far,
            thinned=thin.is_thinner,
        )
        fitter.enter("before and after")
        result, other, starts, ends = None, None, [], searched.ends
        if thin.is_thinner:
            starts = [best_on_few_rows(fitter, end.found) for end in ends]
        else:
            last_of = [partial(last_fits, fitter, end.found, begin) for end in ends]
            searched, fits, vetoed = _last_answer(ends, last_of, request.settings)
            result = account(fitter, searched.found, searched.judged, fits, scope)
            result = replace(result, notes=(*vetoed, *result.notes))
        added = searched.found.current.added if result is None else result.effects
        last = searched.error_at(searched.found.current) if added else searched.error
    if result is None:
        result, other = _confirmed_on_all_rows(request, thin, workbench, ends, starts, begin)
    seconds, error = time.monotonic() - begin, searched.error
    known = last if result.effects else error
    said = (*error.notes, *(known.notes_with_effects if known is not error else ()))
    notes = (*said, *result.notes, *expensive_structures(searched.found.path))
    result = replace(result, notes=notes, seconds=seconds, failures_in_search=searched.failures)
    return _with_interpolation(result, other or searched.interpolation)


def _last_answer(
    ends: Sequence[SearchedModel],
    last: Sequence[Callable[[], LastFits]],
    settings: LoopSettings,
) -> tuple[SearchedModel, LastFits, list[str]]:
    """Return the last answer that nothing speaks against after the last fits, and those.

    Where something does against each of them, it is the first one, which is then not claimed.

    Parameters
    ----------
    ends
        The search with its answer, and with those that this took the place of.
    last
        Do the last fits of each.

    Returns
    -------
    SearchedModel
    LastFits
    list of str
        What speaks against the answers before it.
    """
    refused: list[tuple[SearchedModel, LastFits]] = []
    said: list[str] = []
    for end, fit in zip(ends, last, strict=True):
        fits = fit()
        against = veto(end.judged, fits.errors, settings)
        if not against and end.judged.verdict in CLAIMS:
            against = undetermined_sentence(end.found.current, fits.after)
        if not against:
            return end, fits, said
        refused.append((replace(end, judged=end.judged.refused(against)), fits))
        labels = " and ".join(c.label for c in end.found.current.added)
        said.append(f"{labels}: not added, because {against}")
    return *refused[0], []


def _with_interpolation(result: LoopResult, other: PreferredInterpolation | None) -> LoopResult:
    """Say first which input the measurements prefer to be interpolated otherwise.

    What a wrong interpolation leaves is found as a lag or a delay.
    """
    if other is None:
        return result
    summary = f"{result.summary}; but the measurements prefer {other.key}: set it first"
    return replace(result, summary=summary, notes=(other.sentence, *result.notes))


def _confirmed_on_all_rows(
    request: LoopRequest,
    thin: ThinnedProblem,
    searching: LoopWorkbench,
    ends: Sequence[SearchedModel],
    starts: Sequence[Sequence[FitStart]],
    begin: float,
) -> tuple[LoopResult, PreferredInterpolation | None]:
    """Fit both models to convergence on all rows, and put what was found into words.

    The interpolation that the measurements prefer is told from all rows, too.
    """
    spent = [SpentSimulations.at(searching.fitter)]

    def left() -> LoopRequest:
        used = sum(each.evaluations for each in spent)
        return replace(
            request, environment=request.environment.left(used, time.monotonic() - begin)
        )

    with open_on_all_rows(left(), thin, searching.fitter) as whole:
        whole.enter("before and after")
        last_of = [
            partial(last_fits_to_all_rows, whole, end.found, start, begin)
            for end, start in zip(ends, starts, strict=True)
        ]
        searched, fits, vetoed = _last_answer(ends, last_of, request.settings)
        found = searched.found
        spent.append(SpentSimulations.at(whole))
        noise = whole.noise_in_units(found.noise)
        other = preferred_interpolation(
            whole.space(replace(found.base.start, problem=fits.before.problem)),
            fits.before.solution,
            fits.before.simulations,
            request.environment.resources,
            whole.runner,
        )
    with reopened(left(), searching.fitter) as fitter:
        result = account(fitter, found, searched.judged, fits, searching.scope)
    notes = (f"{thin.sentence}; {CONFIRMED_ON_ALL}", *vetoed, *result.notes)
    return with_all(replace(result, noise=noise, notes=notes), spent), other
