"""How often the effects that were found are chosen where the experiments are drawn anew."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.closed_loop.findings.competing_models import leading_models
from cluster_est.closed_loop.findings.structure_probabilities import (
    DECLARED,
    best_rows,
)
from cluster_est.closed_loop.findings.words.numbers import in_a_row, percent
from cluster_est.closed_loop.selection.gates import SELECTION
from cluster_est.closed_loop.selection.rounds import ComparedStructure, SelectionResult
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.statistics.choice_shares import LinearFit, choice_shares
from workers.messages import IntArray

DRAWS = 200
FEWEST = 5
"""Experiments that are drawn as they are; of fewer, parts of their records."""
PARTS = 10
LEADING = 12
"""Sets of effects that are compared: those with the best criterion."""
MOST_UNKNOWNS = 150
MOST_NAMED = 4
STREAM = 7
"""Of the workbench's generators."""


@dataclass(frozen=True)
class ResampledChoices:
    """The shares of draws in which sets of effects are chosen.

    Attributes
    ----------
    drawn
        What was drawn, in words.
    shares
        By the labels of a set's effects.
    """

    drawn: str
    shares: Mapping[tuple[str, ...], float] = field(repr=False)

    @property
    def sentence(self) -> str:
        """Say how often each set is chosen, the most frequent first."""
        ranked = sorted(self.shares.items(), key=lambda known: -known[1])
        named = [
            f"{' + '.join(labels) or DECLARED} in {percent(share)}"
            for labels, share in ranked
            if share > 0.0
        ]
        said = in_a_row(named[:MOST_NAMED])
        return f"of {DRAWS} times that {self.drawn} were drawn anew, the best set is {said}"


def resampled_choices(workbench: LoopWorkbench, found: SelectionResult) -> ResampledChoices | None:
    """Draw the training experiments anew and choose again among the leading sets of effects.

    Each is refitted by its linear model, so it takes no simulation. None where no effect was added,
    or a set has too many unknowns for it.

    Parameters
    ----------
    workbench, found
        Where, and the end of the search.
    """
    if not found.current.added:
        return None
    leading = leading_models(workbench, found, LEADING)
    if max(len(fit.x) for fit in leading) > MOST_UNKNOWNS:
        return None
    choice = SELECTION.choice_price * np.log(found.steps[0].screening.count)
    fits = [LinearFit(f.residuals, f.jacobian, choice * len(f.added)) for f in leading]
    whole = len(workbench.train) >= FEWEST
    pieces, outputs = _pieces(workbench, whole=whole)
    shares = choice_shares(fits, pieces, outputs, DRAWS, workbench.generator(STREAM))
    drawn = f"the {len(workbench.train)} experiments" if whole else "tenths of the records"
    labels = [tuple(candidate.label for candidate in fit.added) for fit in leading]
    return ResampledChoices(drawn, dict(zip(labels, shares.tolist(), strict=True)))


def with_choices(
    path: Sequence[ComparedStructure], choices: ResampledChoices | None
) -> tuple[ComparedStructure, ...]:
    """Give each set of effects its share, in the row of its best refit."""
    if choices is None:
        return tuple(path)
    shares = {frozenset(labels): share for labels, share in choices.shares.items()}
    known = {number: shares.get(key, np.nan) for key, number in best_rows(path).items()}
    return tuple(
        replace(each, chosen=known.get(number, np.nan)) for number, each in enumerate(path)
    )


def _pieces(workbench: LoopWorkbench, *, whole: bool) -> tuple[IntArray, IntArray]:
    """The number of the piece and of the output of each residual."""
    pieces, outputs = np.zeros(workbench.size, int), np.zeros(workbench.size, int)
    for item in workbench.records.items:
        outputs[item.rows] = item.output
        pieces[item.rows] = item.experiment
        if not whole and len(item.times):
            run = workbench.problem.experiments[workbench.train[item.experiment]]
            passed = (item.times - run.start) / (run.stop - run.start)
            part = np.clip((PARTS * passed).astype(int), 0, PARTS - 1)
            pieces[item.rows] = PARTS * item.experiment + part
    return np.unique(pieces, return_inverse=True)[1], np.unique(outputs, return_inverse=True)[1]
