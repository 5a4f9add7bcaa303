"""What is left of the errors, beside the noise, on training and on held-out data."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.findings.effects import ErrorChange
from workers.messages import Role


def what_is_left(errors: Sequence[ErrorChange], scale: str = "the noise") -> str:
    """Say how large the error is that is left, beside the noise or what `scale` names."""
    train, test = (largest_error(errors, role) for role in ("train", "test"))
    if not np.isfinite(test):
        return f"what is left is {train:.3g} times {scale}"
    return f"what is left is {train:.3g} times {scale} on training and {test:.3g} on held-out data"


def largest_error(errors: Sequence[ErrorChange], role: Role) -> float:
    """Return the error over the noise of the output where it is largest, after; NaN for none."""
    outputs = dict.fromkeys(e.output for e in errors if e.role == role)
    own = [
        pooled_error([e for e in errors if e.output == output], role, after=True)
        for output in outputs
    ]
    return max((e for e in own if np.isfinite(e)), default=np.nan)


def pooled_error(errors: Sequence[ErrorChange], role: Role, *, after: bool) -> float:
    """Return the root mean square of errors over their noise; NaN where there are none."""
    rows = [e for e in errors if e.role == role]
    values = np.array([e.normalised_after if after else e.normalised_before for e in rows])
    samples = np.array([e.samples for e in rows], float)
    known = np.isfinite(values)
    if not known.any():
        return np.nan
    return float(np.sqrt(np.average(values[known] ** 2, weights=samples[known])))
