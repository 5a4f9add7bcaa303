"""How much of a step is done, and how long the rest takes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import spring_problem

from cluster_est.methods.base import Ending, Method, Points, Progress, Solution
from cluster_est.methods.given_points import GivenPoints
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.methods.populations.differential_evolution import DifferentialEvolution
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.budget_watch import BudgetWatch
from cluster_est.running.records import Budget
from cluster_est.running.search_state import SearchRequest, SearchState
from cluster_est.running.time_left import (
    WorkDone,
    evaluations_left,
    left_of_budget,
    share_done,
    time_left,
)


def state(method: Method, iteration: int = 0) -> SearchState:
    space = make_space(spring_problem(experiments=1).problem, (0,))
    made = SearchState(SearchRequest("one", method, space), iter(()))
    made.progress = Progress(iteration, math.nan)
    return made


def of_length(asked: int, *, ended: bool) -> SearchState:
    made = state(LeastSquares())
    made.asked = asked
    if ended:
        made.solution = Solution(np.zeros(1), 0.0, Ending.CONVERGED)
    return made


def test_iterations_tell_where_they_are_few() -> None:
    few, many = LeastSquares(max_iterations=10), LeastSquares(max_iterations=100)
    ended = state(many)
    ended.solution = Solution(np.zeros(1), 0.0, Ending.CONVERGED)
    assert share_done([state(few, 3), state(few, 5), ended]) == pytest.approx(0.6)
    assert math.isnan(share_done([state(few, 3), state(many, 50)]))
    assert math.isnan(share_done([]))


def test_generations_count_as_far_as_their_points_are_evaluated() -> None:
    made = state(DifferentialEvolution(max_generations=5), 2)
    made.expect(Points(np.zeros((4, 1)), "generation"))
    assert share_done([made]) == pytest.approx(2 / 5)
    del made.pending[0], made.pending[3]
    assert share_done([made]) == pytest.approx(2.5 / 5)
    assert math.isnan(share_done([state(DifferentialEvolution(), 2)]))


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


def test_points_that_are_asked_for_are_not_done() -> None:
    # 16 of 40 simulations in 90 s, and 4 workers half way in others: 18 in all, 5 s each
    work = WorkDone(90.0, simulations=16, under_way=24, busy=4, evaluations=20, requests=5)
    assert work.seconds_for(0.0) == pytest.approx(5.0 * 22.0)
    # two simulations a point; the last request goes beyond the budget by half of its four points
    assert left_of_budget(work, 10) == pytest.approx(5.0 * (22.0 + 2.0 * (10.0 + 2.0)))
    assert left_of_budget(work, 0) == pytest.approx(5.0 * 22.0)
    assert left_of_budget(work, None) == math.inf
    assert math.isnan(left_of_budget(replace(work, simulations=0, busy=0), 10))


def test_the_sooner_limit_of_a_budget_counts() -> None:
    now = [0.0]
    budget = BudgetWatch(Budget(evaluations=30, seconds=400.0), lambda: now[0])
    work = WorkDone(90.0, simulations=16, under_way=24, busy=4, evaluations=20, requests=5)
    budget.evaluations, now[0] = 20, 90.0
    assert budget.left(work) == pytest.approx(230.0)  # 18 simulations in 90 s; 46 are left
    now[0] = 300.0
    assert budget.left(work) == pytest.approx(100.0)
    assert budget.left(replace(work, simulations=0)) == pytest.approx(100.0)
    assert BudgetWatch(Budget()).left(work) == math.inf


def test_searches_that_have_ended_tell_the_lengths_of_the_others() -> None:
    ended = [of_length(asked, ended=True) for asked in (10, 20, 30)]
    # survival by Kaplan and Meier: 3/4 after 10, 3/8 after 20, none after 30
    begun, waiting = of_length(15, ended=False), of_length(0, ended=False)
    assert evaluations_left([*ended, begun]) == pytest.approx((5.0 + 15.0) / 2.0)
    mean = 0.25 * 10.0 + 0.375 * 20.0 + 0.375 * 30.0
    assert evaluations_left([*ended, begun, waiting, waiting]) == pytest.approx(10.0 + 2.0 * mean)
    assert evaluations_left([*ended, of_length(50, ended=False)]) == 0.0


def test_few_searches_that_have_ended_tell_nothing() -> None:
    two = [of_length(asked, ended=True) for asked in (10, 20)]
    assert math.isnan(evaluations_left([*two, of_length(5, ended=False)]))
    three = [*two, of_length(15, ended=True)]
    assert math.isnan(evaluations_left([*three, *[of_length(0, ended=False)] * 60]))
