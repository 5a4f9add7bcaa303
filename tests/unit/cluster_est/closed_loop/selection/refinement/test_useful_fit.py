"""What a refit must come down to, and whether the linear model lets it hope."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import fit_with_squares, made_bench, made_fit, made_problem

from cluster_est.closed_loop.selection.refinement.useful_fit import (
    UsefulFit,
    may_become_useful,
    may_start_useful,
    shares_left,
)
from cluster_est.closed_loop.thresholds import RefinementThresholds

SIZE, TOTAL = 40, 200.0
TIMES = RefinementThresholds().claim_promise
RIVAL = RefinementThresholds().rival_promise
PROBLEM = made_problem(SIZE)


def start(left, useful, added=1, problem=PROBLEM):
    fitted = fit_with_squares(problem, TOTAL)
    return may_start_useful(made_bench(problem), fitted, np.asarray(left), added, useful)


@pytest.mark.parametrize(("most", "hopes"), [(0.79, False), (0.81, True)])
def test_some_times_of_what_the_linear_model_promises_may_come(most, hopes):
    """It leaves nine tenths, so with twice its fall eight tenths may be left."""
    assert TIMES == 2.0
    assert start([0.9], UsefulFit(sse=most * TOTAL)) is hopes


@pytest.mark.parametrize("added", [1, 3])
@pytest.mark.parametrize(("beyond", "hopes"), [(-0.1, False), (0.1, True)])
def test_a_criterion_counts_the_new_unknowns(added, beyond, hopes):
    reached = SIZE * np.log((1.0 - 0.1 * RIVAL) * TOTAL / SIZE) + (1 + added) * np.log(SIZE)
    assert start([0.9], UsefulFit(criterion=reached + beyond), added) is hopes


def test_what_may_explain_all_always_hopes():
    assert start([0.3], UsefulFit(criterion=-1000.0, sse=1e-9))


def test_each_output_falls_by_its_own_share():
    """An output that gets worse takes nothing from the one that gets better."""
    two = made_problem(SIZE, outputs=2)
    left = 0.5 * TOTAL * (1.0 + TIMES * 0.1) + 0.5 * TOTAL * (1.0 - TIMES * 0.3)
    assert start([1.1, 0.7], UsefulFit(sse=1.001 * left), problem=two)
    assert not start([1.1, 0.7], UsefulFit(sse=0.999 * left), problem=two)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_fit_that_has_begun_is_judged_by_its_next_step(scale):
    """A third of the residual lies along an unknown: the next step takes that, and no more."""
    direction = np.zeros(SIZE)
    direction[0] = 1.0
    rest = np.zeros(SIZE)
    rest[1:] = np.sqrt(2.0 / (SIZE - 1))
    fitted = made_fit(PROBLEM, scale * (direction + rest))
    fitted = replace(fitted, jacobian=7.0 * scale * direction[:, None])
    bench = made_bench(PROBLEM)
    times = bench.thresholds.refinement.linear_promise
    fall = SIZE * np.log(3.0 / 2.0)
    here = fitted.criterion(bench.records)
    for beyond, hopes in ((-0.1, False), (0.1, True)):
        useful = UsefulFit(criterion=here - times * fall + beyond)
        assert may_become_useful(bench, fitted, useful) is hopes


def test_shares_are_those_of_each_output():
    two = made_problem(3, outputs=2)
    records = made_bench(two).records
    before = np.array([1.0, 2.0, 2.0, 4.0, 0.0, 3.0])
    after = np.array([1.0, 1.0, 1.0, 0.0, 3.0, 0.0])
    assert shares_left(records, before, after) == pytest.approx([3.0 / 9.0, 9.0 / 25.0])
    assert shares_left(records, 0.0 * before, after) == pytest.approx([1.0, 1.0])
