"""The result of a closed loop, as figures."""

from __future__ import annotations

import math

from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import ErrorChange, Verdict
from cluster_est.closed_loop.findings.result import LoopResult


def change(experiment: str, before: float, after: float) -> ErrorChange:
    return ErrorChange(experiment, "train", "y", "m", 100, before, after, before, after)


def test_errors_before_and_after_are_of_the_same_experiments() -> None:
    fitted = ce.fit(spring_problem(experiments=1, samples=20).problem)
    errors = (change("both", 3.0, 1.0), change("lost", 9.0, math.nan), change("won", math.nan, 5.0))
    found = LoopResult(
        Verdict.PARTIAL, "", (), fitted, fitted, errors, (), (), {}, (), (), 0.0, 0, 0, 0, 0.0
    )
    assert found.rms("train", "before") == 3.0
    assert found.rms("train", "after") == 1.0
