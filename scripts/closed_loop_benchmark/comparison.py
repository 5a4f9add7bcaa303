"""Two runs of the benchmark side by side: which cases a change has made wrong, and which right."""

from __future__ import annotations

from collections.abc import Mapping

from closed_loop_benchmark import figures as f
from closed_loop_benchmark.scoring import Score
from closed_loop_benchmark.table import one_line


def holds(score: Score) -> bool:
    """Tell whether what was said of a case is right.

    Nothing may be claimed of a case without an effect, nor held-out data be followed worse than
    before; an effect must have one of its names, or be the same model on the data. Where the
    library cannot express the truth, anything that follows held-out data no worse is right.
    """
    if score.error or f.worse(score):
        return False
    if not score.true:
        return not f.changed(score)
    return f.right(score) or score.kind == "outside"


def compare_runs(old: Mapping[str, Score], new: Mapping[str, Score]) -> tuple[str, int]:
    """Compare the cases that both have.

    Returns
    -------
    str
        A line for each case that is no longer right, with what was said then and now, the names of
        those that have become right, and the counts.
    int
        How many are no longer right.
    """
    both = [name for name in old if name in new]
    lost = [name for name in both if holds(old[name]) and not holds(new[name])]
    won = [name for name in both if holds(new[name]) and not holds(old[name])]
    lines = [
        line
        for name in lost
        for line in (f"was {one_line(old[name])}", f"is  {one_line(new[name])}", "")
    ]
    lines += [f"now right: {name}" for name in won]
    right = sum(holds(old[name]) for name in both), sum(holds(new[name]) for name in both)
    lines.append(
        f"{len(both)} cases in both: right {right[0]} -> {right[1]}, "
        f"no longer right {len(lost)}, now right {len(won)}"
    )
    return "\n".join(lines), len(lost)
