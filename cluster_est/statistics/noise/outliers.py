"""Isolated outliers of a record: single samples that nothing before or after them explains."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter

from cluster_est.statistics.noise.estimate import MEDIAN_OF_NORMAL
from workers.messages import FloatArray

PREDICTING_NEIGHBOURS = 5
"""Samples on each side that predict one."""

AROUND = 25
"""Samples on each side that its noise is estimated from, besides that of the whole record."""

FIRST_OUTLIER_DISTANCE = 4.5
"""Distance, in standard deviations of a prediction, of the first outliers of a record. All three
predictions must miss as far on the same side: white noise does that 3 times in 100 million."""

FAR_AGAIN = 3.5
"""Distance, in standard deviations of a prediction, of further outliers in a record that has
`PROVEN` already: what is common there needs less evidence, nor need the lines agree, which another
outlier may have bent."""

PROVEN = 2
"""Outliers beyond `FIRST_OUTLIER_DISTANCE` that say that a record has some."""

AGREE = 1.0 / 3.0
"""Share of its distance by which what is before an outlier and what is after may disagree: after
the event of a mechanism a signal goes on from somewhere else."""

PASSES = 20
"""Rounds at most; each may uncover what a larger outlier has hidden."""


@dataclass(frozen=True)
class IsolatedOutliers:
    """The outliers of a record.

    Attributes
    ----------
    mask : (n,)
        True where a sample is one.
    largest
        Distance of the farthest, over the noise; 0 without any.
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
    """Find single samples far from what their neighbours say, whatever the smooth course is.

    Three predictions of each sample are made: from a line through five samples before it, a line
    through five after it, and a cubic through two on each side. An outlier is far from all three,
    on the same side, and the two lines agree. So none of these is one: the edge of a jump and a
    kink (on a line), a curve (on the cubic), a peak that decays (the lines disagree), two high
    samples in a row. An outlier is replaced by the cubic, and what is left is looked at again.
    Far is measured as the Hampel identifier does, by a median of absolute deviations in a window,
    or by the noise of the whole record where that is larger (R. K. Pearson, IEEE Trans. Control
    Syst. Technol. 10 (2002) 55-63, doi:10.1109/87.974338); cleaning while searching follows H. Liu,
    S. Shah, W. Jiang, Comput. Chem. Eng. 28 (2004) 1635-1647,
    doi:10.1016/j.compchemeng.2004.01.009.

    Use it on the residual of a fit, evenly sampled. The first and the last two samples are never
    outliers, nor is one of a pair on the same side.

    Parameters
    ----------
    signal : (n,)
        A record; with fewer than 11 samples it has no outliers.
    noise
        Standard deviation of its noise; where it is 0 or unknown there are no outliers.
    proven
        Other records of the same sensor have outliers; `PROVEN` in this one say the same.
    excepted : (n,)
        Samples that are never outliers, because something is known to happen there.
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
    """Samples beyond the threshold from whose cubic no neighbour is farther away."""
    near = np.lib.stride_tricks.sliding_window_view(np.pad(away, 2), 5).max(axis=1)
    return np.flatnonzero((score > far) & (away >= near))


def _scores(
    signal: FloatArray, cleaned: FloatArray, noise: float, *, agreeing: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance of each sample from the nearest prediction, the cubic, and the distance from it.

    Distances are over the standard deviation of the prediction's error, the last one over the
    noise. They are 0 where there is no prediction, where predictions lie on both sides, or, if
    `agreeing`, where the two lines contradict each other.
    """
    before, width = _line_before(cleaned)
    after, width_after = (part[::-1] for part in _line_before(cleaned[::-1]))
    cubic = cleaned.copy()
    cubic[2:-2] = (4.0 * (cleaned[1:-3] + cleaned[3:-1]) - cleaned[:-4] - cleaned[4:]) / 6.0
    gain = np.sqrt(70.0) / 6.0  # of a fourth difference, which this is a sixth of
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
    """The noise around each sample, never less than that of the whole record."""
    padded = np.pad(deviations, 2 + AROUND, mode="symmetric" if len(deviations) else "constant")
    local = median_filter(padded, 2 * AROUND + 1)[AROUND:-AROUND] / MEDIAN_OF_NORMAL
    return np.asarray(np.maximum(noise, local))


def _line_before(signal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A prediction of each sample by a line through up to five before it, and its error's width.

    The width is over the noise. The first two samples, which have none, predict themselves.
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
