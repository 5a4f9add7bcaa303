"""The result of a sensitivity analysis: tables, facts and notes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyarrow as pa

from cluster_est.errors import RunFolderError
from cluster_est.methods.method import Evaluation
from cluster_est.problem.costs import Cost
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.sensitivity.settings import SensitivitySettings
from cluster_est.statistics.records import make_records
from workers.fmu.description import nearest
from workers.messages import FloatArray, IntArray
from workers.messages.checks import check_text
from workers.messages.types import by_content

COST, LOG_COST = "cost", "log(cost)"


@dataclass(frozen=True)
class AnalysedQuantity:
    """A quantity with one value at each simulated point.

    Attributes
    ----------
    output
        "cost", "log(cost)", or the FMU's name of an output.
    experiment, time
        Experiment and time of an output; "" and NaN for the cost.
    """

    output: str
    experiment: str = ""
    time: float = np.nan


@dataclass(frozen=True)
class PointReader:
    """Extracts the quantities from evaluations.

    Attributes
    ----------
    quantities
        The quantities; the cost is the first.
    rows, sigmas : (outputs at times,)
        Rows of the outputs' residuals, and factors that convert them to the output's unit.
    """

    quantities: tuple[AnalysedQuantity, ...]
    rows: IntArray = field(repr=False)
    sigmas: FloatArray = field(repr=False)

    def values(self, evaluations: Sequence[Evaluation]) -> FloatArray:
        """Return the quantities of all points: (points, quantities); NaN if a simulation failed.

        For an output, it is the difference from the measured value. Indices do not depend on this
        constant.
        """
        found = np.full((len(evaluations), len(self.quantities)), np.nan)
        for row, at in zip(found, evaluations, strict=True):
            if at.ok:
                row[0] = at.cost
                row[1:] = at.residuals[self.rows] * self.sigmas
        return found


def reader_of(space: SearchSpace, times: int) -> PointReader:
    """Choose the quantities of a space: the cost, and every output at some times of its record.

    If residuals are not differences at measured times, as for curves and cost functions, only the
    cost is used.

    Parameters
    ----------
    space
        Search space of the experiments.
    times
        Number of times for each output in each experiment, spread evenly over its samples.
    """
    experiments = [space.problem.experiments[e] for e in space.experiments]
    records = make_records(experiments)
    quantities, rows, sigmas = [AnalysedQuantity(COST)], [], []
    if times and _residuals_are_outputs(space, records.size):
        for item in records.items:
            experiment = experiments[item.experiment]
            name = records.outputs[item.output]
            own = next(o.sigmas for o in experiment.outputs if o.variable == name)
            places = np.unique(np.linspace(0, len(item.times) - 1, times).astype(int))
            for place in places.tolist() if len(item.times) else []:
                time = float(item.times[place])
                quantities.append(AnalysedQuantity(name, experiment.id, time))
                rows.append(item.rows.start + place)
                sigmas.append(own[place])
    return PointReader(tuple(quantities), np.array(rows, int), np.array(sigmas, float))


def with_log_cost(
    quantities: Sequence[AnalysedQuantity], values: FloatArray, cost: Cost
) -> tuple[tuple[AnalysedQuantity, ...], FloatArray]:
    """Take the logarithm of the cost, if it is positive and not already a logarithm.

    Between wide bounds, a cost varies by orders of magnitude, and a few large values would dominate
    its variance.

    Parameters
    ----------
    quantities
        The quantities; the cost is the first.
    values : (points, quantities)
    cost
        Cost of the problem.
    """
    costs = values[:, 0]
    if cost.is_logarithm or not (costs > 0.0).all():
        return tuple(quantities), values
    changed = values.copy()
    changed[:, 0] = np.log(costs)
    return (replace(quantities[0], output=LOG_COST), *quantities[1:]), changed


def _residuals_are_outputs(space: SearchSpace, samples: int) -> bool:
    """Return whether each residual is the difference of an output at a measured time."""
    plain = all(
        space.problem.experiments[e].cost_function is None
        and space.problem.experiments[e].curve is None
        and all(output.is_plain for output in space.problem.experiments[e].outputs)
        for e in space.experiments
    )
    return plain and not space.reduced and space.rows[-1].stop == samples


MOST_NAMED_INFLUENCES = 5
"""Largest number of unknowns that a sentence names."""

UNSETTLED = 0.5
"""Half-width of an interval, over the largest index of the cost, above which it is wide."""


@dataclass(frozen=True)
class IndexRow:
    """One index of one unknown, a row of indices.parquet.

    `output` is "cost", "log(cost)" or the name of an output, which has an experiment and a time.
    `half_width` is half the width of the 95 % interval.
    """

    label: str
    index: str
    output: str
    experiment: str
    time: float
    value: float
    half_width: float


@dataclass(frozen=True)
class RankedUnknown:
    """One unknown, a row of ranking.parquet; rows are sorted by the influence on the cost.

    Attributes
    ----------
    label
        Label of the unknown, such as "k".
    value, half_width
        The index of the cost for the ranking, and half the width of its interval.
    size
        Root mean square of the sensitivities of the residuals at the start values, for a noticeable
        change, in sigmas.
    position
        Position in the order of estimation, counted from 0; -1 if derivatives are not known.
    collinearity
        Collinearity index with the unknowns before it in this order.
    together
        Whether it can be estimated together with the unknowns before it.
    """

    label: str
    value: float
    half_width: float
    size: float = np.nan
    position: int = -1
    collinearity: float = np.nan
    together: bool = True


@by_content
@dataclass(frozen=True)
class SensitivityResult:
    """The result of a sensitivity analysis.

    Attributes
    ----------
    problem, settings, seed
        Problem, settings and random seed of the analysis.
    ranks
        The index for the ranking, such as "mu* of log(cost)".
    ranking
        All unknowns, sorted by their influence on the cost.
    indices
        Indices of all quantities.
    groups, lost
        Number of simulated groups of points, and of those that are not used after a failure.
    evaluations, simulated, failures
        Numbers of evaluated points, simulations and failed simulations.
    seconds
        Duration of the analysis.
    why_no_order
        The reason why there is no order of estimation; "" if there is one.
    """

    problem: Problem = field(repr=False)
    settings: SensitivitySettings
    seed: int
    ranks: str
    ranking: tuple[RankedUnknown, ...]
    indices: tuple[IndexRow, ...] = field(repr=False)
    groups: int
    lost: int
    evaluations: int
    simulated: int
    failures: int
    seconds: float
    why_no_order: str = ""

    @property
    def tables(self) -> tuple[str, ...]:
        """Names of the tables, as in a run folder."""
        return ("ranking", "indices")

    def table(self, name: str) -> pa.Table:
        """Return one of `tables`.

        Raises
        ------
        RunFolderError
            If there is no such table.
        """
        check_text(name, "table", RunFolderError)
        rows: dict[str, Sequence[Any]] = {"ranking": self.ranking, "indices": self.indices}
        if name not in rows:
            raise RunFolderError(
                "table: must be one of the tables of this sensitivity analysis, but is "
                f"{name!r}{nearest(name, self.tables)}"
            )
        return pa.Table.from_pylist([dataclasses.asdict(row) for row in rows[name]])

    @property
    def search_seconds(self) -> float:
        """Duration of the simulations and of the computation of indices, in seconds."""
        return self.seconds

    def facts(self) -> Mapping[str, Any]:
        """Return the entries of run.json, except those that the run's folder adds."""
        return {
            "status": "done",
            "sensitivity": {
                "method": self.settings.method,
                "ranks": self.ranks,
                "groups": self.groups,
                "lost": self.lost,
                "together": [u.label for u in self.ranking if u.together and u.position >= 0],
            },
            "notes": list(self.notes),
            "evaluations": self.evaluations,
            "simulations": self.simulated,
            "failures": self.failures,
            "seconds": self.seconds,
        }

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on failures, on the accuracy of the ranking, and on joint estimation."""
        found = list(self.problem.notes())
        if self.lost:
            found.append(
                f"{self.lost} of {self.groups} groups of points are not used, because a simulation "
                "failed or the cost was not finite; the indices describe only that part of the "
                "parameter space that can be simulated"
            )
        if not self._largest:
            found.append("no parameter changes the cost within the bounds")
        wide = [u.label for u in self.ranking if u.half_width > UNSETTLED * self._largest]
        if wide:
            found.append(
                f"the confidence intervals for {_named(wide)} are wide compared with the largest "
                "index; increase sensitivity.groups before you rank these parameters"
            )
        if self._largest and not any(row.output not in (COST, LOG_COST) for row in self.indices):
            found.append("only the cost was analysed, not the outputs over time")
        if self.why_no_order:
            found.append(self.why_no_order)
        apart = [u for u in self.ranking if not u.together and np.isfinite(u.collinearity)]
        unseen = [u.label for u in self.ranking if u.collinearity == np.inf]
        if apart:
            labels = _named([u.label for u in apart])
            found.append(
                f"at the start values, the data cannot distinguish {labels} from the unknowns "
                f"before {'it' if len(apart) == 1 else 'them'} in the order of estimation "
                f"(collinearity index of {min(u.collinearity for u in apart):.3g} or more): fix "
                f"{'it' if len(apart) == 1 else 'them'} (fixed = true) if the value is known well "
                f"enough, or measure what distinguishes {'it' if len(apart) == 1 else 'them'}"
            )
        if unseen:
            found.append(
                f"at the start values, the residuals do not depend on {_named(unseen)}, or other "
                "unknowns fully compensate for the change"
            )
        return tuple(found)

    @property
    def _largest(self) -> float:
        values = [u.value for u in self.ranking if np.isfinite(u.value)]
        return max(values, default=0.0)


def _named(labels: Sequence[str]) -> str:
    """Return some labels, and the number of the others, as a text."""
    shown = ", ".join(labels[:MOST_NAMED_INFLUENCES])
    more = len(labels) - MOST_NAMED_INFLUENCES
    return f"{shown} and {more} more" if more > 0 else shown
