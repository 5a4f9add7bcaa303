"""The settings of a closed loop: what a user chooses, and the thresholds of every step."""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.closed_loop.thresholds import LoopThresholds
from cluster_est.errors import ProblemError
from cluster_est.problem.options import check_options
from workers.messages.checks import as_tuple, check_kind


@dataclass(frozen=True)
class LoopSettings:
    """The size of the search, and the level of evidence that it asks for.

    Attributes
    ----------
    significance
        Largest family-wise p-value at which something counts as missing.
    max_effects
        Largest number of effects that are added.
    forms
        Names of the forms to try, like "coulomb"; empty for the whole library.
    sites
        Sites to try, like "der(v)"; empty for all that the FMU offers.
    draws
        Monte Carlo draws of each null distribution.
    trials
        Candidates that are tried by one real simulation of a joint step.
    refits
        Of those, how many get a short refit of all parameters; a third of them a full one.
    starts
        Starts of the declared fit, if it does not reach the noise from its own.
    least_gain
        Share of the gap between error and noise that an effect must close.
    near_noise
        Times the noise that the error may reach at most, on training and on held-out data, for
        the verdict "found".
    beam
        Structures that each round grows, where more than noise is left. Above 1 a structure is also
        refitted from other starts, and two of its effects may be replaced by one.
    pairs
        Try two effects at once where no single one explains the residual.
    thresholds
        Of every step; no key of a config.

    Raises
    ------
    ProblemError
        If one is of the wrong kind or out of its range.
    """

    significance: float = field(default=0.01, metadata={"least": 0.0})
    max_effects: int = field(default=3, metadata={"least": 1})
    forms: tuple[str, ...] = ()
    sites: tuple[str, ...] = ()
    draws: int = field(default=2000, metadata={"least": 100})
    trials: int = field(default=30, metadata={"least": 1})
    refits: int = field(default=12, metadata={"least": 1})
    starts: int = field(default=8, metadata={"least": 1})
    least_gain: float = field(default=0.2, metadata={"least": 0.0})
    near_noise: float = field(default=1.5, metadata={"least": 1.0})
    beam: int = field(default=4, metadata={"least": 1})
    pairs: bool = True
    thresholds: LoopThresholds = field(default_factory=LoopThresholds, repr=False)

    def __post_init__(self) -> None:
        check_options(self, "closed_loop", ProblemError)
        for key in ("forms", "sites"):
            named = as_tuple(getattr(self, key), str, f"closed_loop.{key}", ProblemError)
            object.__setattr__(self, key, named)
        check_kind(self.thresholds, LoopThresholds, "closed_loop.thresholds", ProblemError)
        if not 0.0 < self.significance < 1.0:
            raise ProblemError(
                f"closed_loop.significance: must lie between 0 and 1 but is {self.significance:g}"
            )
