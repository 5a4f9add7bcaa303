"""Settings of the uncertainty of a fit."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field

from cluster_est.settings import LARGEST_INTEGER, Count, Finite, Names, Positive, Settings


def _named(given: Any) -> Any:
    """Return all names for true, none for false, and a list for a single name."""
    if isinstance(given, bool):
        return ("all",) if given else ()
    return (given,) if isinstance(given, str) else given


ProfiledNames = Annotated[Names, BeforeValidator(_named)]


class UncertaintySettings(Settings):
    """The intervals to compute by refits, in addition to those from derivatives."""

    section: ClassVar[str] = "uncertainty"

    profiles: ProfiledNames = Field(
        (),
        description=(
            'labels ("k", "x0[exp5]") or parameters to compute likelihood profiles for; "shared": '
            'all that several experiments determine; "all" or true: all; a profile takes about '
            "ten fits, each from a start close to its minimum"
        ),
    )
    bootstrap: Count = Field(
        0,
        description=(
            "number of draws of the experiments, each with a refit: at least 200, or 1000 with "
            "fewer than 10 experiments; 0: none"
        ),
    )
    posterior: Count = Field(
        0,
        description=(
            "number of steps of each walker that samples the posterior, usually several thousand: "
            "the chains must be 50 times as long as their autocorrelation time; 0: none; needs "
            "cluster-est[posterior]"
        ),
    )
    walkers: Count = Field(
        0, description="number of walkers; 0: four times the number of unknowns, but at least 16"
    )
    confidence: Finite = Field(
        0.95, ge=0.5, lt=1.0, description="confidence level of profiles, bootstrap and posterior"
    )
    steps: Positive = Field(
        4,
        description=(
            "smallest number of refits on each side of a profile; more refits give a smoother "
            "curve; the ends of the interval are accurate to a thousandth in any case"
        ),
    )
    max_steps: int = Field(
        20,
        ge=2,
        le=LARGEST_INTEGER,
        description=(
            "largest number of refits on one side of a profile; a profile that has not risen by "
            "then is called flat"
        ),
    )
    rise: Finite = Field(
        0.0,
        ge=0.0,
        description="rise of the cost that defines the ends of a profile, for costs without "
        "weights, such as sae; 0: the rise is computed from the residuals",
    )
    at_once: Positive = Field(
        16, description="number of refits that run at the same time, whatever the number of workers"
    )

    @property
    def asked(self) -> tuple[str, ...]:
        """The keys of the requested intervals."""
        every = {
            "profiles": bool(self.profiles),
            "bootstrap": self.bootstrap > 0,
            "posterior": self.posterior > 0,
        }
        return tuple(f"uncertainty.{key}" for key, wanted in every.items() if wanted)
