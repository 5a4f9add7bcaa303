"""The verdict after the final fits: what is left, on training and held-out data, can lower it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.effects import ErrorChange, Verdict
from cluster_est.closed_loop.findings.residual.remaining_error import (
    comparable,
    largest_error,
    no_longer_simulated,
    not_simulated,
    over_noise,
    pooled_error,
    what_is_left,
    without_noise,
)
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict
from cluster_est.closed_loop.settings import LoopSettings


def confirmed(
    judged: ReasonedVerdict, errors: Sequence[ErrorChange], settings: LoopSettings
) -> ReasonedVerdict:
    """Return the verdict after the final fits: what is left on training and on held-out data.

    Parameters
    ----------
    judged
        From the training experiments.
    errors
        Of the declared model fitted, and of the one with the effects.
    settings
        Of the loop.
    """
    if judged.verdict not in CLAIMS:
        return judged
    near, errors = settings.near_noise, over_noise(errors, judged.noise)
    veto = _veto(judged, errors, near)
    if veto:
        reason = f"{judged.reason}; but {veto}, so nothing was added"
        return replace(judged, verdict=Verdict.UNEXPLAINED, reason=reason)
    left = np.array([largest_error(errors, role) for role in ("train", "test")])
    verdict, remark = judged.verdict, ""
    if verdict is Verdict.FOUND and np.any(left > near):
        verdict = Verdict.PARTIAL
        remark = f", which is more than the {near:.3g} times up to which all counts as found"
    said = what_is_left(errors, judged.over, remark)
    if verdict is Verdict.FOUND and (without_noise(errors) or not_simulated(errors)):
        verdict = Verdict.PARTIAL
        said += ", so it is not known whether all was found"
    return replace(judged, verdict=verdict, reason="; ".join(filter(None, (judged.reason, said))))


def _veto(judged: ReasonedVerdict, errors: Sequence[ErrorChange], near: float) -> str:
    """Return what held-out data have against the effects; "" for nothing."""
    lost = no_longer_simulated(errors)
    if lost:
        return f"with them experiment {', '.join(lost)} cannot be simulated any more"
    both = comparable(errors)
    old, new = (pooled_error(both, "test", after=after) for after in (False, True))
    if new > old and not judged.filtered:  # there likelihoods have been compared
        return f"the held-out error would grow from {old:.4g} to {new:.4g} times {judged.over}"
    floor = judged.floor
    closed = (old**2 - new**2) / (old**2 - floor**2) if old > near * floor else np.nan
    if closed < judged.least:
        return (
            f"on held-out data only {closed:.0%} of the gap would be closed, from {old:.3g} to "
            f"{new:.3g} times {judged.over}"
        )
    return ""
