"""Settings of a sensitivity analysis."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from cluster_est.sensitivity.designs import DESIGNS
from cluster_est.settings import Count, Finite, Settings, one_of, sentence
from workers.fmu.description import nearest


class SensitivitySettings(Settings):
    """Settings of the design and the indices of a sensitivity analysis."""

    section: ClassVar[str] = "sensitivity"

    method: str = Field(
        "morris",
        description=f"{one_of(DESIGNS)}; morris ranks many unknowns with few simulations; sobol "
        "gives the share of each unknown in the variance",
    )
    groups: Count = Field(
        0,
        description=(
            "number of trajectories (morris) or base samples (sobol); with n unknowns, a "
            "trajectory has n + 1 points and a base sample has n + 2; 0: 20 trajectories or 512 "
            "base samples"
        ),
    )
    times: Count = Field(
        20,
        description="number of times at which indices of each output in each experiment are "
        "computed; 0: only indices of the cost",
    )
    collinearity: Finite = Field(
        15.0,
        ge=1.0,
        description="collinearity index above which unknowns cannot be estimated together",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method not in DESIGNS:
            raise sentence(
                "sensitivity.method: there is no method "
                f"{self.method!r}{nearest(self.method, DESIGNS)}"
            )
        fewest = DESIGNS[self.method].fewest
        if 0 < self.groups < fewest:
            raise sentence(
                f"sensitivity.groups: must be 0 or at least {fewest} for {self.method!r}, but is "
                f"{self.groups}"
            )
        return self
