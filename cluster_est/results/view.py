"""The interface of results in Python, for results in memory and in a run folder.

Everything is computed from tables and facts, so the results of a fit, of a closed loop and of
`ce.load` have the same interface.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from cluster_est.problem import display
from cluster_est.results.criteria import InformationCriteria
from cluster_est.results.fit_tables import Estimate
from workers.fmu.description import nearest
from workers.messages import FloatArray
from workers.messages.types import by_content

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

MOST_VALUES_IN_REPR = 6
"""Largest number of estimates in the short text of a result."""


@by_content
@dataclass(frozen=True, repr=False)
class NamedMatrix:
    """A symmetric matrix whose rows and columns have names.

    `matrix["R", "L"]` is one entry, and `numpy.asarray(matrix)` is the whole matrix.

    Attributes
    ----------
    names
        Names of the rows and columns.
    values : (names, names)
    """

    names: tuple[str, ...]
    values: FloatArray = field(repr=False)

    def __getitem__(self, pair: tuple[str, str]) -> float:
        for name in pair:
            if name not in self.names:
                raise KeyError(f"there is no {name!r}{nearest(name, self.names)}")
        row, column = (self.names.index(name) for name in pair)
        return float(self.values[row, column])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.array(self.values, dtype=dtype)

    def to_frame(self) -> pd.DataFrame:
        """Return the matrix as a pandas DataFrame; pandas must be installed."""
        frame = display.as_frame(pa.table(dict(zip(self.names, self.values.T, strict=True))))
        return frame.set_axis(list(self.names), axis="index")

    @property
    def _shown(self) -> display.DisplayTable:
        rows = [(name, *row) for name, row in zip(self.names, self.values.tolist(), strict=True)]
        return display.DisplayTable("", ("", *self.names), rows)

    def __repr__(self) -> str:
        return display.plain("", self._shown).strip("\n")

    def _repr_html_(self) -> str:
        return display.section("", self._shown)


class ResultView(ABC):
    """A result with estimates by name, matrices, criteria, DataFrames, texts and plots."""

    @property
    @abstractmethod
    def tables(self) -> tuple[str, ...]:
        """Names of the tables, as in a run folder."""

    @abstractmethod
    def table(self, name: str) -> pa.Table:
        """Return one of `tables` as an Arrow table, with the columns as in a run folder.

        Raises
        ------
        RunFolderError
            If there is no such table.
        """

    @abstractmethod
    def facts(self) -> Mapping[str, Any]:
        """Return the entries of run.json on the result."""

    @property
    @abstractmethod
    def criteria(self) -> InformationCriteria:
        """Likelihood, AIC, AICc and BIC of the training data, or the reason why there are none."""

    @cached_property
    def params(self) -> Mapping[str, Estimate]:
        """All parameters by label: `params["R"].value`, `.stderr`, `.interval`, `.unit`.

        A parameter with one value per experiment has labels such as "x0[exp5]".
        """
        known = [each.name for each in fields(Estimate)]
        rows = self.table("parameters").to_pylist()
        found = {row["label"]: Estimate(**{k: row[k] for k in known if k in row}) for row in rows}
        return _Named(found)

    @cached_property
    def correlation(self) -> NamedMatrix:
        """Correlations of the estimates from training data.

        They are NaN if the data do not determine one of the two values. Those between values of
        single experiments ("x0[a]", "x0[b]") are also NaN, because they are not computed.
        """
        labels = [e.label for e in self.params.values() if e.estimated_on == "train"]
        place = {label: i for i, label in enumerate(labels)}
        matrix = np.full((len(labels), len(labels)), np.nan)
        for i, label in enumerate(labels):
            matrix[i, i] = 1.0 if np.isfinite(self.params[label].std_error) else np.nan
        if "correlations" in self.tables:
            for row in self.table("correlations").to_pylist():
                i, j = place[row["label"]], place[row["other"]]
                matrix[i, j] = matrix[j, i] = row["correlation"]
        return NamedMatrix(tuple(labels), matrix)

    @cached_property
    def covariance(self) -> NamedMatrix:
        """Covariance of the estimates, in their units: standard errors times `correlation`."""
        known = self.correlation
        errors = np.array([self.params[name].std_error for name in known.names], np.float64)
        return NamedMatrix(known.names, known.values * np.outer(errors, errors))

    @property
    def aic(self) -> float:
        """Akaike's criterion; NaN if `criteria.why_not` gives a reason."""
        return self.criteria.aic

    @property
    def aicc(self) -> float:
        """Akaike's criterion, corrected for few measured values."""
        return self.criteria.aicc

    @property
    def bic(self) -> float:
        """Schwarz's criterion."""
        return self.criteria.bic

    def to_frame(self, table: str = "parameters") -> pd.DataFrame:
        """Return one of `tables` as a pandas DataFrame; pandas must be installed."""
        return display.as_frame(self.table(table))

    def plot(
        self, experiment: str | None = None, output: str | None = None, *, ax: Axes | None = None
    ) -> Axes:
        """Draw the measured and simulated values of one output of one experiment.

        Parameters
        ----------
        experiment, output
            Their names; by default those with the largest error over sigma.
        ax
            Axes of matplotlib; new ones if None.

        Returns
        -------
        Axes
            The axes of the plot.

        Raises
        ------
        ProblemError
            If matplotlib is not installed, or there is no such experiment or output.
        """
        from cluster_est.results.plots import plot_curves

        return plot_curves(self, experiment, output, ax)

    def plot_residuals(
        self, experiment: str | None = None, output: str | None = None, *, ax: Axes | None = None
    ) -> Axes:
        """Draw (measured - simulated) / sigma over time; for the arguments, see `plot`."""
        from cluster_est.results.plots import plot_residuals

        return plot_residuals(self, experiment, output, ax)

    def plot_correlation(self, *, ax: Axes | None = None) -> Axes:
        """Draw `correlation` as coloured squares."""
        from cluster_est.results.plots import plot_correlation

        return plot_correlation(self, ax)

    def plot_profile(self, label: str, *, ax: Axes | None = None) -> Axes:
        """Draw the likelihood profile of a parameter, if the fit computed it.

        The plot shows the signed square root of the cost's rise in standard deviations. It is a
        straight line for a model that is linear in the parameter.
        """
        from cluster_est.results.plots import plot_profile

        return plot_profile(self, label, ax)

    def summary(self) -> str:
        """Return the text of `print`: the ending, estimates, errors, criteria and notes."""
        facts = self.facts()
        lines = [display.plain(_title(facts), *self._displayed(facts)), "", self._criteria_line]
        return "\n".join([*lines, *(f"note: {note}" for note in facts.get("notes") or ())])

    def __str__(self) -> str:
        return self.summary()

    def _repr_html_(self) -> str:
        facts = self.facts()
        return display.section(_title(facts), *self._displayed(facts))

    @property
    def _criteria_line(self) -> str:
        found = self.criteria
        if found.why_not:
            return f"AIC and BIC are not known: {found.why_not}"
        return (
            f"AIC {found.aic:.6g}, AICc {found.aicc:.6g}, BIC {found.bic:.6g} "
            f"({found.observations} values, {found.estimated} estimated)"
        )

    def _displayed(self, facts: Mapping[str, Any]) -> tuple[display.DisplayTable, ...]:
        narrow = bool((facts.get("residuals") or {}).get("too_narrow"))
        effects = [
            (e["name"], e["words"] or e["family"], e["equation"], _how_sure(e))
            for e in facts.get("effects") or ()
        ]
        return (
            display.DisplayTable("Effects", ("name", "words", "equation", "probability"), effects),
            _parameters(tuple(self.params.values()), too_narrow=narrow),
            _errors(self.table("errors").to_pylist()),
        )


