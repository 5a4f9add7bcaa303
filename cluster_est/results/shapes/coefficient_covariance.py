"""The covariance of an effect's coefficients, from that of what was estimated."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.results.result import Result
from cluster_est.results.tables.row_types import Estimate
from workers.messages import FloatArray


def covariance_of(result: Result, coefficients: Sequence[Estimate]) -> FloatArray:
    """(coefficients, coefficients): those that are held do not vary.

    Those that follow from other parameters of the effect vary with these.
    """
    if any(e.estimated_on == "derived" for e in coefficients):
        begin = f"{coefficients[0].label.rpartition('.')[0]}."
        own = [e for e in result.estimates if e.label.startswith(begin)]
        free = [e for e in own if e.estimated_on != "derived" and e.label == e.parameter]
        slopes = _derivatives(result, coefficients, free)
        return np.asarray(slopes @ covariance_of(result, free) @ slopes.T)
    labels = [e.label for e in coefficients]
    known = result.uncertainty
    shared = () if known is None else known.shared
    errors = np.array([0.0 if e.estimated_on == "known" else e.std_error for e in coefficients])
    correlations = np.eye(len(labels))
    for i, one in enumerate(labels):
        for j, other in enumerate(labels[:i]):
            if known is not None and one in shared and other in shared:
                found = known.correlations[shared.index(one), shared.index(other)]
                correlations[i, j] = correlations[j, i] = found
    return np.asarray(correlations * errors * errors[:, None])


def _derivatives(
    result: Result, coefficients: Sequence[Estimate], free: Sequence[Estimate]
) -> FloatArray:
    """(coefficients, free): derivatives of coefficients by those that were not derived.

    The expressions that they follow are linear, so differences are exact.
    """
    problem, count = result.problem, len(free)
    values = {e.label: np.full(1 + count, e.value) for e in result.estimates}
    columns = {p.name: values.get(p.name, np.full(1 + count, p.start)) for p in problem.parameters}
    sizes = np.array([max(abs(e.value), 1.0) for e in free])
    for i, each in enumerate(free):
        columns[each.label][1 + i] += sizes[i]
    for i, formula in problem.derived:
        columns[problem.parameters[i].name] = formula.values(columns, 1 + count)
    found = np.array([columns[e.label] for e in coefficients])
    return np.asarray((found[:, 1:] - found[:, :1]) / sizes)
