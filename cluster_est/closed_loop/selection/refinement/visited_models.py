"""The models that a search has come by, so that what was done at one is not done again."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from cluster_est.closed_loop.screening.ranking import CandidateRanking, rank
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate, ending_with
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench

SAME = 0.1
"""Distance of two residuals, in standard deviations of one sample's noise, up to which they are
those of one model: a statistic of 100 then changes by 2 at most."""


@dataclass
class VisitedModel:
    """A model that effects were added to.

    Attributes
    ----------
    fitted
        The model.
    ranking
        Of the candidates at it; None where it was not kept.
    grown
        What was refitted to convergence with one effect more, by its structure.
    """

    fitted: FittedModel = field(repr=False)
    ranking: CandidateRanking | None = field(default=None, repr=False)
    grown: dict[frozenset[str], RefittedCandidate] = field(default_factory=dict, repr=False)


@dataclass
class VisitedModels:
    """The models that a search has added effects to, by their structures.

    A revision takes effects out again, and so comes back to models that were ranked and grown
    before. The rankings are kept where each takes a simulation for every candidate, as in
    co-simulation and with process noise; where linear systems answer for all, one takes none and is
    made again. Free curves are not kept: they are made anew for each model.

    Attributes
    ----------
    noise
        Variance of the residuals that the noise alone would leave.
    """

    noise: float
    _models: dict[frozenset[str], VisitedModel] = field(default_factory=dict, repr=False)

    def ranking(self, workbench: LoopWorkbench, fitted: FittedModel) -> CandidateRanking:
        """The ranking of the candidates at a model."""
        known = self._at(fitted).ranking
        return known if known is not None else self.keep(workbench, fitted, rank(workbench, fitted))

    def keep(
        self, workbench: LoopWorkbench, fitted: FittedModel, ranking: CandidateRanking
    ) -> CandidateRanking:
        """Keep the ranking of a model."""
        self._at(fitted).ranking = None if workbench.by_linear_systems else ranking
        return ranking

    def grown_from(self, fitted: FittedModel) -> list[RefittedCandidate]:
        """What was refitted with one effect more than a model, which is counted last."""
        return [
            ending_with(contender, min(structure - fitted.structure))
            for structure, contender in self._at(fitted).grown.items()
        ]

    def add(self, fitted: FittedModel, contenders: Collection[RefittedCandidate]) -> None:
        """Add what was grown from a model; of one structure, the better one stays."""
        grown = self._at(fitted).grown
        for contender in contenders:
            known = grown.get(contender.fitted.structure, contender)
            if contender.full and not contender.candidate.form.free:
                best = min(known, contender, key=lambda c: c.criterion)
                grown[contender.fitted.structure] = best

    def _at(self, fitted: FittedModel) -> VisitedModel:
        """The model, if it still is where it was; else a new one in its place."""
        known = self._models.get(fitted.structure)
        if known is None or _distance(fitted, known.fitted) > SAME**2 * self.noise:
            known = self._models[fitted.structure] = VisitedModel(fitted)
        return known


def _distance(one: FittedModel, other: FittedModel) -> float:
    """Return the sum of squares between the residuals of two fits."""
    return float(np.add.reduce((one.residuals - other.residuals) ** 2))
