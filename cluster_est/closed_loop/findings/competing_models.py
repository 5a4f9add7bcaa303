"""The models that a search leaves room for: what was found, and its nearest rivals, as they fit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster_est.closed_loop.findings.config_block import effect_block
from cluster_est.closed_loop.findings.structure_probabilities import DECLARED, TEMPERATURE
from cluster_est.closed_loop.fitter import FittedModel
from cluster_est.closed_loop.selection.gates import SELECTION
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from workers.messages import Effect

MOST = 6
"""Models that are kept."""
FAR = 50.0
"""Difference of the criterion beyond which a model is no rival: some 1 to 20 after all that the
probabilities of structures allow for."""


@dataclass(frozen=True)
class CompetingModel:
    """A model that the data leave room for.

    Attributes
    ----------
    name
        The labels of its effects.
    problem
        With its effects, on the experiments of the run.
    values
        Estimates by label.
    criterion
        Bayesian information criterion with the price of the choice, less that of what was found.
    weight
        Probability among the models that are kept.
    added
        The effects that were added, each with its coefficients.
    """

    name: str
    problem: Problem = field(repr=False)
    values: Mapping[str, float] = field(repr=False)
    criterion: float
    weight: float
    added: tuple[tuple[Effect, tuple[Parameter, ...]], ...] = field(repr=False, default=())

    def facts(self) -> dict[str, Any]:
        """Return what run.json says of it: all that it takes to make it again."""
        return {
            "name": self.name,
            "criterion": self.criterion,
            "weight": self.weight,
            "config": "".join(effect_block(effect, own) for effect, own in self.added),
            "values": dict(self.values),
        }


def leading_models(
    workbench: LoopWorkbench, found: SelectionResult, most: int
) -> list[FittedModel]:
    """Return the models with the best criterion, each set of effects once, what was added first."""
    fits = [found.current, found.base]
    fits += [each.fitted for step in found.steps for each in step.contenders]
    fits += [each.fitted for _, rivals in found.rivals.values() for each in rivals]
    best: dict[frozenset[str], FittedModel] = {}
    for fit in sorted(fits, key=lambda each: each.criterion(workbench.records)):
        best.setdefault(fit.structure, fit)
    best[found.current.structure] = found.current
    others = [fit for key, fit in best.items() if key != found.current.structure]
    return [found.current, *others[: most - 1]]


def competing_models(
    workbench: LoopWorkbench, found: SelectionResult
) -> tuple[CompetingModel, ...]:
    """Return what was found, and the rivals that the data do not rule out, the nearest first.

    Their weights are probabilities as `with_probabilities` has them, among those that are kept.
    """
    price = SELECTION.choice_price * np.log(found.steps[0].screening.count)
    leading = leading_models(workbench, found, 4 * MOST)
    criteria = np.array(
        [fit.criterion(workbench.records) + price * len(fit.added) for fit in leading]
    )
    criteria -= criteria[0]
    order = sorted(range(1, len(leading)), key=lambda i: criteria[i])
    kept = [0, *(i for i in order if criteria[i] < FAR)][:MOST]
    weights = np.exp(-0.5 * (criteria[kept] - criteria[kept].min()) / TEMPERATURE)
    weights /= np.add.reduce(weights)
    return tuple(
        _competing(leading[i], float(criteria[i]), weight)
        for i, weight in zip(kept, weights.tolist(), strict=True)
    )


def _competing(fit: FittedModel, criterion: float, weight: float) -> CompetingModel:
    """A fitted model on the run's experiments; the coefficients of its effects begin as fitted."""
    values = fit.estimates
    added = []
    for candidate in fit.added:
        own = [p for p in fit.problem.parameters if p.name.startswith(f"{candidate.effect.name}.")]
        begun = tuple(dataclasses.replace(p, start=float(values.get(p.name, p.start))) for p in own)
        added.append((candidate.effect, begun))
    name = " + ".join(candidate.label for candidate in fit.added) or DECLARED
    return CompetingModel(name, fit.problem, values, criterion, weight, tuple(added))
