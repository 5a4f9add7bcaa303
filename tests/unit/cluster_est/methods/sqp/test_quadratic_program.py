from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from cluster_est.methods.sqp.quadratic_program import QuadraticSubproblem, penalised_step

SEEDS = range(8)


def random_model(seed, unknowns=4, rows=5, equalities=1, constraints=None):
    """With `constraints`, rows are dealt out to so many that are the largest of several terms."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(unknowns, unknowns))
    which = np.arange(rows) if constraints is None else np.arange(rows) % constraints
    return QuadraticSubproblem(
        random.normal(size=unknowns),
        root.T @ root + 0.1 * np.eye(unknowns),
        random.normal(size=rows),
        random.normal(size=(rows, unknowns)),
        which.astype(np.intp),
        np.arange(rows) < equalities,
    )


def objective(model, penalty, step):
    return model.change(step) + penalty * model.violation(step)


def by_scipy(model, penalty, radius):
    """The same with SLSQP: the violations are unknowns of their own, above all their terms."""
    n, m = len(model.gradient), 1 + int(model.constraint.max())
    signed = np.vstack([model.jacobian, -model.jacobian[model.equality]])
    values = np.concatenate([model.values, -model.values[model.equality]])
    of = np.concatenate([model.constraint, model.constraint[model.equality]])
    matrix = np.hstack([-signed, np.eye(m)[of]])
    found = minimize(
        lambda z: model.change(z[:n]) + penalty * z[n:].sum(),
        np.concatenate([np.zeros(n), np.full(m, 10.0)]),
        jac=lambda z: np.append(model.gradient + model.hessian @ z[:n], np.full(m, penalty)),
        method="SLSQP",
        bounds=[(-radius, radius)] * n + [(0.0, None)] * m,
        constraints={"type": "ineq", "fun": lambda z: matrix @ z - values, "jac": lambda z: matrix},
        options={"ftol": 1e-14, "maxiter": 500},
    )
    return found.x[:n]


@pytest.mark.parametrize("seed", SEEDS)
class TestAgainstScipy:
    @pytest.mark.parametrize("penalty", [0.1, 100.0])
    @pytest.mark.parametrize("constraints", [None, 2])
    def test_constraints(self, seed, penalty, constraints):
        equalities = 1 if constraints is None else 0
        model = random_model(seed, equalities=equalities, constraints=constraints)
        step, _ = penalised_step(model, penalty, np.full(4, -1.0), np.full(4, 1.0))
        wanted = objective(model, penalty, by_scipy(model, penalty, 1.0))
        assert objective(model, penalty, step) <= wanted + 1e-7 * max(1.0, abs(wanted))

    def test_bounds_only(self, seed):
        model = random_model(seed, rows=0, equalities=0)
        step, _ = penalised_step(model, 1.0, np.full(4, -0.3), np.full(4, 0.5))
        root = np.linalg.cholesky(model.hessian).T
        target = -np.linalg.solve(root.T, model.gradient)
        found = lsq_linear(root, target, (-0.3, 0.5), method="bvls", tol=1e-14)
        np.testing.assert_allclose(step, found.x, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
def test_multipliers_balance_the_gradient(seed):
    """In a wide box, where no bound takes part: the conditions of Karush, Kuhn and Tucker."""
    model, penalty = random_model(seed), 3.0
    step, multipliers = penalised_step(model, penalty, np.full(4, -30.0), np.full(4, 30.0))
    slope = model.gradient + model.hessian @ step + model.jacobian.T @ multipliers
    np.testing.assert_allclose(slope, 0.0, atol=1e-6)
    values = model.values + model.jacobian @ step
    assert (np.abs(multipliers) <= penalty * (1.0 + 1e-9)).all()
    assert (multipliers[~model.equality] >= -1e-9).all()
    np.testing.assert_allclose(multipliers[values > 1e-6], penalty, rtol=1e-6)
    slack = ~model.equality & (values < -1e-6)
    np.testing.assert_allclose(multipliers[slack], 0.0, atol=1e-6)


def simple(values, jacobian, equality):
    return QuadraticSubproblem(
        np.array([1.0, 2.0]), np.eye(2), np.array(values), np.array(jacobian),
        np.arange(len(values)), np.array(equality),
    )  # fmt: skip


@pytest.mark.parametrize("copies", [1, 5])
def test_constraints_that_contradict_or_repeat_each_other_have_their_best_compromise(copies):
    """p1 + p2 = -1, so often that p1 + p2 = 3 has less weight: at (0, -1) the cost is least."""
    rows = [[1.0, 1.0]] * (copies + 2)
    model = simple([1.0] * (copies + 1) + [-3.0], rows, [True] * (copies + 2))
    step, multipliers = penalised_step(model, 1e4, np.full(2, -1.5), np.full(2, 1.5))
    np.testing.assert_allclose(step, [0.0, -1.0], atol=1e-8)
    np.testing.assert_allclose(multipliers.sum(), -1.0, rtol=1e-6)


@pytest.mark.parametrize("weight", [1e-6, 1e6])
def test_singular_hessians_have_a_step_all_the_same(weight):
    """Along p1 - p2 the cost is linear, and along p1 + p2 it is quadratic."""
    model = replace(simple([-0.5], [[1.0, 1.0]], [False]), hessian=weight * np.ones((2, 2)))
    step, _ = penalised_step(model, 1e3 * weight, np.full(2, -1.0), np.full(2, 1.0))
    best = min(
        (objective(model, 1e3 * weight, np.array(p)), p)
        for p in [(x, -1.0) for x in np.linspace(-1.0, 1.0, 200001)]
    )
    np.testing.assert_allclose(step, best[1], atol=2e-5)


def test_numbers_that_overflow_give_no_step():
    model = replace(simple([1.0], [[1.0, 1.0]], [False]), gradient=np.full(2, np.nan))
    step, multipliers = penalised_step(model, 1.0, np.full(2, -1.0), np.full(2, 1.0))
    np.testing.assert_array_equal(step, 0.0)
    assert np.isfinite(multipliers).all()


@pytest.mark.parametrize("value", [-1e3, -1.0, 1.0])
def test_constraints_that_no_step_changes_do_not_matter(value):
    model = random_model(2)
    flat = replace(
        model,
        values=np.append(model.values, value),
        jacobian=np.vstack([model.jacobian, np.zeros(4)]),
        constraint=np.arange(6, dtype=np.intp),
        equality=np.append(model.equality, False),
    )
    plain, multipliers = penalised_step(model, 5.0, -np.ones(4), np.ones(4))
    step, more = penalised_step(flat, 5.0, -np.ones(4), np.ones(4))
    np.testing.assert_allclose(step, plain, atol=1e-6)
    np.testing.assert_allclose(more[:5], multipliers, atol=1e-5)
