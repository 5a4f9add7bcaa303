"""How sure a claimed effect is: its evidence, and the probability that it is right.

A claim is right if the place, the argument and the kind of the effect are those of the missing
effect, or of an equation with the same values on the data. The probability comes from a logistic
regression with a few numbers of the evidence. It was fitted to claims of the benchmark, for which
the truth is known; `scripts/bench_closed_loop.py --calibrate` fits it again. The sentence on a
claim says how many benchmark claims in a range of probabilities around it were right. The share of
the gap that is closed, rivals, the order of the effects and the number of improved parts were also
tried, but in the benchmark they do not distinguish right claims from wrong ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.display import in_percent, percent


@dataclass(frozen=True)
class ClaimEvidence:
    """The evidence for an effect, as a member of a set of effects.

    Attributes
    ----------
    effects
        Number of effects in the set.
    shared
        Whether another effect of the set has the same site and arguments.
    left
        Largest remaining error of an output over its noise, on training or held-out data.
    closed
        Share of the gap between squared error and squared noise that all effects together close: on
        held-out data if there are any, otherwise on training data.
    rival
        Criterion of the best structure without the effect, minus that of the best structure with
        it.
    chosen
        Share of the resamplings whose best structure contains the effect; NaN if not known.
    at_end
        Whether one of its coefficients is at the end of its range, or all of its strengths, one
        for each experiment, may be zero.
    free
        Whether it is a free curve.
    """

    effects: int
    shared: bool
    left: float
    closed: float
    rival: float
    chosen: float
    at_end: bool
    free: bool

    @property
    def doubtful(self) -> bool:
        """Whether the remaining error is large, or a coefficient is not determined (`at_end`).

        Such claims are rare in the benchmark, and frequent on measured data. They are counted
        separately.
        """
        return self.left > LEAVES_MUCH or self.at_end


@dataclass(frozen=True)
class LikeClaims:
    """A group of similar benchmark claims, and how many of them were right.

    Attributes
    ----------
    least
        Lowest probability in the group, from a regression on the other systems.
    right, of
        Number of claims that were right, and of all claims.
    """

    least: float
    right: int
    of: int

    @property
    def expected(self) -> float:
        """Probability that a further claim is right, by Laplace's rule of succession."""
        return (self.right + 1.0) / (self.of + 2.0)


@dataclass(frozen=True)
class ClaimCalibration:
    """The regression on the benchmark claims, and how many of these claims were right.

    The log odds are `intercept + fewer * (1 - effects) + clean * REST / (REST + left^2 - 1) + apart
    * (not shared) + chosen * chosen`. No weight is negative, because evidence for a claim must not
    make it less sure.

    Attributes
    ----------
    origin
        The claims to which it was fitted.
    intercept
        Log odds if all numbers of the evidence are 0.
    fewer
        Added log odds for each effect less in the set. Later effects may describe the error of
        earlier ones, and one law may be found as several pieces.
    clean
        Added log odds of a set that leaves only noise, compared with a set that leaves far more. A
        remaining error says that the set is incomplete or wrong, but its size hardly matters.
    apart
        Added log odds of an effect that does not share its site and arguments with another effect.
        If effects share them, the data determine only the sum of these effects.
    chosen
        Added log odds of an effect that is chosen in all resamplings, compared with none.
    alike
        Claims of laws in five bins by their probability, which comes from a regression without
        their own system. The lowest bin is the first. If a smaller share is right than in the bin
        before, the two bins are merged.
    doubtful
        Doubtful claims of laws (see `ClaimEvidence.doubtful`). No such claim is surer than these.
    curves
        Free curves: right if the place is right, whatever the law.
    leads, lead_places
        Effects that were not claimed: right in place and law, and right in place alone.
    """

    origin: str
    intercept: float
    fewer: float
    clean: float
    apart: float
    chosen: float
    alike: tuple[LikeClaims, ...]
    doubtful: LikeClaims
    curves: LikeClaims
    leads: LikeClaims
    lead_places: LikeClaims


REST = 0.1
"""Squared error over squared noise, minus 1, at which the weight `clean` counts half. Benchmark:
of 0.05, 0.1, 0.2 and 0.4, this value best distinguishes right claims from wrong ones."""
LEAVES_MUCH = 1.5
"""Error over the noise above which a claim is doubtful. By definition: the most that "found" may
leave."""
CHOSEN = 1.0
"""Value of `chosen` if it is not known. Benchmark: the median of all claims."""
CLAIMED = 0.5
"""Probability below which an effect is not claimed. By definition: it is more likely wrong than
right."""
FEW = 40
"""If a group has fewer benchmark claims, the sentence says that they are few. By definition."""

