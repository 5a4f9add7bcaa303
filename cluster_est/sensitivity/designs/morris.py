"""Elementary effects (Morris), which find the influential unknowns with few simulations."""

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

STEP_ON_GRID = 2.0 / 3.0
"""Step on a grid of four levels; with this step, all levels are used equally often."""
LOWER_ENDS_OF_STEPS = (0.0, 1.0 - STEP_ON_GRID)
"""Possible lower ends of steps."""


@final
@dataclass(frozen=True)
class MorrisDesign(SensitivityDesign):
    """Mean absolute elementary effects, and their standard deviation.

    Along each trajectory, one unknown after the other changes by one step. An elementary effect is
    the change of a quantity over the step, relative to the range of the bounds (M. D. Morris,
    Technometrics 33 (1991) 161-174, doi:10.1080/00401706.1991.10484804). The mean absolute value
    mu* ranks the unknowns (F. Campolongo, J. Cariboni, A. Saltelli, Environ. Model. Softw. 22
    (2007) 1509-1518, doi:10.1016/j.envsoft.2006.10.004). If the standard deviation is as large as
    mu*, the effect depends on the values of the other unknowns. Both have the unit of the quantity.
    """

    name: ClassVar[str] = "morris"
    measures: ClassVar[tuple[str, ...]] = ("mu*", "sigma")
    ranks: ClassVar[str] = "mu*"
    fewest: ClassVar[int] = 4
    usual: ClassVar[int] = 20

    def group(self, size: int) -> int:
        return size + 1

    def sample(self, size: int, groups: int, generator: np.random.Generator) -> FloatArray:
        (own,) = generator.spawn(1)  # other random numbers do not depend on the number of draws
        place = np.arange(size + 1)[:, None]
        found = []
        for _ in range(groups):
            turn = own.permutation(size)  # the position of each unknown's step
            upwards = own.choice([-1, 1], size) > 0
            base = own.choice(LOWER_ENDS_OF_STEPS, size)
            found.append(base + STEP_ON_GRID * ((place > turn) == upwards))
        return np.concatenate(found)

    def indices_of_moving(
        self, points: FloatArray, values: FloatArray, generator: np.random.Generator
    ) -> tuple[SensitivityIndex, ...]:
        size = points.shape[1]
        trajectories = points.reshape(-1, size + 1, size)
        steps = np.sign(np.diff(trajectories, axis=1))
        changes = np.diff(values.reshape(-1, size + 1), axis=1)
        effects = np.einsum("ts,tsu->tu", changes, steps) / STEP_ON_GRID
        half = half_widths(lambda t: np.abs(effects[t]).mean(axis=0), len(effects), generator)
        if len(np.unique(trajectories, axis=0)) < self.fewest:
            half = np.full(size, np.nan)  # a few repeated trajectories give no interval
        return (
            SensitivityIndex("mu*", np.abs(effects).mean(axis=0), half),
            SensitivityIndex("sigma", effects.std(axis=0, ddof=1), np.full(size, np.nan)),
        )
