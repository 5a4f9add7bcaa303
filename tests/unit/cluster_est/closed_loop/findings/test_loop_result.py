"""The result of a closed loop, as figures."""

import math

import pytest
from support.loop_objects import made_result
from support.problems.springs import spring_problem

from cluster_est import LoopResult
from cluster_est.closed_loop.findings.effects import ErrorChange, Verdict


def result(*errors: ErrorChange) -> LoopResult:
    """A loop that ended with these errors."""
    fitted = made_result(spring_problem(experiments=1, samples=20).problem, ())
    return LoopResult(
        Verdict.PARTIAL, "", (), fitted, fitted, errors, (), (), {}, (), (), 0.0, 0, 0, 0, 0.0
    )


def change(experiment: str, before: float, after: float, samples: int = 100) -> ErrorChange:
    return ErrorChange(experiment, "train", "y", "m", samples, before, after, before, after)


def of_output(*errors: ErrorChange) -> dict[str, float]:
    return dict(result(*errors).facts()["errors_by_output"]["y"]["train"])


def test_errors_before_and_after_are_of_the_same_experiments() -> None:
    lost, won = change("lost", 9.0, math.nan), change("won", math.nan, 5.0)
    found = result(change("both", 3.0, 1.0), lost, won)
    assert found.rms("train", "before") == 3.0
    assert found.rms("train", "after") == 1.0


def test_an_experiment_without_samples_hides_no_error() -> None:
    empty = change("b", math.nan, math.nan, samples=0)
    assert of_output(change("a", 2.0, 1.0), empty) == {"before": 2.0, "after": 1.0}
    assert math.isnan(of_output(empty)["after"])


def test_an_output_has_no_error_where_an_experiment_fails() -> None:
    found = of_output(change("a", 2.0, 1.0), change("b", 2.0, math.nan))
    assert found["before"] == pytest.approx(2.0)
    assert math.isnan(found["after"])
