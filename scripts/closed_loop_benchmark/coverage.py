"""How many intervals of coefficients hold the truth, after the choice among all candidates."""

from __future__ import annotations

import math
from collections.abc import Iterator

from closed_loop_benchmark.data import Data
from closed_loop_benchmark.naming import normal
from closed_loop_benchmark.oracle import translate
from cluster_est.closed_loop.findings.effects import NamedEffect
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.results.fit_tables import Estimate


def coverage(data: Data, result: LoopResult) -> tuple[int, int]:
    """Count the 95 % intervals that hold the truth, and all that there are.

    Of effects that were named as they are called. Left out are variations of parameters, whose
    strength hangs on the value that the parameter has where they do nothing, and coefficients
    without an interval: held ones, and those at a bound.
    """
    held = [low <= true <= high for true, low, high in _intervals(data, result)]
    return sum(held), len(held)


def _intervals(data: Data, result: LoopResult) -> Iterator[tuple[float, float, float]]:
    for number, effect in enumerate(data.scenario.effects):
        if effect.kind == "parameter":
            continue
        try:
            added, values = translate(effect, number)
        except KeyError:  # the library has no such form
            continue
        called = normal(added.form, added.site, added.variables)
        for named in result.effects:
            if normal(named.form, named.site, named.variables) == called:
                yield from _of_one(named, values)


def _of_one(named: NamedEffect, values: dict[str, float]) -> Iterator[tuple[float, float, float]]:
    for estimate in named.coefficients:
        low, high = _bounds(estimate)
        name = estimate.label.rpartition(".")[2]
        if name in values and math.isfinite(low) and math.isfinite(high) and low < high:
            yield values[name], low, high


def _bounds(estimate: Estimate) -> tuple[float, float]:
    return (math.nan, math.nan) if estimate.at_bound else (estimate.lower95, estimate.upper95)
