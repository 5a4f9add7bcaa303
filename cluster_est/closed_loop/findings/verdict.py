"""What is said in the end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.closed_loop.findings.result import Verdict
from cluster_est.closed_loop.selection.forward_selection import SelectionResult
from cluster_est.closed_loop.workbench import LoopWorkbench

STRUCTURE = 5.0
"""Standardised omnibus statistic above which structure counts as left."""
EXCESS = 0.05
"""Residual over noise, in squares, below which nothing can be left."""
COLOURED = 25.0
"""Residual over noise, in squares, above which what is left is no noise, however coloured."""
NEARLY_ALL, MOST = 0.98, 0.6
"""Shares of the gap to the noise that effects must close for "found" and "partial"."""


@dataclass(frozen=True)
class ReasonedVerdict:
    """A verdict and its reason in a sentence."""

    verdict: Verdict
    reason: str
    closed: float = np.nan


def judge(bench: LoopWorkbench, found: SelectionResult) -> ReasonedVerdict:
    """Judge from the training experiments alone; the held-out ones may only take away."""
    lack, excess = _lack(bench, found)
    if not found.current.added:
        return _nothing_added(found, lack, bench.settings.significance)
    training, predicted = _closed(bench, found)
    closed = min(training, predicted)
    tables = any(c.form.family == "table" for c in found.current.added)
    share = f"the effects close {training:.0%} of the gap between error and noise"
    if f"{predicted:.0%}" != f"{training:.0%}" and predicted < training:
        share += f", and {max(predicted, 0.0):.0%} in records that were left out to be predicted"
    if not lack or closed > NEARLY_ALL:
        if tables:
            return ReasonedVerdict(Verdict.PARTIAL, f"{share}, but by a free table only", closed)
        return ReasonedVerdict(Verdict.FOUND, share, closed)
    better = np.mean(found.prediction.squares < found.base_prediction.squares)
    noisy = found.last.why == "coloured noise" and excess < COLOURED
    if noisy and not tables and better >= 0.75:
        rest = f"{share}; the rest is autocorrelated noise"
        return ReasonedVerdict(Verdict.FOUND, rest, closed)
    if closed > MOST and not tables:
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


def _nothing_added(found: SelectionResult, lack: bool, significance: float) -> ReasonedVerdict:
    why = found.last.why
    screening = found.last.screening
    if why == "nothing significant":
        if lack and screening.omnibus_white.p > significance:
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
    if why == "coloured noise" and screening.omnibus.p > 0.1:
        return ReasonedVerdict(
            Verdict.NONE,
            "no candidate is significant once the residual is whitened "
            f"(family-wise p = {screening.p_white:.2g})",
        )
    if why == "coloured noise":
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


def _lack(bench: LoopWorkbench, found: SelectionResult) -> tuple[bool, float]:
    """Whether structure is left in the residual, and its excess over the noise."""
    floor = bench.noise_floor(found.noise)
    excess = found.current.sse / floor - 1.0
    omnibus = found.last.screening.omnibus
    significant = omnibus.p <= bench.settings.significance and omnibus.z > STRUCTURE
    return significant and excess > EXCESS, excess


def _closed(bench: LoopWorkbench, found: SelectionResult) -> tuple[float, float]:
    """Shares of the gap to the noise that are closed, in training and in prediction."""
    floor = bench.noise_floor(found.noise)
    base, now = found.base.sse, found.current.sse
    training = (base - now) / max(base - min(floor, now), 1e-12)
    before, after = found.base_prediction.total, found.prediction.total
    predicted = (before - after) / max(before - floor, 0.02 * floor)
    return float(training), float(predicted)
