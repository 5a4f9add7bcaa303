"""Whether the sets of effects that hold 90 % of the probability hold the truth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import permutations

from closed_loop_benchmark.naming import normal
from closed_loop_benchmark.scenarios import all_scenarios
from closed_loop_benchmark.scoring import Score, in_words


def has_probabilities(score: Score) -> bool:
    """Tell whether a case has probabilities, and a true structure among the library's."""
    return bool(score.likely) and score.has_oracle


def holds_truth(score: Score) -> bool:
    """Tell whether the truth is among the likely sets, by a name or an algebraic alias."""
    return any(is_true(names, accepted_names()[score.name]) for names in score.likely or [])


def is_true(named: Sequence[str], accepted: Sequence[Sequence[str]]) -> bool:
    """Tell whether a set of effects is the true one, each by one of its accepted names."""
    if len(named) != len(accepted):
        return False
    return any(
        all(name in names for name, names in zip(order, accepted, strict=True))
        for order in permutations(named)
    )


@cache
def accepted_names() -> dict[str, list[list[str]]]:
    """Return, for each case, the names of each true effect, in words."""
    return {
        case.name: [
            [in_words(normal(n.form, n.site, (n.variable,))) for n in names]
            for names in case.accepted
        ]
        for case in all_scenarios()
    }
