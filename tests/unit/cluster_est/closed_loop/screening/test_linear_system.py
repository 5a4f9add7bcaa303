"""Linear systems of few and of many states: the same responses, and each the adjoint of itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from cluster_est.closed_loop.candidates.step_matrices import step_matrices
from cluster_est.closed_loop.screening import discrete_time as module
from cluster_est.closed_loop.screening.discrete_time import streamed_steps
from cluster_est.closed_loop.screening.linear_system import (
    LARGE,
    Forcing,
    LargeSystem,
    SmallSystem,
    linear_system,
)
from workers.messages import Linearisation, MatrixSeries

N, OUTPUTS = 60, 3


def linearisation(states: int, *, varying: float, seed: int = 0) -> Linearisation:
    """A sparse, stable random system on an uneven grid; its matrix changes by a share of itself."""
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.05, 0.15, N))
    pattern = random.uniform(size=(states, states)) < 3.0 / states
    entries = np.where(pattern, random.normal(size=(states, states)), 0.0) - 2.0 * np.eye(states)
    waves = 1.0 + varying * np.sin(3.0 * times[:, None, None] + entries)
    nothing = np.zeros((N, 0))
    shown = random.normal(size=(N, OUTPUTS, states))
    return Linearisation(
        times, np.zeros((N, states)), np.zeros((N, states)), nothing, nothing,
        np.zeros((N, OUTPUTS)), np.zeros((N, OUTPUTS)), MatrixSeries.of(entries * waves),
        np.zeros((N, states, 0)), shown, np.zeros((N, OUTPUTS, 0)), np.zeros((N, states, 0)),
        np.zeros((N, OUTPUTS, 0)), tuple(f"x{i}" for i in range(states)), (),
        tuple(f"y{i}" for i in range(OUTPUTS)), (),
    )  # fmt: skip


def forcing(states: int) -> Forcing:
    """Two along states and two along a direction that changes, one of each twice."""
    random = np.random.default_rng(1)
    changing = random.normal(size=(N, states))
    return Forcing(random.normal(size=(N, 5)), [states - 1, changing, 0], np.array([0, 1, 2, 1, 0]))


@pytest.mark.parametrize("scale", [1e-9, 0.3, 40.0, 1e4])
def test_the_matrices_of_a_step_are_those_of_the_exponential(scale):
    """Of [[hA, h, 0], [0, 0, 1], [0, 0, 0]], C. F. Van Loan (1978); one state is constant."""
    a = -scale * np.diag([3.0, 1.0, 0.2, 0.0]) + 0.1 * scale * np.eye(4, k=1)
    h = 0.7
    joined = np.zeros((12, 12))
    joined[:4, :4], joined[:4, 4:8], joined[4:8, 8:] = h * a, h * np.eye(4), np.eye(4)
    powers = expm(joined)
    found = step_matrices(a, h)
    last = powers[:4, 8:]
    np.testing.assert_allclose(found.keep, powers[:4, :4], atol=1e-12)
    np.testing.assert_allclose(found.from_first, powers[:4, 4:8] - last, atol=1e-12)
    np.testing.assert_allclose(found.from_last, last, atol=1e-12)


def test_a_system_without_dynamics_is_integrated():
    found = step_matrices(np.zeros((2, 2)), 3.0)
    np.testing.assert_array_equal(found.keep, np.eye(2))
    np.testing.assert_allclose(found.from_first, 1.5 * np.eye(2))
    np.testing.assert_allclose(found.from_last, 1.5 * np.eye(2))


def test_both_ways_give_the_same_responses():
    given = linearisation(9, varying=0.5)
    few, many = SmallSystem(given), LargeSystem(given)
    expected = few.respond(forcing(9))
    np.testing.assert_allclose(many.respond(forcing(9)), expected, atol=1e-10)
    source = np.random.default_rng(2).normal(size=(N, 9, 4))
    np.testing.assert_allclose(many.weigh(source.copy()), few.weigh(source.copy()), atol=1e-10)


@pytest.mark.parametrize("varying", [0.0, 1e-4, 0.5])
def test_a_large_system_is_the_adjoint_of_itself(varying):
    """Also where matrices are held over several steps: w'(D f) = (D'w)'f."""
    given = linearisation(LARGE, varying=varying)
    system, forced = linear_system(given), forcing(LARGE)
    assert isinstance(system, LargeSystem)
    weights = np.random.default_rng(3).normal(size=(N, OUTPUTS, 1))
    weighed = system.weigh(np.matmul(given.C.transpose(0, 2, 1), weights))[:, :, 0]
    responses = system.respond(forced)
    for j, k in enumerate(forced.which.tolist()):
        direction = forced.directions[k]
        if isinstance(direction, int):
            along = weighed[:, direction]
        else:
            along = np.sum(weighed * direction, axis=1)
        found = np.sum(forced.amounts[:, j] * along)
        assert found == pytest.approx(np.sum(weights[:, :, 0] * responses[:, :, j]), rel=1e-9)


@pytest.mark.parametrize(("varying", "made"), [(0.0, 1), (1e-9, 1), (0.5, N - 1)])
def test_matrices_are_made_where_the_system_changes(varying, made, monkeypatch):
    given = linearisation(5, varying=varying)
    even = np.linspace(0.0, 6.0, N)
    given = Linearisation(even, *[getattr(given, f) for f in Linearisation.__slots__[1:]])
    calls = []
    own = module.step_matrices
    monkeypatch.setattr(module, "step_matrices", lambda a, h: calls.append(h) or own(a, h))
    assert len(list(streamed_steps(given))) == N - 1
    assert len(calls) == made


def test_held_matrices_are_those_of_the_exact_ones_nearly():
    given = linearisation(LARGE, varying=1e-4)
    held = LargeSystem(given).respond(forcing(LARGE))
    exact = SmallSystem(given).respond(forcing(LARGE))
    np.testing.assert_allclose(held, exact, atol=1e-3 * np.abs(exact).max())
