"""Computes how often each of several models is the best one for resampled data.

The choice of a model depends on the data; other data of the same kind might have led to another
choice. Pieces of the data are drawn with replacement (B. Efron, R. J. Tibshirani, An Introduction
to the Bootstrap (1993), doi:10.1201/9780429246593). Every model is refitted to each draw with its
linear model r + J d, which needs no simulation. For these frequencies, see W. Sauerbrei, M.
Schumacher, Stat. Med. 11 (1992) 2093-2109, doi:10.1002/sim.4780111607.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray, IntArray

RANK = 1e-12
"""Eigenvalue of a scaled normal matrix, over the largest one, below which it counts as 0."""


@dataclass(frozen=True)
class LinearFit:
    """The linear model of a fitted model.

    Attributes
    ----------
    residuals : (n,)
        Residuals of the fit.
    jacobian : (n, unknowns)
        Derivatives of the residuals.
    price
        Penalty that is added to the criterion, for the number of candidates.
    """

    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    price: float = 0.0


def choice_shares(
    fits: Sequence[LinearFit],
    pieces: IntArray,
    outputs: IntArray,
    draws: int,
    generator: np.random.Generator,
) -> FloatArray:
    """Return the share of the draws in which each model has the least criterion.

    The criterion is that of Schwarz with an estimated noise variance for each output, as in
    `FittedModel.criterion`.

    Parameters
    ----------
    fits
        The models; the first of equally good models is chosen.
    pieces, outputs : (n,)
        Numbers of the piece and of the output of each residual, counted from 0.
    draws
        Number of draws.
    generator
        Generates the draws.
    """
    count = int(pieces.max()) + 1
    sizes = np.zeros((count, int(outputs.max()) + 1))
    np.add.at(sizes, (pieces, outputs), 1.0)
    drawn = [
        np.bincount(generator.integers(count, size=count), minlength=count).astype(float)
        for _ in range(draws)
    ]
    criteria = np.empty((len(fits), draws))
    for row, fit in zip(criteria, fits, strict=True):  # one after the other: the sums are large
        sums = _PieceSums(fit, pieces, outputs)
        row[:] = [sums.criterion(times, times @ sizes) for times in drawn]
    return np.bincount(criteria.argmin(axis=0), minlength=len(fits)) / draws


class _PieceSums:
    """Squares and products of residuals and derivatives, summed over each piece and output."""

    def __init__(self, fit: LinearFit, pieces: IntArray, outputs: IntArray) -> None:
        count, kinds, size = int(pieces.max()) + 1, int(outputs.max()) + 1, fit.jacobian.shape[1]
        norms = np.linalg.norm(fit.jacobian, axis=0)
        scaled = fit.jacobian / np.where(norms > 0.0, norms, 1.0)
        self._price, self._size = fit.price, size
        self._squares = np.zeros((count, kinds))
        self._gradients = np.zeros((count, kinds, size))
        self._normal = np.zeros((count, kinds, size, size))
        for piece in range(count):
            for output in range(kinds):
                rows = np.flatnonzero((pieces == piece) & (outputs == output))
                own, part = scaled[rows], fit.residuals[rows]
                self._squares[piece, output] = part @ part
                self._gradients[piece, output] = own.T @ part
                self._normal[piece, output] = own.T @ own

    def criterion(self, times: FloatArray, samples: FloatArray) -> float:
        """Return the criterion of the refitted model, with each piece repeated `times` times."""
        squares = times @ self._squares
        gradients = np.tensordot(times, self._gradients, 1)
        normal = np.tensordot(times, self._normal, 1)
        step = -np.linalg.pinv(normal.sum(axis=0), RANK, hermitian=True) @ gradients.sum(axis=0)
        left = squares + 2.0 * gradients @ step + (normal @ step) @ step
        seen = samples > 0.0
        left = np.maximum(left[seen], 1e-12 * np.maximum(squares[seen], 1e-300))
        variances = left / samples[seen]
        deviance = np.add.reduce(samples[seen] * np.log(variances))
        return float(deviance + self._size * np.log(samples.sum()) + self._price)
