"""Sobol indices: the share of each unknown in the variance of a quantity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from cluster_est.sensitivity.designs.base import (
    SensitivityDesign,
    SensitivityIndex,
    half_widths,
)
from workers.messages import FloatArray


@final
@dataclass(frozen=True)
class SobolDesign(SensitivityDesign):
    """Variance-based indices: first-order and total indices.

    The first-order index is the share V[E[y | x_i]] / V[y] of an unknown alone. The total index is
    1 minus the share of all other unknowns together (I. M. Sobol, Math. Comput. Simul. 55 (2001)
    271-280, doi:10.1016/S0378-4754(00)00270-6). The estimators are those of A. Saltelli et al.,
    Comput. Phys. Commun. 181 (2010) 259-270, doi:10.1016/j.cpc.2009.09.018. An unknown with a total
    index near 0 may be fixed anywhere between its bounds. Intervals come from a bootstrap of the
    groups.

    `scipy.stats.sobol_indices` has the same estimators. It requires a power of two as the number of
    groups, which is not given after failed simulations, and has no generator for intervals.
    """

    name: ClassVar[str] = "sobol"
    measures: ClassVar[tuple[str, ...]] = ("first order", "total")
    ranks: ClassVar[str] = "total"
    fewest: ClassVar[int] = 32
    usual: ClassVar[int] = 512

    def group(self, size: int) -> int:
        return size + 2

    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        from scipy.stats.qmc import Sobol  # slow to import

        power = 1 << (groups - 1).bit_length()  # a Sobol sequence is balanced at powers of two
        a, b = np.hsplit(Sobol(2 * size, rng=generator).random(power), 2)
        found = np.repeat(a[:, None], size + 2, axis=1)
        unknown = np.arange(size)
        found[:, unknown + 1, unknown] = b  # one unknown after the other has its value from b
        found[:, -1] = b
        return found.reshape(-1, size)

    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        centred = (values - values.mean()) / values.std()
        table = centred.reshape(-1, points.shape[1] + 2)
        half = half_widths(lambda groups: _estimates(table[groups]), len(table), generator)
        both = zip(self.measures, _estimates(table), half, strict=True)
        return tuple(SensitivityIndex(*each) for each in both)


def _estimates(table: FloatArray) -> FloatArray:
    """Return first-order and total indices, (2, unknowns), from values at a, mixtures, and b."""
    a, changed, b = table[:, :1], table[:, 1:-1], table[:, -1:]
    parts = np.array([b * (changed - a), 0.5 * (a - changed) ** 2]).mean(axis=1)
    variance = table[:, [0, -1]].var()
    return parts / variance if variance > np.finfo(float).eps else np.zeros_like(parts)
