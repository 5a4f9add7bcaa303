"""The recipe of the closed loop: fit, detect, locate, name, add, refit, report before and after.

References: score tests with the declared parameters projected out follow C. R. Rao, Proc. Cambridge
Philos. Soc. 44 (1948) 50-57, doi:10.1017/S0305004100023987; growing a model where its residual
points follows N. R. Kristensen, H. Madsen, S. B. Jorgensen, Comput. Chem. Eng. 28 (2004) 1431-1449.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.findings.effect_curves import draw_effects
from cluster_est.closed_loop.findings.result import LoopResult, Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict, judge
from cluster_est.closed_loop.findings.wording import describe_effects, error_changes, where_left
from cluster_est.closed_loop.prepare import open_bench
from cluster_est.closed_loop.selection.forward_selection import SelectionResult, search
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.options import check_options
from cluster_est.problem.problem import Problem
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.result import Result
from cluster_est.running.arguments import check_problem, check_resources
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Note, Record, SearchRequest, Show
from cluster_est.uncertainty import examine
from workers.messages.checks import as_tuple, check_kind

FINAL = LeastSquares(trials=4, max_iterations=50)


def close_loop(
    problem: Problem,
    resources: Resources | None = None,
    settings: LoopSettings | None = None,
    seed: int = 0,
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
        Where simulations run, and the budget.
    settings
        Thresholds and sizes.
    seed
        Starts every random generator; the result is the same for any number of workers.
    record, show, note
        Called for each simulation, whenever something came back, and for each iteration; see
        `Runner`.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    begin = time.monotonic()
    resources = Resources() if resources is None else resources
    settings = LoopSettings() if settings is None else settings
    check_problem(problem)
    check_resources(resources)
    check_kind(settings, LoopSettings, "closed_loop", ProblemError)
    check_options(settings, "closed_loop", ProblemError)
    for key in ("forms", "sites"):
        as_tuple(getattr(settings, key), str, f"closed_loop.{key}", ProblemError)
    with open_bench(problem, resources, settings, seed, record, show, note) as bench:
        found = search(bench, FitStart(bench.problem, {}))
        judgement = judge(bench, found)
        report = _report(bench, found, judgement, begin)
    return replace(report, seconds=time.monotonic() - begin)


@dataclass(frozen=True)
class _FittedModels:
    """The declared and the final model, fitted to convergence and simulated everywhere."""

    before: Result
    after: Result

    @property
    def worse(self) -> bool:
        """Whether the held-out error has grown."""
        old, new = self.before.rmse("test"), self.after.rmse("test")
        return bool(np.isfinite(old) and not new <= old)


def _report(
    bench: LoopWorkbench, found: SelectionResult, judgement: ReasonedVerdict, begin: float
) -> LoopResult:
    """Final fits, the held-out veto, and everything in words."""
    before = _final(bench, found.base, begin)
    keep = judgement.verdict in (Verdict.FOUND, Verdict.PARTIAL)
    grown = _final(bench, found.current, begin) if found.current.added else before
    fits = _FittedModels(before, grown)
    if keep and fits.worse:
        old, new = before.rmse("test"), grown.rmse("test")
        judgement = ReasonedVerdict(
            Verdict.UNEXPLAINED,
            f"{judgement.reason}; but the held-out error would grow from {old:.4g} to {new:.4g} "
            "sigma, so nothing was added",
            judgement.closed,
        )
        keep = False
    named = describe_effects(bench, found, grown)
    notes = bench.notes
    if judgement.verdict in (Verdict.PARTIAL, Verdict.UNEXPLAINED):
        notes = (*notes, where_left(bench, found.current if keep else found.base))
    after = grown if keep else before
    if after.uncertainty is not None:
        notes = (*notes, *after.uncertainty.sentences)
    drawn = draw_effects(bench, found.current, grown) if keep else ()
    return LoopResult(
        verdict=judgement.verdict,
        summary=judgement.reason,
        effects=named if keep else (),
        before=before,
        after=after,
        errors=error_changes(bench, found, before, after),
        findings=found.findings,
        rejected=() if keep else named,
        noise=bench.noise_in_units(found.noise),
        sites=bench.sites,
        notes=notes,
        simulations=bench.meter.full,
        simulated=bench.runner.simulations,
        evaluations=bench.runner.evaluations,
        failures=bench.runner.failures,
        seconds=0.0,
        drawn=drawn,
    )


def _final(bench: LoopWorkbench, fitted: FittedModel, begin: float) -> Result:
    """Fit to convergence from where the search ended, and simulate every experiment."""
    space = bench.space(fitted.start)
    (solution,) = bench.runner.run([SearchRequest("final", FINAL, space, bench.seed)])
    units = {n: v.unit for n, v in bench.description.variables.items()}
    start = simulate_all(bench.runner, fitted.problem, {})
    known = examine(bench.runner, space, solution)
    return complete(
        bench.runner,
        space,
        solution,
        FINAL,
        start,
        units=units,
        seed=bench.seed,
        begin=begin,
        uncertainty=known,
    )
