"""A method that evaluates what it is given."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.methods.base import Ending, Evaluation
from cluster_est.methods.given_points import GivenPoints
from workers.messages import Outcome, Status


def evaluation(cost):
    if np.isnan(cost):
        return Evaluation((Outcome(0, Status.NOT_FINITE, message="at 3 s"),), cost)
    return Evaluation((Outcome(0, Status.OK, np.array([cost])),), cost)


def looked(*costs):
    points = np.arange(2.0 * len(costs)).reshape(-1, 2)
    look = GivenPoints(points, "trial")
    steps = look.search(None, np.random.default_rng(0))
    asked = next(steps)
    assert asked.x is points
    assert asked.purpose == "trial"
    answers = [evaluation(cost) for cost in costs]
    with pytest.raises(StopIteration) as end:
        steps.send(answers)
    assert look.seen == answers
    return end.value.value


def test_it_ends_at_the_best_point():
    found = looked(3.0, np.nan, 1.0, 2.0)
    assert found.x.tolist() == [4.0, 5.0]
    assert (found.cost, found.ending) == (1.0, Ending.CONVERGED)


def test_all_may_fail():
    found = looked(np.nan, np.nan)
    assert found.ending is Ending.START_FAILED
    assert "at 3 s" in found.message
