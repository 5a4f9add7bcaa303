"""The candidates of a search as evidence: how far each of them came."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.screening.evidence import CandidateEvidence, CandidateStage
from cluster_est.closed_loop.screening.screen import findings, refreshed
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.rounds import RoundEnd
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench


def noted(
    workbench: LoopWorkbench, current: FittedModel, end: RoundEnd, number: int
) -> list[CandidateEvidence]:
    """Return the candidates of a round, with how far each came."""
    found = findings(end.seen.screening.ranking, current, number)
    base = current.criterion(workbench.records)
    reached = [
        (c, CandidateStage.REFITTED)
        for c in end.compared
        if c.fitted.structure - {c.candidate.effect.name} == current.structure
    ]
    if end.won is not None:
        reached.append((end.won, CandidateStage.ACCEPTED))
    for contender, stage in reached:
        for candidate in contender.fitted.added:
            name = candidate.effect.name
            known = found.get(name) or _as_finer(found.values(), candidate)
            if known is not None:
                found[name] = refreshed(known, stage, contender.criterion - base)
    return list(found.values())


def with_single(
    seen: Sequence[CandidateEvidence], won: RefittedCandidate, criterion: float
) -> list[CandidateEvidence]:
    """Return the candidates, with the one that took the place of all effects as accepted."""
    first = [each for each in seen if each.step == 1]
    own = won.candidate
    known = next((each for each in first if _is(each, own)), None) or _as_finer(first, own)
    if known is None:
        return list(seen)
    accepted = refreshed(known, CandidateStage.ACCEPTED, criterion)
    return [accepted, *(each for each in seen if each.step != 1 or not _is(each, own))]


def _is(evidence: CandidateEvidence, candidate: EffectCandidate) -> bool:
    place = (str(candidate.site), candidate.form.name, candidate.effect.variables)
    return (evidence.site, evidence.form, evidence.variables) == place


def _as_finer(
    found: Iterable[CandidateEvidence], candidate: EffectCandidate
) -> CandidateEvidence | None:
    """Return the evidence of a finer curve: that of the one with which its place was screened."""
    if not candidate.form.finer_than:
        return None
    place = (str(candidate.site), candidate.form.family, candidate.effect.variables)
    return next(
        (
            replace(each, form=candidate.form.name)
            for each in found
            if (each.site, each.family, each.variables) == place
        ),
        None,
    )
