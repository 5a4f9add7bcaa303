"""Elementary effects: which of many unknowns matter at all, for few simulations."""

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

LEVELS = 4
"""Of the grid that trajectories run on."""


@final
@dataclass(frozen=True)
class MorrisDesign(SensitivityDesign):
    """Mean absolute elementary effects, and their standard deviation.

    Along each trajectory one unknown after another takes a step; what a quantity changes by, over
    the step in parts of the unknown's bounds, is an elementary effect: M. D. Morris, Technometrics
    33 (1991) 161-174, doi:10.1080/00401706.1991.10484804. Its mean absolute value mu* ranks the
    unknowns (F. Campolongo, J. Cariboni, A. Saltelli, Environ. Model. Softw. 22 (2007) 1509-1518,
    doi:10.1016/j.envsoft.2006.10.004); a standard deviation as large as it means that the effect
    depends on where the others are. Both have the unit of the quantity.
    """

    name: ClassVar[str] = "morris"
    measures: ClassVar[tuple[str, ...]] = ("mu*", "sigma")
    ranks: ClassVar[str] = "mu*"
    fewest: ClassVar[int] = 4
    usual: ClassVar[int] = 20

    def group(self, size: int) -> int:
        return size + 1

    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        from SALib.sample import morris  # slow to import

        found = morris.sample(box(size), groups, num_levels=LEVELS, seed=generator)
        return np.asarray(found, float)

    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        size = points.shape[1]
        from SALib.analyze import morris  # slow to import

        seed = seed_of(generator)
        found = morris.analyze(box(size), points, values, num_levels=LEVELS, seed=seed)
        half = np.array(found["mu_star_conf"])
        if len(np.unique(points.reshape(-1, points[: size + 1].size), axis=0)) < self.fewest:
            half = np.full(size, np.nan)  # the same few trajectories again and again tell nothing
        return (
            SensitivityIndex("mu*", np.array(found["mu_star"]), half),
            SensitivityIndex("sigma", np.array(found["sigma"]), np.full(size, np.nan)),
        )
