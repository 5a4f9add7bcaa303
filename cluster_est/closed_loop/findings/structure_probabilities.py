"""The probabilities of the sets of effects that a search compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.words.numbers import in_a_row, percent
from cluster_est.closed_loop.selection.rounds import ComparedStructure

SHARE = 0.9
"""Of the probability that the likely sets hold together."""
TEMPERATURE = 8.0
"""What differences of the criterion are divided by. Benchmark: without, sets that should hold 98 %
held the truth in 91 % of 260 cases, and what was called more than 99 % sure was so in 92 % of 127;
with it in 95 %, and in 99 % of 96. The criterion takes models for exact and refits for complete."""
MOST_NAMED = 5
"""Sets that a sentence names."""
DECLARED = "no effect"


def with_probabilities(
    path: Sequence[ComparedStructure], choice: float
) -> tuple[ComparedStructure, ...]:
    """Give each set of effects its probability among all that were compared.

    With a criterion B, exp(-B / 2) is proportional to the probability of the data under a model,
    and so to that of the model where none was more likely beforehand (A. E. Raftery, Sociol.
    Methodol. 25 (1995) 111-163, doi:10.2307/271063). Here B has the price of the choice of each
    effect among all candidates, and is divided by `TEMPERATURE`: a fractional likelihood (A.
    O'Hagan, J. R. Stat. Soc. B 57 (1995) 99-138, doi:10.1111/j.2517-6161.1995.tb02017.x). Each set
    counts once, at its best refit, which may have been broken off; the declared model is one of
    them, and the last row of what is returned.

    Parameters
    ----------
    path
        Whatever was refitted, each set perhaps in several rounds. The best row of a set has its
        probability, the others NaN.
    choice
        The price of each effect.
    """
    declared = ComparedStructure(0, (), 0.0, 0.0, converged=True, accepted=False)
    rows = [*path, declared]
    best = best_rows(rows)
    priced = [
        rows[number].criterion + choice * len(rows[number].effects) for number in best.values()
    ]
    criteria = np.array(priced) / TEMPERATURE
    weights = np.exp(-0.5 * (criteria - criteria.min()))
    known = dict(zip(best.values(), (weights / np.add.reduce(weights)).tolist(), strict=True))
    return tuple(
        replace(each, probability=known.get(number, np.nan)) for number, each in enumerate(rows)
    )


def best_rows(rows: Sequence[ComparedStructure]) -> dict[frozenset[str], int]:
    """Return the number of the row in which each set of effects has its best refit."""
    best: dict[frozenset[str], int] = {}
    for number, each in enumerate(rows):
        key = frozenset(each.effects)
        if key not in best or each.criterion < rows[best[key]].criterion:
            best[key] = number
    return best


def likely_structures(path: Sequence[ComparedStructure]) -> tuple[ComparedStructure, ...]:
    """Return the fewest sets that hold 90 % of the probability, the likeliest first.

    What was added in the end is among them in any case. None where no probabilities are known.
    """
    known = [each for each in path if np.isfinite(each.probability)]
    ranked = sorted(known, key=lambda each: -each.probability)
    held = np.cumsum([each.probability for each in ranked])
    likely = ranked[: int(np.searchsorted(held, SHARE)) + 1]
    added = [frozenset(each.effects) for each in path if each.accepted][-1:]
    likely += [each for each in ranked if frozenset(each.effects) in added and each not in likely]
    return tuple(likely)


def likely_sentence(path: Sequence[ComparedStructure]) -> str:
    """Say which sets of effects the data leave room for; "" where that is not known."""
    likely = likely_structures(path)
    if not likely:
        return ""
    count = len({frozenset(each.effects) for each in path})
    shares = [percent(each.probability) for each in likely]
    shares[0] += " of the probability"
    called = [" + ".join(each.effects) or DECLARED for each in likely]
    named = [f"{name} {share}" for name, share in zip(called, shares, strict=True)]
    if len(named) > MOST_NAMED:
        named = [*named[: MOST_NAMED - 1], f"{len(named) - MOST_NAMED + 1} more the rest"]
    return (
        f"of the {count} sets of effects that were compared, allowing for a model that is not "
        f"exact, the data give {in_a_row(named)}"
    )
