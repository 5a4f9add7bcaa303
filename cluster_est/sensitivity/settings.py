"""Settings of a sensitivity analysis."""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.errors import ProblemError
from cluster_est.problem.options import check_options
from cluster_est.sensitivity.designs import DESIGNS


@dataclass(frozen=True)
class SensitivitySettings:
    """The design of a sensitivity analysis, and what is computed from it.

    Attributes
    ----------
    method
        "morris" for elementary effects, which tell what matters at all among many unknowns, or
        "sobol" for shares of the variance.
    groups
        Trajectories of "morris", each of one point more than there are unknowns; base samples of
        "sobol", each of two more. 0 for 20 or 512.
    times
        Of each output in each experiment at which indices are computed; 0 for those of the cost
        alone.
    collinearity
        Index above which unknowns cannot be estimated together.

    Raises
    ------
    ProblemError
        If one is of the wrong kind or out of its range.
    """

    method: str = "morris"
    groups: int = field(default=0, metadata={"least": 0})
    times: int = field(default=20, metadata={"least": 0})
    collinearity: float = field(default=15.0, metadata={"least": 1.0})

    def __post_init__(self) -> None:
        check_options(self, "sensitivity", ProblemError)
        if self.method not in DESIGNS:
            known = ", ".join(repr(name) for name in DESIGNS)
            raise ProblemError(f"sensitivity.method: must be one of {known} but is {self.method!r}")
        fewest = DESIGNS[self.method].fewest
        if 0 < self.groups < fewest:
            raise ProblemError(
                f"sensitivity.groups: must be 0 or at least {fewest} for {self.method!r} but is "
                f"{self.groups}"
            )
