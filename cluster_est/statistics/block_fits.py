"""Reduces long records to fewer values: a parabola in each block, and its values at three nodes.

The nodes are the zeros of the third orthogonal polynomial on the samples of the block, as in Gauss
quadrature (G. H. Golub, J. H. Welsch, Math. Comp. 23 (1969) 221-230,
doi:10.1090/S0025-5718-69-99647-1). White noise stays white in these values. Each value counts as
many samples as its weight. Parabolas are preserved, and the values of cubics at the nodes are also
exact, so errors come from the fourth derivative. A large coefficient of fourth degree therefore
shows that a block is too long.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.ndimage import median_filter
from scipy.optimize import brentq
from scipy.sparse import coo_array, csr_array

from workers.messages import FloatArray, IntArray

DEGREE = 4
"""Degree of the polynomial that is fitted to each block."""

NODES = 3
"""Number of values per block: the number of coefficients of a parabola."""

SHORTEST_BLOCK = 8
"""Least number of samples in a block; shorter ranges are not reduced."""

MANY_SAMPLES = 200_000
"""Number of samples in blocks that are fitted at once; they need 40 MB."""

MEDIAN_OF_SQUARE = 0.4549
"""Median of x^2 for a normal x with variance 1."""

PREDICTING, MOST_PREDICTED = 8, 5000
"""Number of samples that predict the next one, and largest number of samples for the fit."""

UNLIKELY = 25.0
"""Sum of two squares of normal numbers of variance 1 above which it is not noise: p = 4e-6."""

NEIGHBOURS = 15
"""Number of neighbouring blocks whose median variance is the noise around a block."""

MOST_CORRELATED = 0.9999
"""Largest correlation of successive samples that can be determined within blocks."""

SPREAD = 6.0
"""Number of standard errors by which the variance in a block may exceed that of the noise."""


@dataclass(frozen=True)
class BlockFits:
    """Polynomials in blocks of a record.

    Attributes
    ----------
    bounds : (b, 2)
        The first sample of each block, and the one after its last.
    third, fourth : (b,)
        Coefficients of polynomials that are orthonormal on the samples. For a parabola in white
        noise, their standard deviation is that of the noise.
    variances : (b,)
        Variance of the residuals in each block.
    """

    bounds: IntArray
    third: FloatArray = field(repr=False)
    fourth: FloatArray = field(repr=False)
    variances: FloatArray = field(repr=False)

    @classmethod
    def of(cls, bounds: IntArray, times: FloatArray, values: FloatArray) -> Self:
        """Fit all blocks; each has at least `SHORTEST_BLOCK` samples."""
        third, fourth, variances = np.empty((3, len(bounds)))
        for own, at, q, _ in _polynomials(bounds, times):
            y = values[at]
            found = np.matmul(q, y[:, :, None])[:, :, 0]
            left = y - np.matmul(found[:, None, :], q)[:, 0]
            third[own], fourth[own] = found[:, 3], found[:, 4]
            variances[own] = (left**2).sum(axis=1) / (at.shape[1] - DEGREE - 1)
        return cls(bounds, third, fourth, variances)

    @property
    def noise(self) -> float:
        """Robust variance of the noise within blocks; some blocks may contain more than noise."""
        return float(np.median(self.variances)) if len(self.variances) else 0.0

    @property
    def noise_memory(self) -> NoiseMemory:
        """The first-order autoregression with the same ratio of `bent` to `noise`."""
        length = int(np.median(np.diff(self.bounds))) if len(self.bounds) else SHORTEST_BLOCK
        return noise_memory(self.bent / self.noise if self.noise else 1.0, length)

    @property
    def bent(self) -> float:
        """Robust mean square of the fourth coefficient."""
        return float(np.median(self.fourth**2)) / MEDIAN_OF_SQUARE if len(self.fourth) else 0.0

    def poor(self, slow: float) -> npt.NDArray[np.bool_]:
        """Return a mask of the blocks that contain more than a parabola and noise.

        Parameters
        ----------
        slow
            Variance of the noise in a coefficient; `noise` for white noise.
        """
        around = median_filter(self.variances, NEIGHBOURS, mode="nearest")
        variances = np.maximum(around, self.noise)
        degrees = np.diff(self.bounds)[:, 0] - DEGREE - 1
        curved = self.third**2 + self.fourth**2 > UNLIKELY * np.maximum(variances, slow)
        wide = self.variances > variances * (1.0 + SPREAD * np.sqrt(2.0 / degrees))
        return np.asarray(curved | wide)


@dataclass(frozen=True)
class NoiseMemory:
    """First-order autoregressive noise of variance 1, in blocks of one length.

    Attributes
    ----------
    correlation
        Correlation of successive samples.
    within
        Variance of the residuals of a polynomial within a block.
    middle
        Variance of the value of a parabola in the middle of a block.
    """

    correlation: float
    within: float
    middle: float


def noise_memory(bent: float, length: int) -> NoiseMemory:
    """Return the first-order autoregression with a given variance of the fourth coefficient.

    Parameters
    ----------
    bent
        This variance over that within blocks: 1 for white noise.
    length
        Number of samples in a block, which are evenly spaced.
    """
    q = _orthonormal(np.linspace(-1.0, 1.0, length)[None])[0]
    apart = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    at_middle = q[:NODES, length // 2] @ q[:NODES]

    def variances(correlation: float) -> tuple[float, float, float]:
        r = correlation**apart
        parts = np.einsum("ji,ik,jk->j", q, r, q, optimize=True)
        within = float((length - parts.sum()) / (length - DEGREE - 1))
        return float(parts[DEGREE]), within, float(at_middle @ r @ at_middle)

    def excess(correlation: float) -> float:
        fourth, within, _ = variances(correlation)
        return fourth - bent * within

    found = 0.0
    if excess(0.0) < 0.0:
        found = MOST_CORRELATED
        if excess(found) > 0.0:
            found = float(brentq(excess, 0.0, found, xtol=1e-5))
    return NoiseMemory(found, *variances(found)[1:])


def block_values(
    bounds: IntArray, times: FloatArray, *, at_samples: bool = False
) -> tuple[FloatArray, csr_array]:
    """Return the nodes of each block, and the weights that compute the parabola's values there.

    With q_j the orthonormal polynomials on a block's samples, the nodes are the eigenvalues of the
    matrix of sum_i t_i q_j(t_i) q_k(t_i), and weights are sum_j q_j(node) q_j(t_i), for j, k < 3.

    Parameters
    ----------
    bounds : (b, 2)
        Bounds of blocks with at least `SHORTEST_BLOCK` samples.
    at_samples
        Whether to replace each node by the nearest sample.

    Returns
    -------
    times : (3 b,)
    weights : (3 b, n)
    """
    nodes = np.zeros((len(bounds), NODES))
    rows, columns, entries = [np.zeros(0, int)], [np.zeros(0, int)], [np.zeros(0)]
    for own, at, full, scaled in _polynomials(bounds, times):
        q, t = full[:, :NODES], times[at]
        found, u = np.linalg.eigh(np.matmul(q * scaled[:, None, :], np.swapaxes(q, 1, 2)))
        shown = np.swapaxes(u / (u[:, :1] / q[:, :1, :1]), 1, 2)  # q_j at each node
        centre, half = t.mean(axis=1)[:, None], 0.5 * (t[:, -1:] - t[:, :1])
        nodes[own] = centre + half * found
        if at_samples:
            nearest = np.abs(scaled[:, None, :] - found[:, :, None]).argmin(axis=2)
            shown = np.swapaxes(np.take_along_axis(q, nearest[:, None, :], axis=2), 1, 2)
            nodes[own] = np.take_along_axis(t, nearest, axis=1)
        weights = np.matmul(shown, q)
        rows.append(np.repeat(NODES * own[:, None] + np.arange(NODES), at.shape[1]))
        columns.append(np.repeat(at[:, None, :], NODES, axis=1).ravel())
        entries.append(weights.ravel())
    places = (np.concatenate(rows), np.concatenate(columns))
    made = coo_array((np.concatenate(entries), places), (NODES * len(bounds), len(times)))
    return nodes.ravel(), csr_array(made.tocsr())


def _polynomials(
    bounds: IntArray, times: FloatArray
) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
    """Yield blocks of one length: indices, samples, polynomials, and times scaled to -1 to 1.

    Polynomials have the shape (b, 5, k) for k samples.
    """
    counts = np.diff(bounds)[:, 0]
    for count in np.unique(counts).tolist():
        same = np.flatnonzero(counts == count)
        for own in np.array_split(same, 1 + len(same) * count // MANY_SAMPLES):
            at = bounds[own, :1] + np.arange(count)
            t = times[at]
            scaled = (t - t.mean(axis=1)[:, None]) / (0.5 * (t[:, -1:] - t[:, :1]))
            yield own, at, _orthonormal(scaled), scaled


def _orthonormal(at: FloatArray) -> FloatArray:
    """Return polynomials that are orthonormal on the samples (b, k) of each block.

    q_{p+1} is t q_p minus its projections on q_p and q_{p-1}, over its norm. This is the Lanczos
    iteration, which is stable for a few degrees (W. Gautschi, SIAM J. Sci. Stat. Comput. 3 (1982)
    289-317, doi:10.1137/0903018).
    """
    q = np.empty((len(at), DEGREE + 1, at.shape[1]))
    q[:, 0] = at.shape[1] ** -0.5
    for p in range(DEGREE):
        new = at * q[:, p]
        for known in (q[:, p], q[:, p - 1])[: p + 1]:
            new -= np.einsum("bk,bk->b", new, known)[:, None] * known
        q[:, p + 1] = new / np.sqrt(np.einsum("bk,bk->b", new, new))[:, None]
    return q


def unpredicted(values: FloatArray) -> float:
    """Return the variance of the errors of a linear prediction from earlier samples: the noise."""
    some = values[:MOST_PREDICTED]
    windows = np.lib.stride_tricks.sliding_window_view(some, PREDICTING + 1)
    before = np.column_stack([windows[:, :-1], np.ones(len(windows))])
    found = np.linalg.lstsq(before, windows[:, -1], rcond=None)[0]
    return float(np.median((windows[:, -1] - before @ found) ** 2)) / MEDIAN_OF_SQUARE


def even_blocks(stretches: IntArray, length: int) -> IntArray:
    """Divide ranges of samples into blocks of about the same length: (b, 2).

    Parameters
    ----------
    stretches : (s, 2)
        The first sample of each range, and the one after its last. A range that is shorter than
        `length` becomes one block.
    """
    found = [np.zeros((0, 2), int)]
    for first, last in stretches.tolist():
        count = max(round((last - first) / length), 1)
        edges = first + np.round(np.linspace(0.0, last - first, count + 1)).astype(int)
        found.append(np.column_stack([edges[:-1], edges[1:]]))
    return np.concatenate(found)
