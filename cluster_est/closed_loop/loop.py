"""The steps of close_loop: fit, search for missing effects, add them, fit again, and report.

Before the search, the numerical error of the solver is measured and compared with the noise. With
process noise, the module `process_noise` does the search.

References: the score tests, which are independent of the declared parameters, follow C. R. Rao,
Proc. Cambridge Philos. Soc. 44 (1948) 50-57, doi:10.1017/S0305004100023987. Extending a model where
its residual suggests it follows N. R. Kristensen, H. Madsen, S. B. Jorgensen, Comput. Chem. Eng. 28
(2004) 1431-1449.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from typing_extensions import override

from cluster_est.closed_loop.account import account
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.last_fits import last_answer, last_fits
from cluster_est.closed_loop.long_records import (
    AccountedSearch,
    loop_on_thinned_records,
    search_and_keep,
    thinned_records,
)
from cluster_est.closed_loop.outliers import (
    left_out_sentence,
    open_checked_workbench,
    samples_left_out,
    without_stand_ins,
)
from cluster_est.closed_loop.process_noise import close_loop_under_noise
from cluster_est.closed_loop.selection.answer import p_without
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.workbench import LoopRequest, check_arguments
from cluster_est.problem.display import in_sentences
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.problem.thinning import ThinningSettings
from cluster_est.results.interpolation import PreferredInterpolation
from cluster_est.results.states import with_states
from cluster_est.running.arguments import prepared
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.progress_line import Callback
from cluster_est.running.resources import Record, Resources, Show
from cluster_est.running.study import Study, run_study
from cluster_est.shooting.carried_states import with_carried_states


@dataclass(frozen=True)
class ClosedLoop(Study[LoopResult]):
    """A search for effects that a model lacks.

    Attributes
    ----------
    problem
        The declared model with its parameters and experiments.
    settings
        Thresholds and sizes of the search.
    seed
        Seed of all random generators.
    thinning
        Number of rows to which long records are thinned for the search.
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
        found = run_loop(LoopRequest(self.problem, environment, self.settings, self.seed, rows))
        after = with_states(found.after, environment.resources)
        nothing_added = found.before is found.after
        return replace(found, before=after if nothing_added else found.before, after=after)


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
    """Search for effects that a model lacks, add them, and report the errors before and after.

    Parameters
    ----------
    problem
        The declared model with its parameters and experiments. Experiments with role "test" are not
        used to choose effects. They can only weaken the verdict.
    resources
        Executor of the simulations, and the budget.
    settings
        Thresholds and sizes of the search.
    seed
        Seed of all random generators. The result is the same for any number of workers.
    thinning
        Number of rows to which long records are thinned for the search.
    progress, callback, record
        As for `fit`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine are not compatible, or the data are not sufficient for a
        search.
    """
    chosen, rows = LoopSettings.of(settings), ThinningSettings.of(thinning)
    study = ClosedLoop(prepared(problem), chosen, seed, rows)
    return run_study(study, resources, progress=progress, callback=callback, record=record)


def run_loop(request: LoopRequest) -> LoopResult:
    """Do the search with the workers, listeners and budget of a request.

    Raises
    ------
    ClusterEstError
        As `close_loop`.
    """
    begin = time.monotonic()
    carried = with_carried_states(request.environment, request.problem)
    request = replace(request, problem=carried)
    if noise_names(request.problem):
        return close_loop_under_noise(request, begin)
    said = request.problem.data_findings
    request = replace(request, problem=without_stand_ins(request.problem))
    thin = thinned_records(request, request.rows)
    found = (
        loop_on_thinned_records(request, thin, begin)
        if thin.is_thinner
        else _loop_on_all_rows(request, begin)
    )
    result, searched = found.result, found.searched
    known = found.error if result.effects else searched.error
    with_effects = known.notes_with_effects if known is not searched.error else ()
    more = (*searched.error.notes, *with_effects)
    notes = (*more, *result.notes, *expensive_structures(searched.found.path))
    seconds, failures = time.monotonic() - begin, searched.failures
    left_out = samples_left_out(request.problem, result.after.problem)
    result = replace(
        result,
        notes=(*notes, *left_out_sentence(left_out)),
        seconds=seconds,
        failures_in_search=failures,
        left_out=left_out,
    )
    return _with_data_findings(with_interpolation(result, found.interpolation), said)


def _loop_on_all_rows(request: LoopRequest, begin: float) -> AccountedSearch:
    """Search on all rows, and do the last fits on the same workbench."""
    with open_checked_workbench(request) as workbench:
        fitter, searched = workbench.fitter, search_and_keep(request, workbench, begin)
        fitter.enter("before and after")
        last = [partial(last_fits, fitter, found, begin) for found, _ in searched.ends]
        answer = last_answer(searched.ends, last, partial(p_without, fitter))
        tested = searched.interpolations
        if answer.keeps_effects:
            tested = searched.interpolations_with(answer.found.current)
        result = account(fitter, answer, workbench.scope, tested.linear)
        error = searched.error_at(answer.found.current) if result.effects else searched.error
    return AccountedSearch(result, searched, error, tested.preferred)


def _with_data_findings(result: LoopResult, said: Sequence[tuple[str, str]]) -> LoopResult:
    """Put findings on the data first: numbers that are probably not measurements."""
    if not said:
        return result
    sentences = [f"check the records first: {what}; {do}" for what, do in said]
    aside = "; this run leaves such output samples out of fits, errors and tables"
    message = in_sentences([f"{'; '.join(sentences)}{aside}", result.message])
    return replace(result, message=message)


def with_interpolation(result: LoopResult, other: PreferredInterpolation | None) -> LoopResult:
    """Name an input with a probably wrong interpolation.

    The search may find the error of a wrong interpolation as a lag or a delay. On the other hand,
    if the model lacks something, another interpolation may imitate a part of it. So if it removes
    only a small part of the error, it is a note, but not the first thing to do.
    """
    if other is None:
        return result
    if not other.explains_most and result.verdict is not Verdict.FOUND:
        return replace(result, notes=(other.sentence, *result.notes))
    but = f"but the model fits better with {other.key}: set it first"
    message = in_sentences([result.message, but])
    notes = (other.sentence, *result.notes)
    return replace(result, message=message, notes=notes, first=result.first or f"set {other.key}")
