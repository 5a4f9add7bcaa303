"""The result of a sensitivity analysis: its tables, its facts, and what to know of them."""

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
    """One number of each simulated point.

    Attributes
    ----------
    output
        "cost" or "log(cost)", or the FMU's name of an output.
    experiment, time
        Of an output; "" and NaN for the cost.
    """

    output: str
    experiment: str = ""
    time: float = np.nan


@dataclass(frozen=True)
class PointReader:
    """Reads the quantities from evaluations.

    Attributes
    ----------
    quantities
        The cost first.
    rows, sigmas : (outputs at times,)
        Where their residuals stand, and what they are multiplied by to be in the output's unit.
    """

    quantities: tuple[AnalysedQuantity, ...]
    rows: IntArray = field(repr=False)
    sigmas: FloatArray = field(repr=False)

    def values(self, evaluations: Sequence[Evaluation]) -> FloatArray:
        """(points, quantities): NaN where a simulation failed.

        Of an output it is the difference to what was measured: that differs from the output by a
        constant, which no index sees.
        """
        found = np.full((len(evaluations), len(self.quantities)), np.nan)
        for row, at in zip(found, evaluations, strict=True):
            if at.ok:
                row[0] = at.cost
                row[1:] = at.residuals[self.rows] * self.sigmas
        return found


def reader_of(space: SearchSpace, times: int) -> PointReader:
    """Choose the quantities of a space: the cost, and every output at some times of its record.

    Where residuals are not differences at the measured times, as of curves and cost functions,
    only the cost is read.

    Parameters
    ----------
    space
        Of the experiments.
    times
        Of each output in each experiment, spread evenly over its samples.
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
    """Take the logarithm of the cost, where it is positive and no logarithm itself.

    Between wide bounds a cost varies by orders of magnitude, and its own variance is that of its
    few largest values.

    Parameters
    ----------
    quantities
        The cost first.
    values : (points, quantities)
    cost
        Of the problem.
    """
    costs = values[:, 0]
    if cost.is_logarithm or not (costs > 0.0).all():
        return tuple(quantities), values
    changed = values.copy()
    changed[:, 0] = np.log(costs)
    return (replace(quantities[0], output=LOG_COST), *quantities[1:]), changed


def _residuals_are_outputs(space: SearchSpace, samples: int) -> bool:
    """Return whether each residual is an output's difference at one of its measured times."""
    plain = all(
        space.problem.experiments[e].cost_function is None
        and space.problem.experiments[e].curve is None
        and all(output.is_plain for output in space.problem.experiments[e].outputs)
        for e in space.experiments
    )
    return plain and not space.reduced and space.rows[-1].stop == samples


MOST_NAMED_INFLUENCES = 5
"""Unknowns that a sentence names."""

UNSETTLED = 0.5
"""Part of the largest index of the cost that is a wide interval."""


@dataclass(frozen=True)
class IndexRow:
    """One index of one unknown, a row of indices.parquet.

    `output` is "cost", "log(cost)" or an output's name, with the experiment and the time that the
    index is of; `half_width` is that of its 95 % interval.
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
    """One unknown, a row of ranking.parquet; the one that moves the cost the most is first.

    Attributes
    ----------
    label
        Such as "k".
    value, half_width
        The index of the cost that ranks it.
    size
        Root mean square of the sensitivities of the residuals at the start values, for a noticeable
        change, in sigmas.
    position
        Its place in the order in which unknowns are best estimated, from 0; -1 where no
        derivatives were had.
    collinearity
        With those before it in that order.
    together
        Whether it may be estimated together with those before it.
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
    """What a sensitivity analysis has found.

    Attributes
    ----------
    problem, settings, seed
        What was analysed, and how.
    ranks
        What unknowns are ranked by, such as "mu* of log(cost)".
    ranking
        All unknowns, the one that moves the cost the most first.
    indices
        Of all quantities.
    groups, lost
        Of points that were simulated, and how many of them a failure has taken away.
    evaluations, simulated, failures
        Of points, simulations and those that failed.
    seconds
        From start to end.
    why_no_order
        Why there is no order of estimation; "" with an order.
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
        """Names of its tables, those of a run folder's files."""
        return ("ranking", "indices")

    def table(self, name: str) -> pa.Table:
        """One of `tables`.

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
        """Seconds that its simulations took, with what was computed from them."""
        return self.seconds

    def facts(self) -> Mapping[str, Any]:
        """Return what run.json says of it, besides what the run's folder knows itself."""
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
        """Sentences on failures, on how settled the ranking is, and on what goes together."""
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
    """Some labels, and how many more there are."""
    shown = ", ".join(labels[:MOST_NAMED_INFLUENCES])
    more = len(labels) - MOST_NAMED_INFLUENCES
    return f"{shown} and {more} more" if more > 0 else shown
