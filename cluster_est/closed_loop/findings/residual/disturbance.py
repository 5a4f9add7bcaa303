"""What nothing explains, described as a disturbance: its size, its spectrum, and where it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from cluster_est.closed_loop.findings.words.numbers import readable_time
from cluster_est.closed_loop.fitter import FittedModel
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.statistics.records import OutputRecord
from workers.messages import FloatArray

SHORTEST = 16
"""Samples that a record needs for a spectrum."""

MOST = 0.9
"""Share of the power that lies below the frequency that is named."""

GAPS = 2.0
"""Times its samples that a record may have even steps: of one with long gaps, or sampled far more
slowly than others, a spectrum would be that of straight lines."""

NARROW = 0.5
"""Share of the power in one peak from which on it is named."""


@dataclass(frozen=True)
class UnexplainedResidual:
    """The part of an output beyond its noise that nothing explains.

    Attributes
    ----------
    output, unit
        Of the measured variable.
    size
        Root mean square in that unit, without the noise.
    over_noise
        The same over the standard deviation of the noise; NaN where there is no noise.
    shortest_period
        Seconds: nine tenths of its power are in slower swings; NaN for records that are too short.
    period
        Seconds, of a single swing that has more than half of the power; else NaN.
    columns
        Columns of the tables that are not used and vary with it, each in a sentence.
    """

    output: str
    unit: str
    size: float
    over_noise: float
    shortest_period: float = np.nan
    period: float = np.nan
    columns: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """Say how large it is, and how fast."""
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        said = f"{self.size:.3g}{unit} rms at {self.output}"
        if np.isfinite(self.over_noise):
            said += f", {self.over_noise:.3g} times the noise from sample to sample"
        if np.isfinite(self.period):
            return f"{said}, most of it with a period of {readable_time(self.period)}"
        if np.isfinite(self.shortest_period):
            shortest = readable_time(self.shortest_period)
            return f"{said}, nine tenths of it with periods above {shortest}"
        return said


def unexplained_residuals(
    workbench: LoopWorkbench, fitted: FittedModel, noise: FloatArray
) -> tuple[UnexplainedResidual, ...]:
    """Describe what a fit leaves of each output beyond its noise; the largest first.

    Parameters
    ----------
    workbench, fitted
        Where, and the fit.
    noise : (outputs,)
        Standard deviations of the noise, in units of the residual.
    """
    records = workbench.records
    sigmas = workbench.sigmas
    found = []
    for number, name in enumerate(records.outputs):
        own = [item for item in records.items if item.output == number]
        rows = records.of_output(number)
        part, level = fitted.residuals[rows], float(np.nan_to_num(noise[number]))
        square = float(np.mean(part**2)) if len(part) else 0.0
        if not square > level**2:
            continue
        beyond = float(np.sqrt(square - level**2))
        # in units of the output, whose sigma each experiment may have for itself
        size = float(np.sqrt(np.mean((part * sigmas[rows]) ** 2) * (1.0 - level**2 / square)))
        variable = workbench.description.variables.get(name)
        shortest, period = _periods(fitted.residuals, own, level)
        found.append(
            UnexplainedResidual(
                output=name,
                unit=variable.unit if variable is not None else "",
                size=size,
                over_noise=beyond / level if level > 0.0 else np.nan,
                shortest_period=shortest,
                period=period,
            )
        )
    return tuple(sorted(found, key=lambda each: -np.nan_to_num(each.over_noise, nan=np.inf)))


def _periods(
    residuals: FloatArray, records: Sequence[OutputRecord], noise: float
) -> tuple[float, float]:
    """The shortest period of most of the power, and the one of a single peak; NaN for neither.

    The power is that of Welch's method, doi:10.1109/TAU.1967.1161901, less that of white noise.
    """
    long = [item for item in records if len(item.times) >= SHORTEST]
    if not long:
        return np.nan, np.nan
    step = float(np.median(np.concatenate([np.diff(item.times) for item in long])))
    long = [r for r in long if SHORTEST <= _even_count(r, step) <= GAPS * len(r.times)]
    if not long:
        return np.nan, np.nan
    length = min(_even_count(item, step) for item in long)
    total = np.zeros(length // 2 + 1)
    for item in long:
        even = _even(residuals, item, step)
        frequencies, density = welch(even, 1.0 / step, nperseg=length, detrend=False)
        total += len(item.times) * density
    total /= sum(len(item.times) for item in long)
    power = np.maximum(total - 2.0 * noise**2 * step, 0.0)
    if not power.sum() > 0.0:
        return np.nan, np.nan
    shares = power / power.sum()
    fast = frequencies[min(int(np.searchsorted(np.cumsum(shares), MOST)), len(shares) - 1)]
    peak = int(np.argmax(shares))
    around = shares[max(peak - 1, 0) : peak + 2].sum()
    narrow = peak >= 3 and around >= NARROW  # three periods in a record, or it is no period
    return (
        float(1.0 / fast) if fast > 0.0 else np.nan,
        float(1.0 / frequencies[peak]) if narrow else np.nan,
    )


def _even(residuals: FloatArray, record: OutputRecord, step: float) -> FloatArray:
    """A record's residual at even steps."""
    even = record.times[0] + step * np.arange(_even_count(record, step))
    return np.asarray(np.interp(even, record.times, residuals[record.rows]))


def _even_count(record: OutputRecord, step: float) -> int:
    """Number of even steps in a record."""
    return int((record.times[-1] - record.times[0]) / step) + 1
