"""The verdict of a closed loop, with its reason."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.selection.rounds import RejectionReason, SelectionResult
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.workbench import LoopWorkbench


@dataclass(frozen=True)
class ReasonedVerdict:
    """A verdict and its reason in a sentence."""

    verdict: Verdict
    reason: str
    closed: float = np.nan


def judge(workbench: LoopWorkbench, found: SelectionResult) -> ReasonedVerdict:
    """Judge from the training experiments alone; the held-out ones may only take away."""
    thresholds = workbench.settings.thresholds.verdict
    lack, excess = _lack(workbench, found)
    if not found.current.added:
        return _nothing_added(found, lack, excess, workbench.settings)
    training, predicted = _closed(workbench, found)
    closed = min(training, predicted)
    tables = any(c.form.free for c in found.current.added)
    share = f"the effects close {training:.0%} of the gap between error and noise"
    if f"{predicted:.0%}" != f"{training:.0%}" and predicted < training:
        share += f", and {max(predicted, 0.0):.0%} in records that were left out to be predicted"
    if not lack or closed > thresholds.nearly_all:
        if tables:
            share += ", with a free curve: a shape that no form of the library has"
        return ReasonedVerdict(Verdict.FOUND, share, closed)
    better = np.mean(found.prediction.squares < found.base_prediction.squares)
    coloured = found.last.why == RejectionReason.COLOURED_NOISE
    noisy = coloured and excess < thresholds.coloured
    if noisy and not tables and better >= thresholds.mostly_better:
        rest = f"{share}; the rest is autocorrelated noise"
        return ReasonedVerdict(Verdict.FOUND, rest, closed)
    if closed > thresholds.most:
        return ReasonedVerdict(
            Verdict.PARTIAL, f"{share}; structure is left in the residual", closed
        )
    return ReasonedVerdict(
        Verdict.UNEXPLAINED,
        f"something is missing (residual {np.sqrt(1 + excess):.2f} times the noise), and nothing "
        "in the library explains it: the best effects would close only "
        f"{max(closed, 0.0):.0%} of the gap",
        closed,
    )


def _nothing_added(
    found: SelectionResult, lack: bool, excess: float, settings: LoopSettings
) -> ReasonedVerdict:
    why = found.last.why
    screening = found.last.screening
    if why == RejectionReason.NO_CANDIDATE:
        nowhere = (
            "no effect could be tried: no measured output, no input that the data drive, no "
            "estimated parameter that may change and no state derivative is open to the forms and "
            "sites of closed_loop"
        )
        if not lack:
            return ReasonedVerdict(Verdict.NONE, f"the residual looks like noise, but {nowhere}")
        return ReasonedVerdict(
            Verdict.UNEXPLAINED,
            f"something is missing (residual {np.sqrt(1 + excess):.2f} times the noise), but "
            f"{nowhere}",
        )
    if why == RejectionReason.NOT_SIGNIFICANT:
        if lack and screening.omnibus_white.p > settings.significance:
            return ReasonedVerdict(
                Verdict.COLOURED,
                "the residual is autocorrelated, but no candidate is significant (family-wise p = "
                f"{screening.p:.2g}), and nothing is left once that is allowed for",
            )
        if lack:
            return ReasonedVerdict(
                Verdict.UNEXPLAINED,
                "the residual has smooth structure, but no candidate is significant",
            )
        return ReasonedVerdict(
            Verdict.NONE, f"no candidate is significant (family-wise p = {screening.p:.2g})"
        )
    coloured = why == RejectionReason.COLOURED_NOISE
    if coloured and screening.omnibus.p > settings.thresholds.verdict.smooth:
        return ReasonedVerdict(
            Verdict.NONE,
            "no candidate is significant once the residual is whitened "
            f"(family-wise p = {screening.p_white:.2g})",
        )
    if coloured:
        return ReasonedVerdict(
            Verdict.COLOURED,
            "the residual is autocorrelated, but tied to no candidate once that is allowed for "
            f"(family-wise p = {screening.p_white:.2g})",
        )
    if lack:
        return ReasonedVerdict(
            Verdict.UNEXPLAINED, f"something is missing, and nothing explains it: {why}"
        )
    return ReasonedVerdict(Verdict.NONE, f"the best candidate was not accepted: {why}")


def _lack(workbench: LoopWorkbench, found: SelectionResult) -> tuple[bool, float]:
    """Return whether structure is left in the residual, and its excess over the noise."""
    floor = workbench.noise_floor(found.noise)
    excess = found.current.sse / floor - 1.0
    omnibus = found.last.screening.omnibus
    thresholds = workbench.settings.thresholds.verdict
    significant = omnibus.p <= workbench.settings.significance and omnibus.z > thresholds.structure
    return significant and excess > thresholds.excess, excess


def _closed(workbench: LoopWorkbench, found: SelectionResult) -> tuple[float, float]:
    """Shares of the gap to the noise that are closed, in training and in prediction."""
    floor = workbench.noise_floor(found.noise)
    base, now = found.base.sse, found.current.sse
    training = (base - now) / max(base - min(floor, now), 1e-12)
    least = workbench.settings.thresholds.selection.least_gap
    before, after = found.base_prediction.total, found.prediction.total
    predicted = (before - after) / max(before - floor, least * floor)
    return float(training), float(predicted)
