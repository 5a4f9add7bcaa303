"""Fits that update a Jacobian with what steps have shown, after Broyden."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.problems.springs import spring_problem

import cluster_est as ce


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
