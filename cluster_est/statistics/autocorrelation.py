"""The autocorrelation of residuals, pooled over records, and what it does to standard errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from cluster_est.statistics.records import OutputRecord
from workers.messages import FloatArray

WINDOW = 5.0
"""Lags that are summed, over the correlation time of their sum: beyond that there is only noise."""


@dataclass(frozen=True)
class Autocorrelation:
    """How much samples say of each other.

    Attributes
    ----------
    lag1
        Correlation of neighbours; 0 where there are none.
    widening
        Square root of 1 + 2 (rho_1 + rho_2 + ...), at least 1: by about so much are standard
        errors too small that take the residuals for white, where the sensitivities vary more slowly
        than the noise.
    squares
        1 + 2 (rho_1^2 + rho_2^2 + ...): by so much fewer samples a mean square has.
    """

    lag1: float
    widening: float
    squares: float


def autocorrelation(residuals: FloatArray, records: Sequence[OutputRecord]) -> Autocorrelation:
    """Autocorrelation rho_k = sum r_t r_{t+k} / sum r_t^2 of the residuals in some records.

    No product spans two records. The sums over lags end at the first lag that is 5 times the
    correlation time up to it: A. Sokal in Functional Integration (1997) 131-192,
    doi:10.1007/978-1-4899-0319-8_6, section 3. The effective number of samples of a mean and of a
    mean square: G. V. Bayley, J. M. Hammersley, Suppl. J. R. Stat. Soc. 8 (1946) 184-197,
    doi:10.2307/2983560.

    Parameters
    ----------
    residuals : (n,)
        Stacked; their scale is irrelevant.
    records
        Those that are pooled.
    """
    covariances = np.zeros(max((len(record.times) for record in records), default=0))
    for record in records:
        count = len(record.times)
        if count:
            padded = next_fast_len(2 * count, real=True)
            spectrum = rfft(residuals[record.rows], padded)
            power = spectrum.real**2 + spectrum.imag**2
            covariances[:count] += irfft(power, padded)[:count]
    if len(covariances) < 2 or covariances[0] <= 0.0:
        return Autocorrelation(0.0, 1.0, 1.0)
    rho = covariances[1:] / covariances[0]
    times = 0.5 + np.cumsum(rho)
    enough = np.flatnonzero(np.arange(1, len(rho) + 1) >= WINDOW * times)
    end = int(enough[0]) + 1 if len(enough) else len(rho)
    widening = float(np.sqrt(max(1.0, 2.0 * times[end - 1])))
    return Autocorrelation(
        float(rho[0]), widening, 1.0 + 2.0 * float(np.add.reduce(rho[:end] ** 2))
    )
