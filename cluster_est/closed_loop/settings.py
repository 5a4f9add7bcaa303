"""The settings of a search for missing effects, and the names of its stages and parts."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field

from cluster_est.errors import EffectError
from cluster_est.settings import LARGEST_INTEGER, Finite, Names, Positive, Settings, sentence
from workers.effects.site import parse_site
from workers.fmu.description import nearest


class LoopStage(enum.Enum):
    """A stage of the run; its value is the name of its parameter searches in the log.

    `running.progress_line.SEARCH_TITLES` has a title for each stage. The last fits also have
    parameter searches with names other than "final", such as "before" and "after".
    """

    WEIGHTS = "weights"
    DECLARED_MODEL = "base"
    LEAVE_ONE_OUT = "leave one out"
    TRAJECTORIES = "course"
    TESTS = "tests"
    PROBE = "probe"
    TRIALS = "trial"
    REFITS = "candidate"
    ENLARGED_INPUTS = "enlarged"
    DROP = "drop"
    FINAL = "final"
    PROCESS_NOISE = "process noise"


class CandidateStage(enum.StrEnum):
    """The last stage that a candidate reached, with its text in findings.parquet."""

    SET_ASIDE = "set aside"
    """The declared parameters can imitate the candidate."""
    SCREENED = "screened"
    REFITTED = "refitted"
    ACCEPTED = "accepted"


def _sites(given: tuple[str, ...]) -> tuple[str, ...]:
    """Return the sites in the normalised notation of `EffectSite`."""
    try:
        return tuple(str(parse_site(text, "closed_loop.sites")) for text in given)
    except EffectError as error:
        raise sentence(str(error)) from None


class LoopPart(enum.StrEnum):
    """A part of the search that can be left out: a move, a gate, or a part that moves share.

    Moves propose structures (`selection/moves.py`). Gates refuse structures
    (`selection/gates.py`).
    """

    ADD = "add"
    ADD_TWO = "add two"
    BEAM = "beam"
    EXCLUDE = "exclude"
    FREE_CURVE = "free curve"
    FREE_DYNAMICS = "free dynamics"
    CURVE_INSTEAD = "curve instead"
    SWITCHED_CURVES = "switched curves"
    OTHER_PLACES = "other places"
    WHITE_LEADERS = "whitened leaders"
    OTHER_FORMS = "other forms"
    SIBLINGS = "siblings"
    DROP = "drop"
    SWITCH_WIDTHS = "switch widths"
    FUNCTIONS_OF_TIME = "functions of time"
    PLACES_FIRST = "places first"
    PRUNING = "pruning"
    SIGNIFICANCE = "significance"
    COLOURED_NOISE = "coloured noise"
    CURVE_ENDS = "curve ends"
    OUT_OF_REACH = "out of reach"
    CRITERION = "criterion"
    WAVES = "waves"
    BOUNDED = "bounded"
    CHOICE_PRICE = "choice price"
    COLOURED_GAIN = "coloured gain"
    NUMERICAL = "numerical error"
    PREDICTION = "prediction"
    LEAST_GAIN = "least gain"
    NEXT_BEST = "next best"
    ANSWER = "answer"
    STRENGTHS = "strengths"


def _parts(given: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of parts, after a check."""
    known = [part.value for part in LoopPart]
    for name in given:
        if name not in known:
            raise sentence(
                f"closed_loop.without: the search has no part {name!r}{nearest(name, known)}"
            )
    return given


class LoopSettings(Settings):
    """The size of the search, and the evidence that it requires for an effect."""

    section: ClassVar[str] = "closed_loop"
    also: ClassVar[Mapping[str, str]] = {"forms": "effects"}

    effects: Names = Field(
        (), description="forms to try, such as coulomb; default: the whole library"
    )
    sites: Annotated[Names, AfterValidator(_sites)] = Field(
        (),
        description='sites to try, such as "der(v)"; default: all, without equations der(x) = v '
        "that only define the speed v",
    )
    max_effects: Positive = Field(3, description="largest number of effects to add")
    significance: Finite = Field(
        0.01,
        gt=0.0,
        lt=1.0,
        description="largest family-wise p-value at which an effect counts as missing",
    )
    draws: int = Field(
        2000, ge=100, le=LARGEST_INTEGER, description="Monte Carlo draws of each null distribution"
    )
    trials: Positive = Field(
        30, description="number of candidates that are each tried by a simulation"
    )
    refits: Positive = Field(
        12,
        description=(
            "number of the tried candidates that get a short refit; a third of the refitted "
            "candidates get a full refit"
        ),
    )
    starts: Positive = Field(
        8,
        description=(
            "number of starts for the fit of the declared model, if the fit from one start does "
            "not reach the noise"
        ),
    )
    least_gain: Finite = Field(
        0.2,
        ge=0.0,
        description="share of the squared error above the noise that an effect must remove",
    )
    near_noise: Finite = Field(
        1.5,
        ge=1.0,
        description=(
            "largest error, as a multiple of the noise, on training and held-out data, for the "
            'verdict "found"'
        ),
    )
    pairs: bool = Field(True, description="try two effects at once if no single effect is enough")
    without: Annotated[Names, AfterValidator(_parts)] = Field(
        (),
        description="parts of the search to leave out, such as drop, to measure their benefit",
    )

    @property
    def forms(self) -> tuple[str, ...]:
        """Names of the forms to try; empty for the whole library."""
        return self.effects
