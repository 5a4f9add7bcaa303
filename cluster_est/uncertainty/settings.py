"""Settings of the uncertainty of a fit."""

from __future__ import annotations

from dataclasses import dataclass, field

from cluster_est.errors import ProblemError
from cluster_est.problem.options import check_options
from workers.messages.checks import as_tuple


@dataclass(frozen=True)
class UncertaintySettings:
    """The intervals to compute besides those from derivatives, which cost nothing.

    Attributes
    ----------
    profiles
        Labels of unknowns ("k", "x0[exp5]"), or names of parameters for all their unknowns, or
        "shared" for all that several experiments determine, or "all". A profile costs some ten
        fits of the other unknowns, which begin close to their minimum.
    bootstrap
        Number of draws of experiments, each fitted again; 0 for not at all. Take at least 200, and
        1000 where there are fewer than 10 experiments: the ends of the intervals are then rare
        draws.
    posterior
        Steps of each walker that draws from the posterior; 0 for not at all. Some thousands: the
        chains must be 50 times as long as their draws stay alike, or no interval is given.
    walkers
        Their number; 0 for four times that of the unknowns, and 16 at least.
    confidence
        Of profiles, bootstrap and posterior.
    steps
        Refits, at least, from the optimum to the end of an interval on one side of a profile. More
        draw a smoother curve; the end itself is found to a thousandth in any case.
    max_steps
        Refits on one side after which a profile that does not rise is called flat.
    rise
        By how much the cost must rise at the end of a profile's interval; 0 to derive it from the
        scatter of the residuals. To be given for costs that have no weights, such as "sae".
    at_once
        Refits under way at the same time. Never the number of workers: a result must not depend
        on it.

    Raises
    ------
    ProblemError
        If one is of the wrong kind or out of its range.
    """

    profiles: tuple[str, ...] = ()
    bootstrap: int = field(default=0, metadata={"least": 0})
    posterior: int = field(default=0, metadata={"least": 0})
    walkers: int = field(default=0, metadata={"least": 0})
    confidence: float = field(default=0.95, metadata={"least": 0.5})
    steps: int = field(default=4, metadata={"least": 1})
    max_steps: int = field(default=20, metadata={"least": 2})
    rise: float = field(default=0.0, metadata={"least": 0.0})
    at_once: int = field(default=16, metadata={"least": 1})

    @property
    def asked(self) -> tuple[str, ...]:
        """Which of them are asked for, by their keys."""
        every = {
            "profiles": bool(self.profiles),
            "bootstrap": self.bootstrap > 0,
            "posterior": self.posterior > 0,
        }
        return tuple(f"uncertainty.{key}" for key, wanted in every.items() if wanted)

    def __post_init__(self) -> None:
        check_options(self, "uncertainty", ProblemError)
        named = as_tuple(self.profiles, str, "uncertainty.profiles", ProblemError)
        object.__setattr__(self, "profiles", named)
        if not self.confidence < 1.0:
            raise ProblemError(
                "uncertainty.confidence: must be at least 0.5 and below 1 but is "
                f"{self.confidence:g}; 0.95 is usual"
            )
