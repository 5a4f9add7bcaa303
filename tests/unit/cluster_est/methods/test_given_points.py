"""A method that evaluates what it is given."""

import numpy as np
from support.problems.functions import Followed, FunctionProblem, followed

from cluster_est.methods.base import Ending
from cluster_est.methods.given_points import GivenPoints


def looked(*costs: float) -> Followed:
    points = np.arange(2.0 * len(costs)).reshape(-1, 2)
    by_place = FunctionProblem("", lambda x: np.sqrt([costs[int(x[0]) // 2]]), (0.0, 0.0), 0.0)
    found = followed(by_place, GivenPoints(points, "trial"))
    assert found.purposes == ["trial"]
    np.testing.assert_array_equal(found.points, points)
    evaluations = [each.cost for each in found.solution.evaluations]
    np.testing.assert_allclose(evaluations, costs)
    return found


def test_it_ends_at_the_best_point():
    solution = looked(9.0, np.nan, 1.0, 4.0).solution
    assert solution.x.tolist() == [4.0, 5.0]
    assert (solution.cost, solution.ending) == (1.0, Ending.CONVERGED)


def test_all_may_fail():
    solution = looked(np.nan, np.nan).solution
    assert solution.ending is Ending.START_FAILED
    assert "not finite" in solution.message
