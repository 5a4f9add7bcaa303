"""What the tables count: figures of many scored cases."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.stats import beta

from closed_loop_benchmark.naming import accepted_names, is_true
from closed_loop_benchmark.scoring import Score

DETECTABLE = 40.0
"""Least likelihood ratio of the true structure at which a case counts as detectable."""

Question = Callable[[Score], bool]


def kinds(scores: Iterable[Score], *wanted: str) -> list[Score]:
    """Return the cases of some kinds that came to an end."""
    return [s for s in scores if s.kind in wanted and not s.error]


def detectable(scores: Iterable[Score]) -> list[Score]:
    """Return the cases whose effect can be seen in the data."""
    return [s for s in scores if s.likelihood_ratio >= DETECTABLE]


def detected(score: Score) -> bool:
    """Tell whether something was said to be missing."""
    return score.detected


def every(mark: str) -> Question:
    """Ask whether every effect of a case has a mark of `closed_loop_benchmark.naming.Match`."""
    return lambda score: all(getattr(score, mark) or [])


exact, alias = every("exact"), every("alias")
tied, plausible = every("tied"), every("plausible")
form_and_site, site, any_site, place = map(every, ("form_and_site", "site", "any_site", "place"))


def numerical(score: Score) -> bool:
    """Tell whether the structure is the same model on the data, under other names."""
    return score.numerical and not alias(score)


def right(score: Score) -> bool:
    """Tell whether every effect got one of its names, or the structure is the same model."""
    return alias(score) or score.numerical


def strictly_right(score: Score) -> bool:
    """Tell the same by a stricter rule for other names.

    They carry 96 % of what the effects change, with no more coefficients than the truth.
    """
    no_more = score.coefficients <= score.true_coefficients
    close = score.distance <= 0.2 * score.distance_without
    return alias(score) or (score.numerical and close and no_more)


def one_right(score: Score) -> bool:
    """Tell whether at least one effect got one of its names, or the structure is the same model."""
    return any(score.alias or []) or score.numerical


def near_truth(score: Score) -> bool:
    """Tell whether the held-out error is at most 1.5 times that of the truth."""
    return score.after <= 1.5 * score.oracle


def found(score: Score) -> bool:
    """Tell whether the verdict is "found"."""
    return score.verdict == "found"


def changed(score: Score) -> bool:
    """Tell whether any effect was reported."""
    return bool(score.named)


def more(score: Score) -> bool:
    """Tell whether more effects were reported than are missing."""
    return score.superfluous > 0


def worse(score: Score) -> bool:
    """Tell whether the reported effects make the held-out error worse."""
    return changed(score) and score.after > score.before


def much_worse(score: Score) -> bool:
    """Tell whether they make it worse by more than 2 %."""
    return changed(score) and score.after > 1.02 * score.before


def honest(score: Score) -> bool:
    """Tell whether nothing was added, or what was added improves the held-out error."""
    return not changed(score) or score.after < score.before


def has_probabilities(score: Score) -> bool:
    """Tell whether a case has probabilities, and a true structure among the library's."""
    known = score.name in accepted_names()  # kinds of their own have tables of their own
    return bool(score.likely) and score.has_oracle and known


def holds_truth(score: Score) -> bool:
    """Tell whether the truth is among the likely sets, by a name or an algebraic alias."""
    return any(is_true(names, accepted_names()[score.name]) for names in score.likely or [])


def gap(score: Score) -> float:
    """Return the held-out error over that of the true structure refitted."""
    return score.after / score.oracle


def share(scores: Sequence[Score], question: Question) -> str:
    """Write how many cases, of how many, and the percentage."""
    if not scores:
        return "-"
    hits = sum(map(question, scores))
    return f"{hits}/{len(scores)} ({100.0 * hits / len(scores):.1f} %)"


def percent(scores: Sequence[Score], question: Question) -> str:
    """Write in how many percent of the cases."""
    return f"{100.0 * np.mean([question(s) for s in scores]):.0f} %" if scores else "-"


def median(values: Iterable[float], form: str = ".3f") -> str:
    """Write the median of those that are numbers."""
    known = [v for v in values if np.isfinite(v)]
    return format(float(np.median(known)), form) if known else "-"


def covered(scores: Iterable[Score]) -> str:
    """Write how many intervals hold the truth, where an effect was named and noise is left."""
    known = [s for s in scores if s.verdict == "found"]
    held, count = sum(s.covered for s in known), sum(s.intervals for s in known)
    return f"{held}/{count} ({100.0 * held / count:.1f} %)" if count else "-"


def most_of(values: Iterable[float], part: float = 0.95) -> str:
    """Write what this part of the values is at most; "-" without any."""
    known = list(values)
    return f"{np.quantile(known, part):.0f}" if known else "-"


def upper_bound(hits: int, cases: int, confidence: float = 0.95) -> float:
    """Return the one-sided bound of a probability after Clopper and Pearson (1934)."""
    if cases == 0 or hits == cases:
        return 1.0
    return float(beta.ppf(confidence, hits + 1, cases - hits))
