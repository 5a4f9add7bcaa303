"""How much of a step is done, and how long the rest takes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.problems.springs import spring_problem

from cluster_est.methods.base import Ending, Method, Points, Progress, Solution
from cluster_est.methods.given_points import GivenPoints
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.space import make_space
from cluster_est.running.run_display import share_done, time_left
from cluster_est.running.search_state import SearchRequest, SearchState


def state(method: Method, iteration: int = 0) -> SearchState:
    space = make_space(spring_problem(experiments=1).problem, (0,))
    made = SearchState(SearchRequest("one", method, space), iter(()))
    made.progress = Progress(iteration, math.nan)
    return made


def test_iterations_tell_where_they_are_few() -> None:
    few, many = LeastSquares(max_iterations=10), LeastSquares(max_iterations=100)
    ended = state(many)
    ended.solution = Solution(np.zeros(1), 0.0, Ending.CONVERGED)
    assert share_done([state(few, 3), state(few, 5), ended]) == pytest.approx(0.6)
    assert math.isnan(share_done([state(few, 3), state(many, 50)]))
    assert math.isnan(share_done([]))


def test_given_points_tell_how_many_are_evaluated() -> None:
    made = state(GivenPoints(np.zeros((4, 1)), "look"))
    assert share_done([made]) == 0.0
    made.expect(Points(np.zeros((4, 1)), "look"))
    del made.pending[2]
    assert share_done([made]) == 0.25


def test_the_time_left() -> None:
    assert time_left(0.25, 10.0) == pytest.approx(30.0)
    assert time_left(1.0, 10.0) == 0.0
    assert math.isnan(time_left(0.0, 10.0))
    assert math.isnan(time_left(math.nan, 10.0))
