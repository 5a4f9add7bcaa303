"""Whether a residual varies with a measured signal: a test that autocorrelation does not fool.

Two smooth signals that have nothing to do with each other correlate as soon as they are as long as
a few of their swings. So the residual is made white first, by an autoregression, and the signal is
filtered in the same way: of a white series, the regression on anything that does not depend on it
has the F distribution, however smooth that may be (prewhitening; L. D. Haugh, J. Am. Stat. Assoc.
71 (1976) 378-385, doi:10.1080/01621459.1976.10480353).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import detrend, lfilter
from scipy.stats import f as f_distribution

from workers.messages import FloatArray

ORDERS = (1, 2, 4, 8, 12, 20)
"""Orders of the autoregression; the best by Akaike's criterion is taken."""

LAGS = (4.0, 16.0, 64.0)
"""Time constants, in samples, of low passes of the signal: a model answers late."""

MOST_DEPENDENCE_SAMPLES = 3000
"""Samples in all; longer data are averaged over neighbours."""

LEAST_DEPENDENCE_SAMPLES = 60
"""Samples in all, below which nothing is said."""

SHIFTS = 40
"""Shifts of the signal along the records, by which the test's own scale is measured."""

ROUNDING_OF_SIGNAL = 1e-10
"""Share of a signal's largest value that is no variation."""

Pair = tuple[FloatArray, FloatArray]
"""The residual of a record, and the signal at the same times."""


@dataclass(frozen=True)
class Dependence:
    """How far a residual varies with a signal.

    Attributes
    ----------
    p
        The probability of as much by chance; 1 where there are too few samples.
    share
        Of the residual's variance that the signal carries.
    """

    p: float
    share: float


NO_DEPENDENCE = Dependence(1.0, 0.0)


def dependence(
    records: Sequence[Pair], known: Sequence[Mapping[str, FloatArray]] | None = None
) -> Dependence:
    """Test whether a residual varies with a signal, at once or late.

    Parameters
    ----------
    records
        Residual and signal of each record, evenly sampled, all at one step. Each record may have an
        offset and a trend of its own: any two trends go together.
    known
        For each record signals that both may follow, by name, as long as those: what these say, at
        once or late, is taken out first, as is a decay from the start. Else everything that a
        measured input moves would vary with everything else that it moves. One that stands still
        in a record, or is not there, says nothing in that record.
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
    """Filters records to what an autoregression does not predict, and nuisances do not say."""

    def __init__(self, coefficients: FloatArray, nuisances: Sequence[FloatArray]) -> None:
        self._coefficients = coefficients
        u, sizes, _ = np.linalg.svd(self._filtered(nuisances), full_matrices=False)
        self._basis = u[:, sizes > 1e-9 * max(float(sizes[0]), 1e-300)]
        self.rank = self._basis.shape[1]

    def of(self, records: Sequence[FloatArray]) -> FloatArray:
        """Return the records, filtered, one behind the other."""
        white = self._filtered(records)
        return white - self._basis @ (self._basis.T @ white)

    def _filtered(self, records: Sequence[FloatArray]) -> FloatArray:
        skip = len(self._coefficients)
        filters = [1.0, *-self._coefficients]
        return np.concatenate([lfilter(filters, [1.0], r, axis=0)[skip:] for r in records])


def _nuisances(length: int, known: Sequence[FloatArray | None]) -> FloatArray:
    """(n, m): decays from the start, and signals with their low passes, all of one size."""
    steps = np.arange(length)
    columns = [np.column_stack([_detrended(np.exp(-steps / lag)) for lag in LAGS])]
    for signal in known:
        if signal is None or not np.ptp(signal) > 0.0:
            columns.append(np.zeros((length, 1 + len(LAGS))))
        else:
            columns.append(_late(signal / np.std(signal)))
    return np.hstack(columns)


def _averaged(values: FloatArray, block: int) -> FloatArray:
    """Means of neighbours; what is left at the end is left out."""
    whole = len(values) // block * block
    return np.asarray(values[:whole].reshape(-1, block).mean(axis=1))


def _detrended(values: FloatArray) -> FloatArray:
    """Without the straight line that fits best; zeros where only rounding would be left."""
    if len(values) < 2:
        return np.zeros(len(values))
    left = np.asarray(detrend(values))
    return (
        left
        if np.abs(left).max() > ROUNDING_OF_SIGNAL * np.abs(values).max()
        else np.zeros(len(values))
    )


def _late(x: FloatArray) -> FloatArray:
    """(n, k): a signal and its low passes, each about its trend."""
    columns = [x]
    for lag in LAGS:
        keep = float(np.exp(-1.0 / lag))
        columns.append(lfilter([1.0 - keep], [1.0, -keep], x, zi=np.array([keep * x[0]]))[0])
    return np.column_stack([_detrended(c) for c in columns])


def _moved(columns: FloatArray, part: float) -> FloatArray:
    return np.roll(columns, int(part * len(columns)), axis=0)


def _autoregression(records: Sequence[FloatArray]) -> FloatArray:
    """Coefficients of the best order, by least squares over all records."""
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
    """The F ratio of the regression of a white series on columns."""
    explained = _explained(white, columns)
    rest = max(float(white @ white) - explained, 1e-300)
    return float(explained / columns.shape[1] / (rest / freedom))


def _explained(y: FloatArray, columns: FloatArray) -> float:
    """Squares of y that the columns carry; those that depend on others count once."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > 1e-12 * max(values[-1], 1e-300)
    along = vectors[:, kept].T @ (columns.T @ y)
    return float(np.sum(along**2 / values[kept]))


def _share(residuals: Sequence[FloatArray], columns: Sequence[FloatArray]) -> float:
    """Of the variance of the residuals, as they are, that the columns carry."""
    y, x = np.concatenate(residuals), np.concatenate(columns)
    return min(_explained(y, x) / float(y @ y), 1.0)


def periodic_share(values: FloatArray, times: FloatArray, period: float) -> float:
    """Return the share of a signal's variance, about its trend, in a wave of one period."""
    phase = 2.0 * np.pi * times / period
    basis = np.column_stack([np.sin(phase), np.cos(phase)])
    columns = np.column_stack([_detrended(c) for c in basis.T])
    about = _detrended(values)
    square = float(about @ about)
    return min(_explained(about, columns) / square, 1.0) if square > 0.0 else 0.0
