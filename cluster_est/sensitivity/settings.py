"""Settings of a sensitivity analysis."""

from __future__ import annotations

from typing import ClassVar, Self

from pydantic import Field, model_validator

from cluster_est.sensitivity.designs import DESIGNS
from cluster_est.settings import Count, Finite, Settings, one_of, sentence
from workers.fmu.description import nearest


class SensitivitySettings(Settings):
    """The design of a sensitivity analysis, and what is computed from it."""

    section: ClassVar[str] = "sensitivity"

    method: str = Field(
        "morris",
        description=f"{one_of(DESIGNS)}; morris: which of many unknowns matter, for few "
        "simulations; sobol: the shares of the variance that each makes",
    )
    groups: Count = Field(
        0,
        description="trajectories of morris, each of one point more than there are unknowns, or "
        "base samples of sobol, each of two more; 0: 20 or 512",
    )
    times: Count = Field(
        20,
        description="of each output in each experiment that indices are computed at; 0: only of "
        "the cost",
    )
    collinearity: Finite = Field(
        15.0, ge=1.0, description="index above which unknowns cannot be estimated together"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.method not in DESIGNS:
            raise sentence(
                f"sensitivity.method: there is no {self.method!r}{nearest(self.method, DESIGNS)}"
            )
        fewest = DESIGNS[self.method].fewest
        if 0 < self.groups < fewest:
            raise sentence(
                f"sensitivity.groups: must be 0 or at least {fewest} for {self.method!r} but is "
                f"{self.groups}"
            )
        return self
