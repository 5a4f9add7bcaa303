"""Broyden's updates of a Jacobian, and fits that use them."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.methods.base import Evaluation, Progress
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.derivatives.differences import ResidualJacobian
from cluster_est.methods.least_squares.iteration import IterationState
from cluster_est.methods.least_squares.secant_update import secant_update
from workers.messages import Outcome, Status


def state(x, parts, largest):
    outcomes = tuple(Outcome(i, Status.OK, part) for i, part in enumerate(parts))
    return IterationState(x, Evaluation(outcomes, 1.0), Progress(0, 1.0), largest, 1e-3)


@pytest.fixture
def case():
    """Two experiments; the last unknown acts on the second one alone."""
    generator = np.random.default_rng(0)
    blocks = (generator.normal(size=(6, 2)), generator.normal(size=(5, 3)))
    columns = (np.array([0, 1]), np.array([0, 1, 2]))
    jacobian = ResidualJacobian(
        BlockMatrix(blocks, columns, 3), np.zeros(3, bool), np.ones(3), np.zeros((0, 3))
    )
    step = generator.normal(size=3)
    before = [generator.normal(size=6), generator.normal(size=5)]
    expected = [block @ step[own] for block, own in zip(blocks, columns, strict=True)]
    after = [b + e + 0.1 * generator.normal(size=len(b))
             for b, e in zip(before, expected, strict=True)]  # fmt: skip
    return jacobian, step, before, after


@pytest.mark.parametrize("largest", [np.zeros(3), np.array([1.0, 20.0, 0.3])])
def test_it_says_what_the_step_has_shown_and_changes_nothing_else(case, largest):
    jacobian, step, before, after = case
    one, other = state(np.zeros(3), before, largest), state(step, after, largest)
    found = secant_update(jacobian, one, other)
    seen = other.at.residuals - one.at.residuals
    np.testing.assert_allclose(found.blocks.product(step), seen, atol=1e-12)
    scaled = step * (largest**2 if largest.any() else 1.0)
    for e, columns in enumerate(jacobian.blocks.columns):
        # directions that are orthogonal to the scaled step keep their derivatives
        _, _, rows = np.linalg.svd(scaled[columns][None])
        kept = rows[1:].T
        np.testing.assert_allclose(
            found.blocks.blocks[e] @ kept, jacobian.blocks.blocks[e] @ kept, atol=1e-12
        )


def test_a_step_that_showed_something_else_asks_for_new_derivatives(case):
    jacobian, step, before, _ = case
    opposite = [
        b - block @ step[own]
        for b, block, own in zip(
            before, jacobian.blocks.blocks, jacobian.blocks.columns, strict=True
        )
    ]
    one, other = state(np.zeros(3), before, np.zeros(3)), state(step, opposite, np.zeros(3))
    assert secant_update(jacobian, one, other) is None


def test_a_fit_ends_where_it_does_without_them():
    problem = spring_problem(3, 100, noise=0.01).problem
    plain = ce.fit(problem)
    found = ce.fit(problem, ce.LeastSquares(trials=1, secant_updates=10))
    assert found.success
    assert found.cost == pytest.approx(plain.cost, rel=1e-9)
    assert found.x == pytest.approx(plain.x, rel=1e-5)
    assert found.uncertainty is not None
    for one, other in zip(found.estimates, plain.estimates, strict=True):
        assert one.std_error == pytest.approx(other.std_error, rel=1e-3)


def test_they_save_simulations_where_many_unknowns_share_one_experiment():
    problem = spring_problem(1, 100, noise=0.01, local=("x0", "v0")).problem
    start = tuple(replace(p, start=p.start * 1.3 + 0.01) for p in problem.parameters)
    problem = replace(problem, parameters=start)
    counts = []
    for updates in (0, 10):
        method = ce.LeastSquares(trials=1, differences="forward", secant_updates=updates, ftol=1e-4)
        counts.append(ce.fit(problem, method).evaluations)
    assert counts[1] <= counts[0]
