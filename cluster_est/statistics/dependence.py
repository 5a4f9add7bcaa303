"""Tests whether a residual depends on a measured signal; the test is valid for smooth signals.

Two smooth, independent signals often seem correlated if they contain only a few oscillations. So an
autoregression first whitens the residual, and the signal passes the same filter. The regression of
a white series on an independent signal has the F distribution, however smooth the signal is
(prewhitening; L. D. Haugh, J. Am. Stat. Assoc. 71 (1976) 378-385,
doi:10.1080/01621459.1976.10480353).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import detrend, lfilter
from scipy.stats import f as f_distribution

from workers.messages import FloatArray

ORDERS = (1, 2, 4, 8, 12, 20)
"""Orders of the autoregression; Akaike's criterion chooses the best one."""

LAGS = (4.0, 16.0, 64.0)
"""Time constants, in samples, of low-pass filters of the signal, because a model reacts late."""

MOST_DEPENDENCE_SAMPLES = 3000
"""Largest total number of samples; longer data are averaged over neighbouring samples."""

LEAST_DEPENDENCE_SAMPLES = 60
"""Least total number of samples for a test."""

SHIFTS = 40
"""Number of shifts of the signal along the records; their F ratios calibrate the test."""

ROUNDING_OF_SIGNAL = 1e-10
"""Share of a signal's largest value below which a variation counts as rounding."""

Pair = tuple[FloatArray, FloatArray]
"""The residual of a record, and the signal at the same times."""


@dataclass(frozen=True)
class Dependence:
    """The dependence of a residual on a signal.

    Attributes
    ----------
    p
        p-value of the test; 1 if there are too few samples.
    share
        Share of the residual's variance that the signal explains.
    """

    p: float
    share: float


NO_DEPENDENCE = Dependence(1.0, 0.0)


