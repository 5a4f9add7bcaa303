"""The recipe of the closed loop with process noise: passes of the search, each under held noise.

1. Fit the declared model by prediction errors, with its noise.
2. Hold that noise and search: the residuals are innovations over their standard deviations.
3. Fit the noise again with what was found, hold it, and search again from the declared model, until
   the search finds the same.
4. Compare both models with noise of their own, and report.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

from cluster_est.closed_loop.account import account
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.effects import NoiseChange, Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict
from cluster_est.closed_loop.prepare import LoopRequest, open_workbench
from cluster_est.closed_loop.process_noise.change import (
    last_fits_with_noise,
    simulation_sentence,
    why_not_likely,
)
from cluster_est.closed_loop.process_noise.held import (
    check_noise_parameters,
    hold_noise,
    released,
)
from cluster_est.closed_loop.search import SearchedModel, search_for_effects
from cluster_est.closed_loop.workbench import FitStart, LoopWorkbench

MOST_PASSES = 4
NOT_LOOKED_FOR = (
    "process noise: outliers and noise that grows with the signal were not looked for, nor effects "
    "at outputs, delays, backlash and rate limits"
)
NOT_AGAIN = (
    "{} would take the place of a part of the process noise, but is not found any more under the "
    "noise that it leaves"
)


def close_loop_under_noise(request: LoopRequest, begin: float) -> LoopResult:
    """Find what a model with process noise lacks.

    Parameters
    ----------
    request
        Its problem has process noise.
    begin
        A reading of the monotonic clock.

    Raises
    ------
    ClusterEstError
        If model, experiments and machine do not fit together, or the data cannot carry a search.
    """
    check_noise_parameters(request.problem)
    with open_workbench(request) as workbench:
        workbench.enter("the process noise")
        held = hold_noise(workbench, request.problem, FitStart(request.problem, {}), {})
        spent = [SpentSimulations.at(workbench)]
    passed: list[frozenset[str]] = []
    while True:
        used = sum(each.evaluations for each in spent)
        left = request.environment.left(used, time.monotonic() - begin)
        with open_workbench(replace(request, problem=held.problem, environment=left)) as workbench:
            searched = search_for_effects(workbench, held.start, request.environment.resources)
            structure = searched.found.current.structure
            passed.append(structure)
            if not structure or structure in passed[:-1] or len(passed) == MOST_PASSES:
                result = _accounted(workbench, request, searched, passed, begin)
                return with_all(result, spent)
            workbench.enter("the process noise that is left")
            start = released(searched.found.current.start, request.problem)
            held = hold_noise(workbench, request.problem, start, held.values)
            spent.append(SpentSimulations.at(workbench))


@dataclass(frozen=True)
class SpentSimulations:
    """What a workbench has simulated; see `LoopResult`."""

    simulations: float
    simulated: int
    evaluations: int
    failures: int

    @classmethod
    def at(cls, workbench: LoopWorkbench) -> Self:
        runner = workbench.runner
        return cls(workbench.meter.full, runner.simulations, runner.evaluations, runner.failures)


def with_all(result: LoopResult, spent: Sequence[SpentSimulations]) -> LoopResult:
    """Add what was simulated at the workbenches before the last one."""
    return replace(
        result,
        simulations=result.simulations + sum(each.simulations for each in spent),
        simulated=result.simulated + sum(each.simulated for each in spent),
        evaluations=result.evaluations + sum(each.evaluations for each in spent),
        failures=result.failures + sum(each.failures for each in spent),
    )


def _accounted(
    workbench: LoopWorkbench,
    request: LoopRequest,
    searched: SearchedModel,
    passed: list[frozenset[str]],
    begin: float,
) -> LoopResult:
    """Compare both models with noise of their own, and put it into words."""
    workbench.enter("before and after")
    found, judged = searched.found, searched.judged
    fits = last_fits_with_noise(workbench, request.problem, found, begin)
    if judged.verdict in CLAIMS:
        against = why_not_likely(workbench, found, fits)
        if against:
            why = f"the best candidate was not accepted: {against}"
            judged = replace(judged, verdict=Verdict.NONE, reason=why)
    elif len(passed) > 1 and not found.current.added:
        judged = ReasonedVerdict(Verdict.NONE, NOT_AGAIN.format(" and ".join(sorted(passed[-2]))))
    result = account(workbench, found, judged, fits)
    kept = bool(result.effects)
    said = [noise_sentence(each, kept=kept) for each in fits.noise]
    free = simulation_sentence(workbench, result.before, result.after) if kept else ""
    return replace(
        result,
        summary="; ".join([result.summary, *said]),
        notes=tuple(
            filter(
                None,
                (
                    *searched.error.notes,
                    *result.notes,
                    free,
                    NOT_LOOKED_FOR,
                    _unsettled(passed),
                    *expensive_structures(found.path),
                ),
            )
        ),
        seconds=time.monotonic() - begin,
        failures_in_search=searched.failures,
    )


def _unsettled(passed: list[frozenset[str]]) -> str:
    """Say that the passes have not come to an end, where that is so."""
    if not passed[-1] or passed[-1] in passed[:-1]:
        return ""
    return (
        f"after {len(passed)} passes the search still found other effects than in the pass before: "
        "their names are uncertain"
    )


def noise_sentence(change: NoiseChange, *, kept: bool) -> str:
    """Say how strong process noise is, and was."""
    unit = f" {change.unit}" if change.unit not in ("", "1") else ""
    kind = "standard deviation" if change.coloured else "strength"
    lasting = f", lasting {change.time_before:.3g} s" if change.coloured else ""
    if not kept:
        return f"process noise {change.name}: {kind} {change.before:.3g}{unit}{lasting}"
    if change.coloured:
        lasting = f", lasting {change.time_before:.3g} s before and {change.time_after:.3g} s now"
    left = change.variance_left
    return (
        f"process noise {change.name}: {kind} {change.before:.3g} before and {change.after:.3g}"
        f"{unit} now, {left:.0%} of its variance{lasting}"
    )
