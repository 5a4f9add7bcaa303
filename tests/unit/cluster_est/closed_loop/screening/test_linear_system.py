import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cluster_est.closed_loop.candidates.trajectory import (
    LARGE,
    Forcing,
    LargeSystem,
    SmallSystem,
    linear_system,
)
from workers.messages import Linearisation, MatrixSeries

N, OUTPUTS = 60, 3
BOTH_WAYS = pytest.mark.parametrize("way", [SmallSystem, LargeSystem])


def linearised(times, matrices, shown):
    """A system x' = A x, y = C x of which nothing else matters."""
    n, outputs, states = shown.shape
    nothing = np.zeros((n, 0))
    return Linearisation(
        times, np.zeros((n, states)), np.zeros((n, states)), nothing, nothing,
        np.zeros((n, outputs)), np.zeros((n, outputs)), MatrixSeries.of(matrices),
        np.zeros((n, states, 0)), shown, np.zeros((n, outputs, 0)), np.zeros((n, states, 0)),
        np.zeros((n, outputs, 0)), tuple(f"x{i}" for i in range(states)), (),
        tuple(f"y{i}" for i in range(outputs)), (),
    )  # fmt: skip


def sparse(states: int, *, varying: float) -> Linearisation:
    """A sparse, stable random system on an uneven grid; its matrix changes by a share of itself."""
    random = np.random.default_rng(0)
    times = np.cumsum(random.uniform(0.05, 0.15, N))
    pattern = random.uniform(size=(states, states)) < 3.0 / states
    entries = np.where(pattern, random.normal(size=(states, states)), 0.0) - 2.0 * np.eye(states)
    waves = 1.0 + varying * np.sin(3.0 * times[:, None, None] + entries)
    return linearised(times, entries * waves, random.normal(size=(N, OUTPUTS, states)))


def forcing(states: int) -> Forcing:
    """Two along states and two along a direction that changes, one of each twice."""
    random = np.random.default_rng(1)
    changing = random.normal(size=(N, states))
    return Forcing(random.normal(size=(N, 5)), [states - 1, changing, 0], np.array([0, 1, 2, 1, 0]))


def states_of(way, times, matrices, forces):
    """The states' response to forces (n, states), from rest."""
    states = forces.shape[1]
    shown = np.tile(np.eye(states), (len(times), 1, 1))
    system = way(linearised(times, matrices, shown))
    ones = np.ones((len(times), 1))
    return system.respond(Forcing(ones, [forces], np.zeros(1, int)))[:, :, 0]


CONSTANT = {
    "slow": -1e-9 * np.diag([3.0, 1.0, 0.2, 0.0]) + 1e-10 * np.eye(4, k=1),
    "as fast as the steps": -3.0 * np.diag([3.0, 1.0, 0.2, 0.0]) + 0.3 * np.eye(4, k=1),
    "far faster": -1e4 * np.diag([3.0, 1.0, 0.2, 0.0]) + 1e3 * np.eye(4, k=1),
    "without dynamics": np.zeros((4, 4)),
    "integrators in a row": np.eye(4, k=1),
}


@BOTH_WAYS
@pytest.mark.parametrize("name", CONSTANT)
def test_a_constant_system_is_exact_for_forces_that_are_linear_between_samples(way, name):
    """By the exponential of [[hA, h, 0], [0, 0, 1], [0, 0, 0]], C. F. Van Loan (1978)."""
    a, times = CONSTANT[name], np.array([0.0, 0.5, 2.0, 2.7])
    forces = np.random.default_rng(2).normal(size=(4, 4))
    truth = np.zeros((4, 4))
    for k, h in enumerate(np.diff(times)):
        joined = np.zeros((12, 12))
        joined[:4, :4], joined[:4, 4:8], joined[4:8, 8:] = h * a, h * np.eye(4), np.eye(4)
        powers = expm(joined)
        rise = forces[k + 1] - forces[k]
        truth[k + 1] = powers[:4] @ np.concatenate([truth[k], forces[k], rise])
    found = states_of(way, times, np.tile(a, (4, 1, 1)), forces)
    np.testing.assert_allclose(found, truth, atol=1e-12 * max(1.0, np.abs(truth).max()))


@BOTH_WAYS
@pytest.mark.parametrize("column", range(3))
def test_it_is_the_solution_of_the_differential_equation(way, column):
    times = np.sort(np.random.default_rng(0).uniform(0.0, 3.0, 400))

    def matrix(t):
        return np.array([[0.0, 1.0], [-9.0 - 4.0 * np.sin(2.0 * t), -0.3 + 0.2 * t]])

    def force(t):
        return np.array([[0.0, 1.0, np.sin(t)], [np.cos(5.0 * t), 0.0, t]])[:, column]

    ends = times[0], times[-1]
    truth = solve_ivp(
        lambda t, x: matrix(t) @ x + force(t), ends, [0, 0], t_eval=times, rtol=1e-10, atol=1e-12
    ).y.T
    matrices, forces = (np.array([of(t) for t in times]) for of in (matrix, force))
    found = states_of(way, times, matrices, forces)
    np.testing.assert_allclose(found, truth, atol=2e-3 * np.abs(truth).max())


def test_both_ways_give_the_same_responses():
    given = sparse(9, varying=0.5)
    few, many = SmallSystem(given), LargeSystem(given)
    np.testing.assert_allclose(many.respond(forcing(9)), few.respond(forcing(9)), atol=1e-10)
    source = np.random.default_rng(2).normal(size=(N, 9, 4))
    np.testing.assert_allclose(many.weigh(source.copy()), few.weigh(source.copy()), atol=1e-10)


@pytest.mark.parametrize("varying", [0.0, 1e-4, 0.5])
def test_a_large_system_is_the_adjoint_of_itself(varying):
    """Also where matrices are held over several steps: w'(D f) = (D'w)'f."""
    given = sparse(LARGE, varying=varying)
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


def test_held_matrices_are_those_of_the_exact_ones_nearly():
    given = sparse(LARGE, varying=1e-4)
    held = LargeSystem(given).respond(forcing(LARGE))
    exact = SmallSystem(given).respond(forcing(LARGE))
    np.testing.assert_allclose(held, exact, atol=1e-3 * np.abs(exact).max())
