"""What a simulation costs with the effects that a search has tried, in steps of the solver."""

from __future__ import annotations

from collections.abc import Sequence

from cluster_est.closed_loop.selection.rounds import ComparedStructure

DEAR = 5.0
"""Times the solver steps of the declared model from which a structure is said to be dear."""


def dear_structures(path: Sequence[ComparedStructure]) -> tuple[str, ...]:
    """Say which structures make simulations dear; nothing where none does.

    A solver that adapts its steps makes more of them where an effect is fast: a lag of a
    millisecond in a record of an hour. The steps are counted, so that the sentence is the same on
    every machine.

    Parameters
    ----------
    path
        The structures that were compared.
    """
    dear = [each for each in path if each.relative_steps > DEAR]
    if not dear:
        return ()
    worst = max(dear, key=lambda each: each.relative_steps)
    tried = "1 structure" if len(dear) == 1 else f"{len(dear)} structures"
    said = (
        f"{tried} of the {len(path)} that were tried needed more than {DEAR:g} times as many steps "
        f"of the solver as the declared model, most of all {' + '.join(worst.effects)} "
        f"({worst.relative_steps:.3g} times); structures.parquet has the figure of each "
        "(relative_steps)"
    )
    kept = [each for each in dear if each.accepted]
    if kept:
        most = kept[-1].relative_steps
        said += f"; with what was added a simulation takes {most:.3g} times the steps"
    return (said,)
