"""What is left of the errors, beside the noise, on training and on held-out data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.effects import ErrorChange
from workers.messages import Role


def what_is_left(errors: Sequence[ErrorChange], over: str = "the noise", remark: str = "") -> str:
    """Say how large the error is that is left, beside the noise, and where that is not known.

    `remark` follows the sizes.
    """
    train, test = (largest_error(errors, role) for role in ("train", "test"))
    said = []
    worst = " in the worst output" if len({e.output for e in errors}) > 1 else ""
    if np.isfinite(train) and np.isfinite(test):
        said.append(
            f"what is left is {_times(train)} times {over} on training and {_times(test)} on "
            f"held-out data{worst}{remark}"
        )
    elif np.isfinite(train) or np.isfinite(test):
        where = "" if np.isfinite(train) else " on held-out data"
        size = f"{_times(train if not where else test)} times {over}{where}{worst}"
        said.append(f"what is left is {size}{remark}")
    silent = without_noise(errors)
    if silent:
        said.append(
            f"the noise of {', '.join(silent)} is not known, so what is left there was not "
            "compared with it"
        )
    for role, kind in (("train", "training"), ("test", "held-out")):
        failed = not_simulated([e for e in errors if e.role == role])
        if failed:
            said.append(f"{kind} experiment {', '.join(failed)} could not be simulated")
    return "; ".join(said)


def _times(size: float) -> str:
    """A multiple, with two decimals as far as they matter."""
    return f"{size:.2f}" if size < 10.0 else f"{size:.3g}"


def not_simulated(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Experiments with data that could not be simulated with the effects, each once."""
    rows = [e for e in errors if e.samples and not np.isfinite(e.rmse_after)]
    return tuple(dict.fromkeys(repr(e.experiment) for e in rows))


def no_longer_simulated(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Those of them that could be simulated before."""
    return not_simulated([e for e in errors if np.isfinite(e.rmse_before)])


def without_noise(errors: Sequence[ErrorChange]) -> tuple[str, ...]:
    """Outputs that have an error, and no noise that it could be compared with."""
    rows = [e for e in errors if e.rmse_after > 0.0 and not np.isfinite(e.normalised_after)]
    return tuple(dict.fromkeys(e.output for e in rows))


def over_noise(
    errors: Sequence[ErrorChange], noise: Mapping[str, float]
) -> tuple[ErrorChange, ...]:
    """Return the errors over another noise than the declared sigma, in units of that, by output."""
    return tuple(
        replace(
            e,
            normalised_before=e.normalised_before / noise.get(e.output, 1.0),
            normalised_after=e.normalised_after / noise.get(e.output, 1.0),
        )
        for e in errors
    )


def comparable(errors: Sequence[ErrorChange]) -> tuple[ErrorChange, ...]:
    """Return the errors that are known both before and after."""
    return tuple(
        e for e in errors if np.isfinite(e.normalised_before) and np.isfinite(e.normalised_after)
    )


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
