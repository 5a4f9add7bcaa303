"""Sobol indices: the shares of a quantity's variance that each unknown makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, final

import numpy as np

from cluster_est.sensitivity.designs.base import (
    SensitivityDesign,
    SensitivityIndex,
    box,
    seed_of,
)
from workers.messages import FloatArray


@final
@dataclass(frozen=True)
class SobolDesign(SensitivityDesign):
    """Variance-based indices of first order and total ones.

    First order is the share V[E[y | x_i]] / V[y] that an unknown makes by itself; total is 1 less
    the share that all others make together: I. M. Sobol, Math. Comput. Simul. 55 (2001) 271-280,
    doi:10.1016/S0378-4754(00)00270-6; estimators of A. Saltelli et al., Comput. Phys. Commun. 181
    (2010) 259-270, doi:10.1016/j.cpc.2009.09.018. A total index near 0 means that the unknown may
    be fixed anywhere in its bounds. Intervals are from a bootstrap of the groups.
    """

    name: ClassVar[str] = "sobol"
    measures: ClassVar[tuple[str, ...]] = ("first order", "total")
    ranks: ClassVar[str] = "total"
    fewest: ClassVar[int] = 32
    usual: ClassVar[int] = 512

    def group(self, size: int) -> int:
        return size + 2

    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        from SALib.sample import sobol  # slow to import

        power = 1 << (groups - 1).bit_length()  # a Sobol sequence is balanced at powers of two
        found = sobol.sample(box(size), power, calc_second_order=False, seed=generator)
        return np.asarray(found, float)

    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        size = points.shape[1]
        from SALib.analyze import sobol  # slow to import

        seed = seed_of(generator)
        found = sobol.analyze(box(size), values, calc_second_order=False, seed=seed)
        return (
            SensitivityIndex("first order", np.array(found["S1"]), np.array(found["S1_conf"])),
            SensitivityIndex("total", np.array(found["ST"]), np.array(found["ST_conf"])),
        )
