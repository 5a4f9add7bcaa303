"""Figures of many scored cases for the tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.stats import beta

from closed_loop_benchmark.naming import accepted_names, is_true
from closed_loop_benchmark.scoring import Score

DETECTABLE = 40.0
"""Smallest likelihood ratio of the true structure of a detectable case."""

Question = Callable[[Score], bool]


def kinds(scores: Iterable[Score], *wanted: str) -> list[Score]:
    """Return the finished cases of some kinds."""
    return [s for s in scores if s.kind in wanted and not s.error]


def detectable(scores: Iterable[Score]) -> list[Score]:
    """Return the cases whose effect is detectable in the data."""
    return [s for s in scores if s.likelihood_ratio >= DETECTABLE]


def detected(score: Score) -> bool:
    """Return whether the method reported that something is missing."""
    return score.detected


def every(mark: str) -> Question:
    """Return a question whether every effect has a mark of `closed_loop_benchmark.naming.Match`."""
    return lambda score: all(getattr(score, mark) or [])


exact, alias = every("exact"), every("alias")
tied, plausible = every("tied"), every("plausible")
form_and_site, site, any_site, place = map(every, ("form_and_site", "site", "any_site", "place"))


def numerical(score: Score) -> bool:
    """Return whether the structure is the same model on the data, with other names."""
    return score.numerical and not alias(score)


def right(score: Score) -> bool:
    """Return whether every effect has one of its names, or the structure is the same model."""
    return alias(score) or score.numerical


def strictly_right(score: Score) -> bool:
    """Return whether a case is right, with a stricter rule for other names.

    Other names must explain 96 % of the effects' influence, with no more coefficients than the
    truth.
    """
    no_more = score.coefficients <= score.true_coefficients
    close = score.distance <= 0.2 * score.distance_without
    return alias(score) or (score.numerical and close and no_more)


def one_right(score: Score) -> bool:
    """Return whether an effect has one of its names, or the structure is the same model."""
    return any(score.alias or []) or score.numerical


def near_truth(score: Score) -> bool:
    """Return whether the held-out error is at most 1.5 times that of the truth."""
    return score.after <= 1.5 * score.oracle


def found(score: Score) -> bool:
    """Return whether the verdict is "found"."""
    return score.verdict == "found"


def changed(score: Score) -> bool:
    """Return whether any effect was reported."""
    return bool(score.named)


def more(score: Score) -> bool:
    """Return whether more effects were reported than are missing."""
    return score.superfluous > 0


def worse(score: Score) -> bool:
    """Return whether the reported effects increase the held-out error."""
    return changed(score) and score.after > score.before


def much_worse(score: Score) -> bool:
    """Return whether they increase it by more than 2 %."""
    return changed(score) and score.after > 1.02 * score.before


def honest(score: Score) -> bool:
    """Return whether nothing was added, or the additions reduce the held-out error."""
    return not changed(score) or score.after < score.before


def has_probabilities(score: Score) -> bool:
    """Return whether a case has probabilities, and a true structure in the library."""
    known = score.name in accepted_names()  # other kinds have their own tables
    return bool(score.likely) and score.has_oracle and known


def holds_truth(score: Score) -> bool:
    """Return whether the truth is among the likely sets, by a name or an algebraic alias."""
    return any(is_true(names, accepted_names()[score.name]) for names in score.likely or [])


def gap(score: Score) -> float:
    """Return the held-out error over that of the true structure refitted."""
    return score.after / score.oracle


def share(scores: Sequence[Score], question: Question) -> str:
    """Return the number of cases that satisfy a question, the total, and the percentage."""
    if not scores:
        return "-"
    hits = sum(map(question, scores))
    return f"{hits}/{len(scores)} ({100.0 * hits / len(scores):.1f} %)"


def percent(scores: Sequence[Score], question: Question) -> str:
    """Return the percentage of cases that satisfy a question."""
    return f"{100.0 * np.mean([question(s) for s in scores]):.0f} %" if scores else "-"


def median(values: Iterable[float], form: str = ".3f") -> str:
    """Return the median of the finite values."""
    known = [v for v in values if np.isfinite(v)]
    return format(float(np.median(known)), form) if known else "-"


def covered(scores: Iterable[Score]) -> str:
    """Return the coverage of intervals, for named effects in noise."""
    known = [s for s in scores if s.verdict == "found"]
    held, count = sum(s.covered for s in known), sum(s.intervals for s in known)
    return f"{held}/{count} ({100.0 * held / count:.1f} %)" if count else "-"


def most_of(values: Iterable[float], part: float = 0.95) -> str:
    """Return a quantile of the values; "-" without any."""
    known = list(values)
    return f"{np.quantile(known, part):.0f}" if known else "-"


def upper_bound(hits: int, cases: int, confidence: float = 0.95) -> float:
    """Return the one-sided upper bound of a probability after Clopper and Pearson (1934)."""
    if cases == 0 or hits == cases:
        return 1.0
    return float(beta.ppf(confidence, hits + 1, cases - hits))
