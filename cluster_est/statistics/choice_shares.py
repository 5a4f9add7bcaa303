"""How often each of several models is chosen where the data are resampled.

Whatever chose a model among many chose it by these data; others of the same kind might have led to
another. Pieces of the data are drawn with replacement (B. Efron, R. J. Tibshirani, An Introduction
to the Bootstrap (1993), doi:10.1201/9780429246593), and every model is refitted to each draw by its
own linear model, r + J d: that takes no simulation. The frequencies with which each is best are
those of W. Sauerbrei, M. Schumacher, Stat. Med. 11 (1992) 2093-2109, doi:10.1002/sim.4780111607.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray, IntArray

RANK = 1e-12
"""Part of the largest eigenvalue of a scaled normal matrix: what is smaller counts as 0."""


@dataclass(frozen=True)
class LinearFit:
    """A model at its fit.

    Attributes
    ----------
    residuals : (n,)
        At the fit.
    jacobian : (n, unknowns)
        Of the residuals.
    price
        What is added to its criterion, for what it was chosen among.
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

    The criterion is that of Schwarz with the variance of each output's noise estimated, as
    `FittedModel.criterion` has it.

    Parameters
    ----------
    fits
        The models; of those that are equal the first is chosen.
    pieces, outputs : (n,)
        For each residual the number of the piece that it is drawn with, and that of its output,
        each from 0.
    draws
        Their number.
    generator
        For the draws.
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
    """Squares and products of a model, summed over each piece and output."""

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
        """The criterion of the model refitted, with each piece so many times."""
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
