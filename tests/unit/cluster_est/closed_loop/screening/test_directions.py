"""The linear time-varying system, against SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.screening import linear_system as module
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions
from cluster_est.closed_loop.screening.discrete_time import discretise
from cluster_est.closed_loop.screening.linear_system import propagate
from cluster_est.closed_loop.settings import LoopSettings
from workers.messages import Linearisation, MatrixSeries

TIMES = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 400))


def a_at(t):
    return np.array([[0.0, 1.0], [-9.0 - 4.0 * np.sin(2.0 * t), -0.3 + 0.2 * t]])


def forces(t):
    """Three right-hand sides, (2, 3)."""
    return np.array([[0.0, 1.0, np.sin(t)], [np.cos(5.0 * t), 0.0, t]])


def linear_system(times):
    nothing = np.zeros((len(times), 0))
    return Linearisation(
        times, np.zeros((len(times), 2)), np.zeros((len(times), 2)), nothing, nothing, nothing,
        nothing, MatrixSeries.of(np.array([a_at(t) for t in times])),
        *[np.zeros((len(times), 2, 0))] * 5,
        ("x", "v"), (), (), (),
    )  # fmt: skip


def test_it_is_the_solution_of_the_differential_equation():
    found = propagate(discretise(linear_system(TIMES)), np.array([forces(t) for t in TIMES]))
    for column in range(3):

        def slope(t, x, column=column):
            return a_at(t) @ x + forces(t)[:, column]

        truth = solve_ivp(
            slope, (TIMES[0], TIMES[-1]), [0, 0], t_eval=TIMES, rtol=1e-10, atol=1e-12
        )
        size = np.abs(truth.y).max()
        np.testing.assert_allclose(found[:, :, column], truth.y.T, atol=2e-3 * size)


def test_a_singular_constant_system_is_exact_for_forcing_that_is_linear_in_time():
    """x' = v, v' = t from rest: v = t^2 / 2, x = t^3 / 6, also on three uneven steps."""
    times = np.array([0.0, 0.5, 2.0, 5.0])
    system = replace(
        linear_system(times), A=MatrixSeries.of(np.tile([[0.0, 1.0], [0.0, 0.0]], (4, 1, 1)))
    )
    forcing = np.column_stack([np.zeros(4), times])[:, :, None]
    found = propagate(discretise(system), forcing.copy())[:, :, 0]
    np.testing.assert_allclose(found, np.column_stack([times**3 / 6, times**2 / 2]), rtol=1e-12)


@pytest.fixture(scope="module")
def drive():
    with opened(missing_effect_problem("two_mass_drive")) as bench:
        fitted = unfitted(bench)
        courses = bench.trajectories(fitted)
        candidates = make_candidates(
            fitted.problem, bench.description, courses, [], LoopSettings(sites=("der(w_load)",))
        )
        known = [np.array(list(fitted.estimates.values()))] * len(courses)
        yield courses, [CandidatePoint(c, c.grid[0]) for c in candidates], known


def test_blocks_make_no_difference(drive, monkeypatch):
    whole = directions(*drive)
    monkeypatch.setattr(module, "FEW_VALUES", 60_000)
    for one, other in zip(whole, directions(*drive), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(one).max())


def test_there_may_be_no_trials(drive):
    assert directions(drive[0], [], drive[2]) == []


def test_an_output_that_one_experiment_did_not_measure_moves_only_in_the_others():
    problem = missing_effect_problem("two_mass_drive")
    first, second = problem.experiments
    second = replace(second, outputs=second.outputs[:1])
    with opened(replace(problem, experiments=(first, second))) as bench:
        fitted = unfitted(bench)
        courses = bench.trajectories(fitted)
        candidates = make_candidates(
            fitted.problem, bench.description, courses, [],
            LoopSettings(sites=("output load_speed",)),
        )  # fmt: skip
        (trial,) = [CandidatePoint(c, c.grid[0]) for c in candidates if c.form.name == "bias"]
        known = [np.array(list(fitted.estimates.values()))] * 2
        (moved,) = directions(courses, [trial], known)
    n = len(first.outputs[0].times)
    expected = np.repeat([0.0, -1.0 / first.outputs[1].sigma, 0.0], n)
    np.testing.assert_allclose(moved[:, 0], expected)
