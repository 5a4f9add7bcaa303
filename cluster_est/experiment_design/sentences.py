"""What an experiment is expected to tell, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from cluster_est.closed_loop.findings.words.numbers import in_a_row, percent

if TYPE_CHECKING:
    from cluster_est.experiment_design.expected import (
        ExpectedEvidence,
        ExpectedPrecision,
        ExpectedProbability,
    )

LARGEST = 1e6
"""Times less likely beyond which no number is said."""


TOLD_APART = 2.0
"""Expected difference of log likelihoods below which nothing is told apart: a factor of 7."""


def times(evidence: float) -> str:
    """Return how many times less likely evidence makes a rival: "40 times"."""
    if math.isnan(evidence):
        return "unknown"
    if evidence > math.log(LARGEST):
        return "more than a million times"
    return f"{math.exp(max(evidence, 0.0)):.2g} times".replace("e+0", "e")


def probability_sentence(first: ExpectedProbability, evidence: Sequence[ExpectedEvidence]) -> str:
    """Say how likely the first model is expected to be, and its nearest rival."""
    own = [row for row in evidence if row.true_model == first.model and row.best >= TOLD_APART]
    said = (
        f"if {first.model} is right, its probability among the models that were kept is expected "
        f"to rise from {percent(first.before)} to {percent(first.after)}"
    )
    others = []
    if not math.isnan(first.random):
        others.append(f"{percent(first.random)} after a random input within the same limits")
    if not math.isnan(first.recorded):
        others.append(f"{percent(first.recorded)} after a recorded one, repeated")
    if others:
        said += f" ({', '.join(others)})"
    if not own:
        return said
    nearest = min(own, key=lambda row: row.evidence)
    return (
        f"{said}; {nearest.rival}, the hardest to tell from it, will be "
        f"{times(nearest.evidence)} less likely"
    )


def alike_sentences(evidence: Sequence[ExpectedEvidence]) -> list[str]:
    """Name the rivals that no input that was looked at tells from the first model."""
    if not evidence:
        return []
    first = evidence[0].true_model
    alike = [r.rival for r in evidence if r.true_model == first and r.best < TOLD_APART]
    if not alike:
        return []
    return [
        f"if {first} is right, no input that was looked at tells it from {in_a_row(alike)}: "
        "within these limits they predict the same, or the one holds the other as a special case"
    ]


def narrowed_sentence(rows: Sequence[ExpectedPrecision]) -> str:
    """Say what an experiment is expected to do to the standard errors."""

    def share(name: str) -> float:
        ratios = [
            getattr(row, name) / row.std_error_before for row in rows if row.std_error_before > 0.0
        ]
        known = [each for each in ratios if not math.isnan(each)]
        if not known:
            return math.nan
        return math.exp(sum(math.log(max(each, 1e-300)) for each in known) / len(known))

    said = (
        "the standard errors are expected to fall to "
        f"{share('std_error_after'):.2g} of what they are, as a geometric mean"
    )
    others = []
    if not math.isnan(share("random")):
        others.append(f"with a random input within the same limits to {share('random'):.2g}")
    if not math.isnan(share("recorded")):
        others.append(f"with a recorded one, repeated, to {share('recorded'):.2g}")
    return "; ".join([said, *others])