AGREEING = "a law that agrees with the true one on the data counts as right"

CALIBRATION = ClaimCalibration(
    origin="306 claims in 128 cases of 26 systems, 60 of them wrong, 7 free curves, 78 leads",
    intercept=-2.37,
    fewer=1.03,
    clean=3.89,
    apart=1.6,
    chosen=1.46,
    alike=(
        LikeClaims(0.0779, 27, 62),
        LikeClaims(0.7, 45, 61),
        LikeClaims(0.865, 115, 122),
        LikeClaims(0.969, 59, 61),
    ),
    doubtful=LikeClaims(0.0, 9, 24),
    curves=LikeClaims(0.0, 6, 7),
    leads=LikeClaims(0.0, 12, 78),
    lead_places=LikeClaims(0.0, 33, 78),
)


@dataclass(frozen=True)
class Claim:
    """How sure it is that an effect is right.

    Attributes
    ----------
    probability
        Probability that place and law are right; for a free curve, that the place is right. NaN
        for a lead.
    sentence
        The probability in words, and how many claims in this range of the benchmark were right.
    evidence
        The evidence from which it was computed.
    """

    probability: float
    sentence: str
    evidence: ClaimEvidence

    @property
    def claimed(self) -> bool:
        """Return whether it is more likely right than wrong; else it is a lead."""
        return self.probability >= CLAIMED


def figures(evidence: ClaimEvidence) -> tuple[float, float, float, float]:
    """Return the numbers that are multiplied by `fewer`, `clean`, `apart` and `chosen`."""
    beyond = max(evidence.left**2 - 1.0, 0.0)
    return (
        1.0 - evidence.effects,
        REST / (REST + beyond),
        float(not evidence.shared),
        evidence.chosen if np.isfinite(evidence.chosen) else CHOSEN,
    )


def claim(evidence: ClaimEvidence, known: ClaimCalibration = CALIBRATION) -> Claim:
    """Return how sure a claimed effect is."""
    if evidence.free:
        alike = known.curves
        said = (
            "this is a place without a law: "
            f"{_of_alike(alike, '{} free curves', 'at the right place')}"
        )
        return Claim(alike.expected, said, evidence)
    weights = known.fewer, known.clean, known.apart, known.chosen
    odds = known.intercept + float(np.dot(weights, figures(evidence)))
    probability = float(1.0 / (1.0 + np.exp(-odds)))
    alike, called = _with_like_probability(known.alike, probability)
    most = known.doubtful if evidence.doubtful else known.alike[-1]
    # the regression may extrapolate, so the share of right claims is an upper limit
    certain = min(probability, most.expected)
    said = f"place and law are right with a probability of {percent(certain)}"
    if evidence.doubtful and certain < probability:  # otherwise the share is not the reason
        said += f": {_of_alike(most, '{} equally doubtful claims')}"
    elif not evidence.doubtful and certain >= CLAIMED:  # a lead's group also has surer claims
        said += f": {_of_alike(alike, called)}"
    said += f" ({AGREEING})"
    if certain < CLAIMED:
        said = f"this is a lead, not a claim: {said}"
    return Claim(certain, said, evidence)


def _with_like_probability(
    groups: Sequence[LikeClaims], probability: float
) -> tuple[LikeClaims, str]:
    """Return the group of claims with such a probability, and its range in words."""
    place = max((i for i, each in enumerate(groups) if each.least <= probability), default=0)
    if place == len(groups) - 1:
        return groups[place], "the {} surest claims"
    above = percent(groups[place + 1].least)
    if not place:
        return groups[place], f"{{}} claims with less than {above}"
    return groups[place], f"{{}} claims with {percent(groups[place].least)} to {above}"


def lead(evidence: ClaimEvidence, known: ClaimCalibration = CALIBRATION) -> Claim:
    """Return how sure an effect is that closes too little of the gap to be claimed."""
    right, place = known.leads, known.lead_places
    few = " (a small number)" if right.of < FEW else ""
    were = "was" if right.right == 1 else "were"
    both, one = (in_percent(each.right / each.of) for each in (right, place))
    said = (
        f"this is a lead, not a claim: of {right.of} leads in the benchmark{few}, in which the "
        f"missing effect is known, {right.right} ({both}) {were} right in place and law, and "
        f"{place.right} ({one}) at least in place"
    )
    return Claim(np.nan, said, evidence)


def _of_alike(alike: LikeClaims, called: str, right: str = "right") -> str:
    """Say how many of a group of similar claims were right."""
    were = "was" if alike.right == 1 else "were"
    few = " (a small number)" if alike.of < FEW else ""
    return f"of {called.format(alike.of)} in the benchmark{few}, {alike.right} {were} {right}"
