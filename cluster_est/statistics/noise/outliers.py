"""Isolated outliers of a record: single samples that do not fit the samples around them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from cluster_est.statistics.noise.estimate import MEDIAN_OF_NORMAL
from workers.messages import FloatArray

PREDICTING_NEIGHBOURS = 5
"""Number of samples on each side that predict a sample."""

AROUND = 25
"""Number of samples on each side from which the local noise of a sample is estimated."""

FIRST_OUTLIER_DISTANCE = 4.5
"""Least distance of the first outliers of a record, in standard deviations of a prediction. All
three predictions must be that far away on the same side. In white noise, this happens for 3 of 100
million samples."""

FAR_AGAIN = 3.5
"""Least distance of further outliers in a record that already has `PROVEN` outliers. Outliers are
then common, so less evidence is required. The two lines need not agree, because another outlier may
have changed them."""

PROVEN = 2
"""Number of outliers beyond `FIRST_OUTLIER_DISTANCE` that proves that a record has outliers."""

AGREE = 1.0 / 3.0
"""Largest difference of the predictions from before and after an outlier, over its distance. After
a physical event, in contrast, the signal continues at another value."""

PASSES = 20
"""Largest number of passes; each may find outliers that a larger outlier has hidden."""


@dataclass(frozen=True)
class IsolatedOutliers:
    """The outliers of a record.

    Attributes
    ----------
    mask : (n,)
        True for outliers.
    largest
        Largest distance of an outlier, over the noise; 0 without outliers.
    """

    mask: npt.NDArray[np.bool_] = field(repr=False)
    largest: float


def isolated_outliers(
    signal: FloatArray,
    noise: float,
    *,
    proven: bool = False,
    excepted: npt.NDArray[np.bool_] | None = None,
) -> IsolatedOutliers:
    """Find single samples that are far from predictions by their neighbours.

    Each sample is predicted by a line through five samples before it, by a line through five
    samples after it, and by a cubic through two samples on each side. An outlier is far from all
    three predictions, on the same side, and the two lines agree. So these are not outliers: the
    edge of a jump or a kink (on a line), a curve (on the cubic), a peak that decays (the lines
    disagree), and two high samples in a row. An outlier is replaced by the cubic, and the search is
    repeated (H. Liu, S. Shah, W. Jiang, Comput. Chem. Eng. 28 (2004) 1635-1647,
    doi:10.1016/j.compchemeng.2004.01.009). Distances are relative to the median absolute deviation
    in a window, as in the Hampel identifier, or to the noise of the whole record if that is larger
    (R. K. Pearson, IEEE Trans. Control Syst. Technol. 10 (2002) 55-63, doi:10.1109/87.974338).

    Use the function for the evenly sampled residual of a fit. The first and the last two samples
    are never outliers, and neither are two neighbours on the same side.

    Parameters
    ----------
    signal : (n,)
        A record; with fewer than 11 samples, it has no outliers.
    noise
        Standard deviation of the noise; if it is 0 or unknown, there are no outliers.
    proven
        Whether other records of the same sensor have outliers, as if this one had `PROVEN`.
    excepted : (n,)
        Samples that are never outliers, because an event is known there.
    """
    cleaned = np.array(signal, np.float64)
    mask = np.zeros(len(cleaned), bool)
    largest = 0.0
    if len(cleaned) <= 2 * PREDICTING_NEIGHBOURS or not noise > 0.0:
        return IsolatedOutliers(mask, largest)
    far = FIRST_OUTLIER_DISTANCE
    for _ in range(PASSES):
        score, cubic, away = _scores(signal, cleaned, noise, agreeing=far == FIRST_OUTLIER_DISTANCE)
        score[mask if excepted is None else mask | excepted] = 0.0
        chosen = _peaks(score, away, far)
        if not len(chosen):
            if far == FAR_AGAIN or not (proven or int(mask.sum()) >= PROVEN):
                break
            far = FAR_AGAIN
            continue
        largest = max(largest, float(away[chosen].max()))
        mask[chosen] = True
        cleaned[chosen] = cubic[chosen]
    return IsolatedOutliers(mask, largest)


def _peaks(score: FloatArray, away: FloatArray, far: float) -> npt.NDArray[np.intp]:
    """Return the samples above the threshold that are farther from their cubic than neighbours."""
    near = np.lib.stride_tricks.sliding_window_view(np.pad(away, 2), 5).max(axis=1)
    return np.flatnonzero((score > far) & (away >= near))


def _scores(
    signal: FloatArray, cleaned: FloatArray, noise: float, *, agreeing: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances from the nearest prediction, the cubic, and the distances from the cubic.

    The first distances are over the standard deviation of the prediction's error, the last ones
    over the noise. The first are 0 if there is no prediction, if predictions lie on both sides, or,
    with `agreeing`, if the two lines disagree.
    """
    before, width = _line_before(cleaned)
    after, width_after = (part[::-1] for part in _line_before(cleaned[::-1]))
    cubic = cleaned.copy()
    cubic[2:-2] = (4.0 * (cleaned[1:-3] + cleaned[3:-1]) - cleaned[:-4] - cleaned[4:]) / 6.0
    gain = np.sqrt(70.0) / 6.0  # the distance from the cubic is a sixth of a fourth difference
    scale = _scale(np.abs(cleaned - cubic)[2:-2] / gain, noise)
    off = np.array([signal - before, signal - after, signal - cubic])
    widths = scale * np.array([width, width_after, np.full(len(signal), gain)])
    distance = np.abs(off / widths).min(axis=0)
    one_side = np.all(off > 0.0, axis=0) | np.all(off < 0.0, axis=0)
    chance = 3.0 * scale * np.sqrt(width**2 + width_after**2 - 2.0)
    gap = np.abs(before - after)
    agree = gap <= np.maximum(AGREE * np.abs(off[:2]).min(axis=0), chance)
    agree |= not agreeing
    inside = np.zeros(len(signal), bool)
    inside[2:-2] = True
    away = np.where(inside, np.abs(off[2]) / scale, 0.0)
    return np.where(one_side & agree & inside, distance, 0.0), cubic, away


def _scale(deviations: FloatArray, noise: float) -> FloatArray:
    """Return the noise around each sample, which is at least that of the whole record."""
    padded = np.pad(deviations, 2 + AROUND, mode="symmetric" if len(deviations) else "constant")
    local = median_filter(padded, 2 * AROUND + 1)[AROUND:-AROUND] / MEDIAN_OF_NORMAL
    return np.asarray(np.maximum(noise, local))


def _line_before(signal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Predict each sample by a line through up to five samples before it.

    Also return the standard deviation of the prediction's error, over the noise. The first two
    samples have no prediction; their own values are returned.
    """
    predicted, width = signal.copy(), np.ones(len(signal))
    for count in range(2, PREDICTING_NEIGHBOURS + 1):
        steps = np.arange(count) - 0.5 * (count - 1)
        weights = 1.0 / count + steps * (0.5 * (count + 1)) / np.add.reduce(steps**2)
        stop = len(signal) if count == PREDICTING_NEIGHBOURS else count + 1
        windows = np.lib.stride_tricks.sliding_window_view(signal[: stop - 1], count)
        predicted[count:stop] = np.add.reduce(windows[: stop - count] * weights, axis=1)
        width[count:stop] = np.sqrt(1.0 + np.add.reduce(weights**2))
    return predicted, width
