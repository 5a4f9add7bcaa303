"""The numbers of a simulated point that indices are computed of: its cost, outputs at times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.costs.base import Cost
from cluster_est.methods.base import Evaluation
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.statistics.records import make_records
from workers.messages import FloatArray, IntArray

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
