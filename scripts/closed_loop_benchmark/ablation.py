"""The same cases with parts of the search switched off."""

from __future__ import annotations

from collections.abc import Mapping

from closed_loop_benchmark import figures as f
from closed_loop_benchmark.scoring import Score
from closed_loop_benchmark.table import markdown

Runs = Mapping[str, Mapping[str, Score]]
"""By the name of a variant, its scores by case."""


def ablation(runs: Runs) -> str:
    """Write one line a variant, over the cases that came to an end in all of them."""
    ended = [{name for name, s in scores.items() if not s.error} for scores in runs.values()]
    common = set.intersection(*ended) if ended else set()
    head = ["", "cases", "one effect", "from a textbook", "two", "three", "outside", "claimed"]
    rows = [
        _row(label, [scores[name] for name in sorted(common)]) for label, scores in runs.items()
    ]
    return markdown([*head, "worse", "simulations", "95 % at most"], rows)


def _row(label: str, scores: list[Score]) -> list[str]:
    """Rates of what is right, of free curves near the truth, and of what is claimed of nothing."""
    seen = f.detectable(scores)
    nothing = [s for s in scores if not s.true]
    return [
        label,
        str(len(scores)),
        f.share(f.kinds(seen, "single", "coloured"), f.right),
        f.share(f.kinds(seen, "textbook"), f.right),
        f.share(f.kinds(seen, "pair"), f.right),
        f.share(f.kinds(seen, "triple"), f.right),
        f.share(f.kinds(seen, "outside"), f.near_truth),
        f.share(nothing, f.changed),
        f.share(scores, f.worse),
        f.median((s.simulations for s in scores), ".0f"),
        f.most_of(s.simulations for s in scores),
    ]
