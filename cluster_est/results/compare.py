"""Comparison of models of the same measured values, by criteria and by held-out data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import ProblemError
from cluster_est.problem import display
from cluster_est.results.view import ResultView
from workers.messages.checks import check_kind

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class ComparedModel:
    """One model of a comparison.

    Attributes
    ----------
    model
        Name of the model.
    estimated
        Number of estimated values, including noise levels; see `InformationCriteria`.
    log_likelihood, aic, aicc, bic
        NaN for all models if one of them has no criteria.
    aic_difference, bic_difference
        Difference to the smallest value of all models.
    aic_weight
        Akaike weight: exp(-difference / 2), divided by the sum over all models (K. P. Burnham, D.
        R. Anderson, Model Selection and Multimodel Inference (2002), doi:10.1007/b97636).
    train, held_out
        Root mean square errors over sigma; `held_out` is NaN without held-out experiments.
    """

    model: str
    estimated: int
    log_likelihood: float
    aic: float
    aic_difference: float
    aic_weight: float
    aicc: float
    bic: float
    bic_difference: float
    train: float
    held_out: float


@dataclass(frozen=True, repr=False)
class Comparison:
    """Models of the same measured values, the best first.

    Attributes
    ----------
    models
        Sorted by AIC, or by the held-out error if there are no criteria.
    notes
        Sentences on the limits of the comparison.
    """

    models: tuple[ComparedModel, ...]
    notes: tuple[str, ...] = ()

    @property
    def best(self) -> str:
        """The name of the best model."""
        return self.models[0].model

    def to_frame(self) -> pd.DataFrame:
        """Return the models as a pandas DataFrame; pandas must be installed."""
        return display.as_frame(pa.Table.from_pylist([vars(each) for each in self.models]))

    @property
    def _shown(self) -> display.DisplayTable:
        numbers = ("AIC", "difference", "weight", "BIC", "difference")
        rows = [
            (
                each.model, str(each.estimated), each.aic, each.aic_difference, each.aic_weight,
                each.bic, each.bic_difference, each.train, each.held_out,
            )
            for each in self.models
        ]  # fmt: skip
        head = ("model", "estimated", *numbers, "training error", "held out")
        return display.DisplayTable("Models", head, rows)

    def __repr__(self) -> str:
        lines = [display.plain("", self._shown).strip("\n")]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def _repr_html_(self) -> str:
        return display.section("", self._shown)


def compare(results: Mapping[str, ResultView] | ResultView, *others: ResultView) -> Comparison:
    """Compare models that were fitted to the same training experiments.

    Criteria use the data to which the models were fitted, and assume white noise. An error on
    held-out data needs no such assumption. A difference of AIC below 2 is not significant.

    Parameters
    ----------
    results
        Results of `fit`, `close_loop` or `load` by name: {"linear": a, "friction": b}. Or the first
        of several results, which are then called "1", "2", ...
    others
        The other results, if `results` is a single result.

    Raises
    ------
    ProblemError
        If there are fewer than two results, an argument is not a result, or the results have
        different measured values.
    """
    if not isinstance(results, Mapping):
        results = {str(i): each for i, each in enumerate((results, *others), start=1)}
    elif others:
        raise ProblemError("compare: give either one dict of results or several results, not both")
    for name, each in results.items():
        check_kind(each, ResultView, f"compare: {name}", ProblemError, "; fit first")
    if len(results) < 2:
        raise ProblemError(f"compare: needs at least two results, but is given {len(results)}")
    found = {name: each.criteria for name, each in results.items()}
    missing = {name: each.why_not for name, each in found.items() if each.why_not}
    if not missing and len({each.data for each in found.values()}) > 1:
        raise ProblemError(
            "compare: the fits must have the same measured values, but their training experiments "
            "differ; fit all models to the same data"
        )
    notes = [
        f"AIC and BIC are not compared, because of {name}: {reason}"
        for name, reason in missing.items()
    ]
    aic = np.array([math.nan if missing else each.aic for each in found.values()])
    bic = np.array([math.nan if missing else each.bic for each in found.values()])
    weights = np.exp(-0.5 * (aic - aic.min()))
    weights = weights / weights.sum()
    rows = []
    for i, (name, own) in enumerate(found.items()):
        facts = results[name].facts()
        error = {k: _number(v) for k, v in (facts.get("rmse_over_sigma") or {}).items()}
        if (facts.get("residuals") or {}).get("too_narrow"):
            notes.append(
                f"{name}: the residuals are not white noise, so AIC and BIC overestimate the "
                "information in the data"
            )
        rows.append(
            ComparedModel(
                name, own.estimated, math.nan if missing else own.log_likelihood,
                float(aic[i]), float(aic[i] - aic.min()), float(weights[i]),
                math.nan if missing else own.aicc, float(bic[i]), float(bic[i] - bic.min()),
                error.get("train", math.nan), error.get("test", math.nan),
            )
        )  # fmt: skip
    return Comparison(tuple(sorted(rows, key=_rank)), tuple(notes))


def _rank(model: ComparedModel) -> float:
    return model.held_out if math.isnan(model.aic) else model.aic


def _number(value: Any) -> float:
    return math.nan if value is None else float(value)
