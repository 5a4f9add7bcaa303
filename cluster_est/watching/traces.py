"""The searches of a run, from their iteration lines: their costs, and the best point of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from cluster_est.closed_loop.settings import LoopStage
from cluster_est.run_folder.run_progress import IterationLine
from cluster_est.running.resources import BestPoint

MOST_TRACED_VALUES = 60
"""Largest number of unknowns for which the history of the best value is kept."""


def is_of_fit(search: str) -> bool:
    """Return whether a search varies all unknowns of a fit and has the cost of the run.

    Refits of profiles and of a bootstrap have other unknowns or data, and refits of a closed loop
    have other models. Their costs cannot be compared.
    """
    return search == "train" or search.startswith("start ")


@dataclass(frozen=True)
class SearchView:
    """A search: its best cost so far (NaN without any), and its last line."""

    best: float
    last: IterationLine


@dataclass
class SearchTraces:
    """The lines of all searches, in order of time.

    Attributes
    ----------
    searches
        Searches by name; the search with the latest line comes last.
    costs
        (search, its evaluations, cost) of each line with a cost.
    best
        Best point over all searches of a fit; None before the first point.
    declared
        Last point of the first fit of the declared model in a closed loop; None before it. Later
        searches of this name begin elsewhere, or fit parts of the records.
    lowest
        The best cost after each line of those searches.
    values
        For each label, the value at the best point after each of those lines, up to a maximum
        number of labels.
    """

    searches: dict[str, SearchView] = field(default_factory=dict)
    costs: list[tuple[str, int, float]] = field(default_factory=list)
    best: BestPoint | None = None
    declared: BestPoint | None = None
    lowest: list[float] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)
    _is_declared_fitted: bool = False

    @property
    def shown(self) -> BestPoint | None:
        """The best point of a fit; before a closed loop has results, that of the declared model."""
        return self.declared if self.best is None else self.best

    @property
    def shown_model(self) -> str:
        """The model of that point, if it need not be that of the result; otherwise ""."""
        return "declared model" if self.best is None and self.declared is not None else ""

    def note(self, line: IterationLine) -> None:
        """Add a line."""
        known = self.searches.pop(line.search, None)
        costs = [line.cost] if known is None else [line.cost, known.best]
        best = min((cost for cost in costs if not math.isnan(cost)), default=math.nan)
        self.searches[line.search] = SearchView(best, line)
        if not math.isnan(line.cost):
            self.costs.append((line.search, line.evaluations, line.cost))
        if is_of_fit(line.search) and line.best is not None:
            self._improve(line.best)
        if line.search == LoopStage.DECLARED_MODEL.value and not self._is_declared_fitted:
            self.declared = line.best or self.declared
            self._is_declared_fitted = bool(line.ending)

    def _improve(self, found: BestPoint) -> None:
        if self.best is None or found.rank < self.best.rank:
            self.best = found
        self.lowest.append(self.best.cost)
        if len(self.best.values) <= MOST_TRACED_VALUES:
            for label, value in self.best.values.items():
                self.values.setdefault(label, []).append(value)
