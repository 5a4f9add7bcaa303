"""What a closed loop has found so far: a result after each round, should nothing come after it."""

from __future__ import annotations

from dataclasses import replace

from cluster_est.closed_loop.account import FINAL, LastFits, account
from cluster_est.closed_loop.findings.description import error_changes
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.findings.verdict import judge
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.errors import ClusterEstError
from cluster_est.methods.method import Ending, Solution
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.result import Result
from cluster_est.running.search_state import assemble_evaluation

NOT_THE_LAST = (
    "the fits are those of the search, which are not refined any more, and nothing was looked for "
    "beyond these effects; --resume goes on"
)


def result_so_far(
    workbench: LoopWorkbench, found: SelectionResult, begin: float, said: str = ""
) -> LoopResult | None:
    """Return the best structure that was accepted so far as a result; None where it has none.

    Its simulations are not counted and not logged, so that the run is the same without it.

    Parameters
    ----------
    found
        After a round in which something was added.
    begin
        A reading of the monotonic clock.
    said
        Of the records that the search is on.
    """
    try:
        with workbench.runner.uncounted():
            return _result(workbench, found, begin, said)
    except ClusterEstError:
        return None


def _result(
    workbench: LoopWorkbench, found: SelectionResult, begin: float, said: str
) -> LoopResult:
    judged = replace(judge(workbench, found), verdict=Verdict.PARTIAL)
    rounds = f"stopped after round {len(found.steps)} of at most {workbench.settings.max_effects}"
    before, after = (
        _fit(workbench.fitter, fitted, begin) for fitted in (found.base, found.current)
    )
    changes = [error_changes(workbench, found, before, each) for each in (after, before)]
    result = account(workbench, found, judged, LastFits(before, after, changes[0], changes[1]))
    notes = filter(None, (NOT_THE_LAST, said, *result.notes))
    message = f"{rounds}: {result.message}"
    return replace(result, message=message, notes=tuple(notes), seconds=after.seconds)


def _fit(fitter: Fitter, fitted: FittedModel, begin: float) -> Result:
    """The result of a fit of the search, which is simulated once more."""
    space, runner = fitted.space, fitter.runner
    values = space.physical(fitted.x)
    effects = fitted.problem.effects
    outcomes = runner.simulate(values, space.experiments, "residuals", "final", effects)
    at = assemble_evaluation(space, fitted.x, tuple(outcomes), 0)
    ending = Ending.CONVERGED if fitted.converged else Ending.MAX_ITERATIONS
    solution = Solution(fitted.x, at.cost, ending, jacobian=fitted.jacobian, at=at)
    return complete(
        runner,
        space,
        solution,
        FINAL,
        simulate_all(runner, fitted.problem, {}),
        variables=fitter.description.variables,
        seed=fitter.seed,
        begin=begin,
        steps=GuardedSteps(),
    )