def _how_sure(effect: Mapping[str, Any]) -> str:
    """Return the probability that an effect is right; "" if it is not known."""
    known = effect.get("claim")
    return display.percent(known["probability"]) if known else ""


class _Named(Mapping[str, Estimate]):
    """Estimates by label, displayed as a table; the error for a wrong label names the nearest."""

    def __init__(self, found: Mapping[str, Estimate]) -> None:
        self._found = dict(found)

    def __getitem__(self, label: str) -> Estimate:
        if label not in self._found:
            raise KeyError(f"there is no parameter {label!r}{nearest(str(label), self._found)}")
        return self._found[label]

    def __iter__(self) -> Any:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)

    def __repr__(self) -> str:
        return display.plain("", _parameters(tuple(self._found.values()))).strip("\n")

    def _repr_html_(self) -> str:
        return display.section("", _parameters(tuple(self._found.values())))


def _title(facts: Mapping[str, Any]) -> str:
    if facts.get("verdict"):
        return f"Search for missing effects: {facts['verdict']}. {facts['summary']}"
    before, after = (np.nan if facts.get(k) is None else facts[k] for k in ("cost_before", "cost"))
    return f"Fit: {facts.get('message', '')}; cost {before:.6g} before, {after:.6g} after"


def _parameters(estimates: Sequence[Estimate], *, too_narrow: bool = False) -> display.DisplayTable:
    """Return a table of estimates, with a remark if the intervals are too narrow."""
    ends = ("95 % from", "to (too narrow)" if too_narrow else "to")
    rows = [
        (e.label, e.value, e.unit, e.std_error, *e.interval, e.at_bound, e.description)
        for e in estimates
    ]
    head = ("parameter", "value", "unit", "standard error", *ends, "at bound", "description")
    return display.DisplayTable("Parameters", head, rows)


def _errors(rows: Sequence[Mapping[str, Any]]) -> display.DisplayTable:
    head = ("experiment", "role", "output", "before", "after", "unit")
    keys = ("experiment", "role", "output", "rmse_before", "rmse_after", "unit")
    known = [tuple(row[key] for key in keys) for row in rows]
    return display.DisplayTable("Root mean square errors", head, known)


def short_text(kind: str, first: str, values: Mapping[str, float]) -> str:
    """Return a short text of a result: its kind, its ending, and a few values."""
    shown = [f"{name}={value:.6g}" for name, value in list(values.items())[:MOST_VALUES_IN_REPR]]
    more = len(values) - MOST_VALUES_IN_REPR
    return f"{kind}({', '.join([first, *shown, *([f'{more} more'] if more > 0 else [])])})"
