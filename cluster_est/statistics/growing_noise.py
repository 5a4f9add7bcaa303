"""A test whether the noise of a signal grows with its size."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from cluster_est.statistics.noise import MEDIAN_OF_NORMAL
from workers.messages import FloatArray

ORDER = 6
"""Of the differences, from which the misfit of a wrong model has all but gone."""


@dataclass(frozen=True)
class NoiseGrowth:
    """The dependence of noise on the size of the signal.

    Attributes
    ----------
    p
        Of a rank correlation of at least this size where the noise is the same everywhere.
    quiet, loud
        Noise of the third of the samples with the smallest signal, and with the largest.
    """

    p: float
    quiet: float
    loud: float


def noise_growth(residuals: FloatArray, size: FloatArray) -> NoiseGrowth:
    """Test whether the size of the noise follows that of the signal.

    The noise at a sample is taken from the sixth difference about it, because the residual of a
    wrong model is large where the signal is, too. Differences that share samples are not
    independent, so every seventh is compared with the size of the signal there, by ranks (C.
    Spearman, Am. J. Psychol. 15 (1904) 72-101, doi:10.2307/1412159).

    Parameters
    ----------
    residuals, size : (n,)
        Of a record in the order of time, or several behind each other; the second is the size of
        what was simulated.

    Returns
    -------
    NoiseGrowth
        With p = 1 and NaN where fewer than nine differences are left, or nothing varies.
    """
    nothing = NoiseGrowth(1.0, float("nan"), float("nan"))
    if len(residuals) <= ORDER:
        return nothing
    noise = np.abs(np.diff(residuals, ORDER))[:: ORDER + 1]
    centre = size[ORDER // 2 : len(size) - ORDER // 2][:: ORDER + 1]
    if len(noise) < 9 or not np.ptp(noise) > 0.0 or not np.ptp(centre) > 0.0:
        return nothing
    from scipy.stats import spearmanr  # slow to import, and no plain fit asks for it

    found = spearmanr(noise, centre, alternative="greater")
    order = np.argsort(centre, kind="stable")
    third = len(order) // 3
    gain = MEDIAN_OF_NORMAL * np.sqrt(comb(2 * ORDER, ORDER))
    quiet, loud = (float(np.median(noise[rows])) / gain for rows in (order[:third], order[-third:]))
    return NoiseGrowth(float(found.pvalue), quiet, loud)