def dependence(
    records: Sequence[Pair], known: Sequence[Mapping[str, FloatArray]] | None = None
) -> Dependence:
    """Test whether a residual depends on a signal, with or without a delay.

    Parameters
    ----------
    records
        Residual and signal of each record, evenly sampled with the same step in all records. The
        offset and trend of each record are removed, because any two trends seem correlated.
    known
        For each record, signals on which both may depend, by name and with the same length. Their
        influence, with or without a delay, is removed first, and also a decay from the start.
        Otherwise all signals that depend on the same measured input would seem to depend on each
        other. A signal that is constant or missing in a record is ignored there.
    """
    block = max(1, -(-sum(len(y) for y, _ in records) // MOST_DEPENDENCE_SAMPLES))
    longest = max(ORDERS)
    kept = [i for i, (y, _) in enumerate(records) if len(y) // block > 2 * longest]
    residuals = [_detrended(_averaged(records[i][0], block)) for i in kept]
    signals = [_averaged(records[i][1], block) for i in kept]
    total = sum(len(y) for y in residuals)
    scale = float(np.std(np.concatenate(signals))) if kept else 0.0
    if total < LEAST_DEPENDENCE_SAMPLES or not any(np.any(y) for y in residuals) or not scale > 0.0:
        return NO_DEPENDENCE
    columns = [_late(x / scale) for x in signals]
    others = [{} if known is None else known[i] for i in kept]
    names = list(dict.fromkeys(name for own in others for name in own))
    given = [
        _nuisances(len(y), [_averaged(own[n], block) if n in own else None for n in names])
        for y, own in zip(residuals, others, strict=True)
    ]
    whitener = _Whitener(_autoregression(residuals), given)
    white = whitener.of(residuals)
    freedom = len(white) - whitener.rank - columns[0].shape[1] - 2 * len(kept)
    if freedom < longest:
        return NO_DEPENDENCE
    found = _ratio(white, whitener.of(columns), freedom)
    shifted = [
        _ratio(white, whitener.of([_moved(c, part) for c in columns]), freedom)
        for part in np.linspace(0.1, 0.9, SHIFTS)
    ]
    k = columns[0].shape[1]
    usual = float(f_distribution.ppf(0.75, k, freedom))
    inflated = max(1.0, float(np.quantile(shifted, 0.75)) / usual)
    p = float(f_distribution.sf(found / inflated, k, freedom))
    return Dependence(p, _share(residuals, columns))


class _Whitener:
    """Removes from records what an autoregression predicts, and what nuisances explain."""

    def __init__(self, coefficients: FloatArray, nuisances: Sequence[FloatArray]) -> None:
        self._coefficients = coefficients
        u, sizes, _ = np.linalg.svd(self._filtered(nuisances), full_matrices=False)
        self._basis = u[:, sizes > 1e-9 * max(float(sizes[0]), 1e-300)]
        self.rank = self._basis.shape[1]

    def of(self, records: Sequence[FloatArray]) -> FloatArray:
        """Return the filtered records, one after the other."""
        white = self._filtered(records)
        return white - self._basis @ (self._basis.T @ white)

    def _filtered(self, records: Sequence[FloatArray]) -> FloatArray:
        skip = len(self._coefficients)
        filters = [1.0, *-self._coefficients]
        return np.concatenate([lfilter(filters, [1.0], r, axis=0)[skip:] for r in records])


def _nuisances(length: int, known: Sequence[FloatArray | None]) -> FloatArray:
    """Return decays from the start, and normalised signals with their low-pass filters: (n, m)."""
    steps = np.arange(length)
    columns = [np.column_stack([_detrended(np.exp(-steps / lag)) for lag in LAGS])]
    for signal in known:
        if signal is None or not np.ptp(signal) > 0.0:
            columns.append(np.zeros((length, 1 + len(LAGS))))
        else:
            columns.append(_late(signal / np.std(signal)))
    return np.hstack(columns)


def _averaged(values: FloatArray, block: int) -> FloatArray:
    """Return the means of blocks of neighbours; an incomplete block at the end is left out."""
    whole = len(values) // block * block
    return np.asarray(values[:whole].reshape(-1, block).mean(axis=1))


def _detrended(values: FloatArray) -> FloatArray:
    """Return the values minus their linear trend; zeros if only rounding would remain."""
    if len(values) < 2:
        return np.zeros(len(values))
    left = np.asarray(detrend(values))
    return (
        left
        if np.abs(left).max() > ROUNDING_OF_SIGNAL * np.abs(values).max()
        else np.zeros(len(values))
    )


def _late(x: FloatArray) -> FloatArray:
    """Return a signal and its low-pass filters, each without its trend: (n, k)."""
    columns = [x]
    for lag in LAGS:
        keep = float(np.exp(-1.0 / lag))
        columns.append(lfilter([1.0 - keep], [1.0, -keep], x, zi=np.array([keep * x[0]]))[0])
    return np.column_stack([_detrended(c) for c in columns])


def _moved(columns: FloatArray, part: float) -> FloatArray:
    return np.roll(columns, int(part * len(columns)), axis=0)


def _autoregression(records: Sequence[FloatArray]) -> FloatArray:
    """Return the coefficients of the best order, by least squares over all records."""
    longest = max(ORDERS)
    target = np.concatenate([y[longest:] for y in records])
    past = np.concatenate(
        [np.column_stack([y[longest - k : -k] for k in range(1, longest + 1)]) for y in records]
    )
    best = (np.inf, np.zeros(0))
    for order in ORDERS:
        own = np.linalg.lstsq(past[:, :order], target, rcond=None)[0]
        left = max(float(np.mean((target - past[:, :order] @ own) ** 2)), 1e-300)
        criterion = len(target) * np.log(left) + 2.0 * order
        best = min(best, (criterion, own), key=lambda pair: pair[0])
    return best[1]


def _ratio(white: FloatArray, columns: FloatArray, freedom: int) -> float:
    """Return the F ratio of the regression of a white series on columns."""
    explained = _explained(white, columns)
    rest = max(float(white @ white) - explained, 1e-300)
    return float(explained / columns.shape[1] / (rest / freedom))


def _explained(y: FloatArray, columns: FloatArray) -> float:
    """Return the sum of squares of y that the columns explain; they may be dependent."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-12 * max(values[-1], 1e-300)
    along = vectors[:, kept].T @ (columns.T @ y)
    return float(np.sum(along**2 / values[kept]))


def _share(residuals: Sequence[FloatArray], columns: Sequence[FloatArray]) -> float:
    """Return the share of the variance of the unfiltered residuals that the columns explain."""
    y, x = np.concatenate(residuals), np.concatenate(columns)
    return min(_explained(y, x) / float(y @ y), 1.0)


def periodic_share(values: FloatArray, times: FloatArray, period: float) -> float:
    """Return the share of a signal's variance, without its trend, in a wave with this period."""
    phase = 2.0 * np.pi * times / period
    basis = np.column_stack([np.sin(phase), np.cos(phase)])
    columns = np.column_stack([_detrended(c) for c in basis.T])
    about = _detrended(values)
    square = float(about @ about)
    return min(_explained(about, columns) / square, 1.0) if square > 0.0 else 0.0
