"""How sure a claimed effect is: its evidence, and the probability that it is right.

A claim is right if the effect has a right name: its place, its argument and its kind are those of
what is missing, or of an equation that is the same on the data. The probability follows from few
figures of the evidence, by a logistic regression on claims of the benchmark, whose truth is known;
`scripts/bench_closed_loop.py --calibrate` fits it anew. What is said beside it is how many of the
claims there with such a probability were right. Share closed, rivals, order
and parts that become better were tried besides: they do not tell right from wrong there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_est.problem.display import percent


@dataclass(frozen=True)
class ClaimEvidence:
    """What speaks for an effect, in the set of effects that it belongs to.

    Attributes
    ----------
    effects
        How many effects the set has.
    shared
        Another effect of the set has the same site and arguments.
    left
        The largest error of an output that is left, over the noise: of training or held-out data.
    closed
        Share of the gap between the squares of error and noise that all effects close: of held-out
        data where there are some, else of those of training.
    rival
        Criterion of the best structure without the effect, less that of the best with it.
    chosen
        Share of the resamplings of the experiments whose best structure has it; NaN if not known.
    at_end
        A coefficient of it stands at the end of its range.
    free
        It is a free curve.
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
        """Much is left, or its law is at the end of its range.

        Such claims are few in the benchmark, and most on measured data: they are counted apart.
        """
        return self.left > LEAVES_MUCH or self.at_end


@dataclass(frozen=True)
class LikeClaims:
    """Claims of the benchmark that are alike, and how many of them were right.

    Attributes
    ----------
    least
        Lowest probability of one of them, as the regression on the other systems has it.
    right, of
        Claims that were right, and all.
    """

    least: float
    right: int
    of: int

    @property
    def expected(self) -> float:
        """Probability that one more is right, after the rule of succession of Laplace."""
        return (self.right + 1.0) / (self.of + 2.0)


@dataclass(frozen=True)
class ClaimCalibration:
    """The regression on the claims of the benchmark, and how many of these were right.

    The log odds are `intercept + fewer * (1 - effects) + clean * REST / (REST + left^2 - 1) +
    apart * (not shared) + chosen * chosen`. No weight is negative: what speaks for a claim must not
    make it less sure.

    Attributes
    ----------
    origin
        What it was fitted to.
    intercept
        Log odds where all figures are 0.
    fewer
        Of a set with one effect less: later effects live of what the first ones leave, and pieces
        of one law come as several.
    clean
        Of a set that leaves noise alone, over one that leaves far more: what is left says that the
        set is not what is missing, and no more by being larger.
    apart
        Of an effect that shares its site and arguments with no other: the data determine the sum of
        those that do.
    chosen
        Of an effect that is chosen in all resamplings, over one that is in none.
    alike
        Claims of laws in five bins by their probability on systems that were left out, the lowest
        first. Bins in which less are right than in the one before are one bin with that.
    doubtful
        Claims of laws that are doubtful (see there): no such claim is surer.
    curves
        Free curves: right at the place, whatever the law.
    leads, lead_places
        Effects that were not claimed: right in place and kind, and right in place alone.
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
"""Squares over the noise, less 1, that count half. Benchmark: of 0.05, 0.1, 0.2 and 0.4 it tells
right from wrong best."""
LEAVES_MUCH = 1.5
"""Error over the noise from which a claim is doubtful. By definition: what "found" may leave."""
CHOSEN = 1.0
"""Share of the resamplings where it is not known. Benchmark: the median of all claims."""
FEW = 40
"""Claims of the benchmark below which it is said that there are few. By definition."""

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
        That it is right in place and kind, of a free curve in place; NaN of a lead.
    sentence
        The same in words, with how many claims like this were right in the benchmark.
    evidence
        What it follows from.
    """

    probability: float
    sentence: str
    evidence: ClaimEvidence


def figures(evidence: ClaimEvidence) -> tuple[float, float, float, float]:
    """Return what the weights `fewer`, `clean`, `apart` and `chosen` multiply."""
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
            f"{_of_alike(alike, 'free curves', 'at the right place')}"
        )
        return Claim(alike.expected, said, evidence)
    weights = known.fewer, known.clean, known.apart, known.chosen
    odds = known.intercept + float(np.dot(weights, figures(evidence)))
    probability = float(1.0 / (1.0 + np.exp(-odds)))
    alike = max((a for a in known.alike if a.least <= probability), default=known.alike[0],
                key=lambda a: a.least)  # fmt: skip
    called, most = "similar claims", known.alike[-1]
    if evidence.doubtful:
        alike = most = known.doubtful
        called = "equally doubtful claims"
    # no surer than these claims allow for, however far the regression goes
    probability = min(probability, most.expected)
    said = (
        f"place and kind are right with a probability of {percent(probability)}: "
        f"{_of_alike(alike, called)}"
    )
    return Claim(probability, said, evidence)


def lead(evidence: ClaimEvidence, known: ClaimCalibration = CALIBRATION) -> Claim:
    """Return how sure an effect is that does not close enough to be claimed."""
    right, place = known.leads, known.lead_places
    said = (
        f"this is a lead, not a claim: {_of_alike(right, 'leads', 'right in place and kind')}, and "
        f"{place.right} at least in place"
    )
    return Claim(np.nan, said, evidence)


def _of_alike(alike: LikeClaims, called: str, right: str = "right") -> str:
    """Say how many of the claims that are alike were right."""
    were = "was" if alike.right == 1 else "were"
    few = " (a small number)" if alike.of < FEW else ""
    return f"of {alike.of} {called} in the benchmark{few}, {alike.right} {were} {right}"
