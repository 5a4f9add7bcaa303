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
    small, large
        The size of the signal there.
    """

    p: float
    quiet: float
    loud: float
    small: float
    large: float

    @property
    def parts(self) -> tuple[float, float]:
        """The constant part a of the noise, and b of sqrt(a^2 + (b size)^2), through both thirds.

        Noise that is all in proportion to the signal still has a tenth of the quiet noise as a
        constant part: a sample of nearly 0 is not that exact.
        """
        slope = (self.loud**2 - self.quiet**2) / (self.large**2 - self.small**2)
        least = (0.1 * self.quiet) ** 2
        return float(np.sqrt(max(self.quiet**2 - slope * self.small**2, least))), slope**0.5


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
    nothing = NoiseGrowth(1.0, *[float("nan")] * 4)
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
    ends = order[:third], order[-third:]
    quiet, loud = (float(np.median(noise[rows])) / gain for rows in ends)
    small, large = (float(np.median(centre[rows])) for rows in ends)
    return NoiseGrowth(float(found.pvalue), quiet, loud, small, large)
