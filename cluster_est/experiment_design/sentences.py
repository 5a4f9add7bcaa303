"""What an experiment is expected to tell, in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cluster_est.closed_loop.findings.words.numbers import in_a_row
from cluster_est.experiment_design.expected_rows import (
    TOLD_APART,
    ExpectedEvidence,
    ExpectedPrecision,
)

LARGEST = 1e6
"""Times less likely beyond which no number is said."""


def times(evidence: float) -> str:
    """Return how many times less likely evidence makes a rival: "40 times"."""
    if math.isnan(evidence):
        return "unknown"
    if evidence > math.log(LARGEST):
        return "more than a million times"
    factor = math.exp(max(evidence, 0.0))
    if factor < 10.0:
        return f"{factor:.1f} times"
    return f"{float(f'{factor:.2g}'):,.0f} times"


def evidence_sentence(evidence: Sequence[ExpectedEvidence]) -> str:
    """Say how clearly an experiment is expected to tell the first model from its nearest rival."""
    first = evidence[0].true_model
    own = [row for row in evidence if row.true_model == first and row.best >= TOLD_APART]
    if not own:
        return f"no input that was looked at tells {first} from its rivals"
    nearest = min(own, key=lambda row: row.evidence)
    said = (
        f"if {first} is right, {nearest.rival}, its rival that is hardest to tell, will be "
        f"{times(nearest.evidence)} less likely after this experiment"
    )
    others = []
    if not math.isnan(nearest.random):
        others.append(f"{times(nearest.random)} after a random input within the same limits")
    if not math.isnan(nearest.recorded):
        others.append(f"{times(nearest.recorded)} after the best recorded one, repeated")
    return f"{said} ({', '.join(others)})" if others else said


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
        "within these limits they predict the same, or one holds the other as a special case"
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
