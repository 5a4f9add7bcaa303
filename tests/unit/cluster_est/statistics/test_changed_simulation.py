"""Shares and standard errors are those of ordinary least squares with the change as a column."""

import functools

import numpy as np
import pytest
from scipy.signal import lfilter, lsim

import cluster_est as ce
from cluster_est.statistics.changed_simulation import (
    ChangedSimulation,
    compare_simulations,
    fall_as_good,
)
from cluster_est.statistics.records import make_records

H = 0.05
N = 400
TIMES = H * np.arange(N)
LAG = ([2.0], [1.0, 1.0])
"""Of first order: gain 2, time constant 1 s."""


DRIVE = np.sin(0.5 * TIMES) + np.repeat(np.random.default_rng(7).uniform(-1.0, 1.0, 10), N // 10)


@functools.cache
def answer(gain, constant, *, held):
    return lsim(([gain], [constant, 1.0]), DRIVE, TIMES, interp=not held)[1]


def compared(seed, *, truth_held, noise, colour=0.0, fitted_held=False):
    """What is said of one record of the lag, fitted with the other interpolation or the right."""
    generator = np.random.default_rng([seed, 1])
    fitted = answer(2.0, 1.0, held=fitted_held)
    other = answer(2.0, 1.0, held=not fitted_held)
    jacobian = np.column_stack(
        [
            (answer(2.0 * 1.0001, 1.0, held=fitted_held) - fitted) / 2e-4,
            (answer(2.0, 1.0001, held=fitted_held) - fitted) / 1e-4,
        ]
    )
    white = generator.standard_normal(N + 100)
    coloured = lfilter([np.sqrt(1.0 - colour**2)], [1.0, -colour], white)[100:]
    y = answer(2.0, 1.0, held=truth_held) + noise * coloured
    run = ce.Experiment("e", 0.0, float(TIMES[-1]), (), (ce.Output("y", TIMES, y),))
    records = make_records([run])
    return compare_simulations(y - fitted, y - other, -jacobian, records), (
        y - fitted,
        other - fitted,
        jacobian,
    )


def ordinary(residuals, change, jacobian):
    """The coefficient of the change beside the Jacobian, and its standard error."""
    matrix = np.column_stack([change, jacobian])
    found, squares, *_ = np.linalg.lstsq(matrix, residuals)
    covariance = np.linalg.inv(matrix.T @ matrix) * squares[0] / (N - matrix.shape[1])
    return found[0], np.sqrt(covariance[0, 0])


@pytest.mark.parametrize("truth_held", [False, True])
def test_the_share_is_that_of_ordinary_least_squares(truth_held):
    found, parts = compared(3, truth_held=truth_held, noise=0.01)
    share, error = ordinary(*parts)
    assert found.share == pytest.approx(share, rel=1e-6)
    assert found.share == pytest.approx(float(truth_held), abs=4.0 * error)
    assert error * 0.999 <= found.error < 2.0 * error
    assert found.preferred is truth_held
    assert found.refuted is not truth_held


@pytest.mark.parametrize(
    ("share", "error", "refuted"),
    [
        (0.0, 0.2, True),
        (0.0, 0.3, False),
        (0.4, 0.01, True),
        (0.49, 0.01, False),
        (1.0, 0.01, False),
    ],
)
def test_a_change_is_refuted_only_by_clear_measurements(share, error, refuted):
    assert ChangedSimulation(share, error, 1.0, 1.0, np.zeros(1)).refuted is refuted


def test_a_fall_is_as_good_as_more_unknowns_by_the_bayesian_criterion():
    """The criterion of each model is n log(RSS / n) + k log(n); outputs have equal weights."""
    generator = np.random.default_rng(8)
    large, small = generator.standard_normal((2, N)) * [[1.0], [0.3]]
    times = ce.Output("y", TIMES, TIMES), ce.Output("z", TIMES, TIMES)
    records = make_records([ce.Experiment("e", 0.0, float(TIMES[-1]), (), times)])
    before, after = np.concatenate([large, 1e3 * large]), np.concatenate([small, 1e3 * small])
    fall = fall_as_good(before, after, records, 3)
    n, ratio = 2 * N, float(np.sum(small**2) / np.sum(large**2))
    assert n * np.log(1.0 - fall) == pytest.approx(n * np.log(ratio) + 3.0 * np.log(n))
    assert fall_as_good(before, before, records, 0) == pytest.approx(0.0, abs=1e-12)


def test_the_squares_are_those_after_a_fit_of_either():
    found, (residuals, change, jacobian) = compared(4, truth_held=True, noise=0.01)
    squares = [np.linalg.lstsq(jacobian, each)[1][0] for each in (residuals, residuals - change)]
    assert found.fall == pytest.approx(1.0 - squares[1] / squares[0], rel=1e-6)
    assert float(found.gain.sum()) == pytest.approx(found.before - found.after)


def test_coloured_noise_is_accounted_for():
    """The spread of the shares over many records is the error that is given, not that of white."""
    results = [compared(s, truth_held=False, noise=0.02, colour=0.9) for s in range(150)]
    shares = np.array([found.share / found.error for found, _ in results])
    naive = np.array([np.divide(*ordinary(*parts)) for _, parts in results])
    assert np.std(shares) < 1.25
    assert np.std(naive) > 1.5


@pytest.mark.parametrize("fitted_held", [False, True])
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_what_is_right_is_never_doubted(fitted_held, colour):
    given = {"fitted_held": fitted_held, "truth_held": fitted_held, "colour": colour}
    found = [compared(s, noise=0.02, **given)[0] for s in range(100)]
    assert not any(each.preferred for each in found)


def test_another_lack_of_the_model_asks_for_another_share():
    """A lag of many samples in the actuator, that no interpolation explains."""
    fitted, other = (answer(2.0, 1.0, held=held) for held in (False, True))
    slow = lfilter([0.05], [1.0, -0.95], fitted)
    run = ce.Experiment("e", 0.0, float(TIMES[-1]), (), (ce.Output("y", TIMES, slow),))
    found = compare_simulations(slow - fitted, slow - other, np.ones((N, 1)), make_records([run]))
    assert found.share > 3.0
    assert not found.preferred


@pytest.mark.parametrize(
    ("share", "error", "preferred"),
    [
        (1.0, 0.1, True),
        (1.0, 0.3, False),  # the fitted one is not rejected
        (0.75, 0.01, True),
        (0.45, 0.01, False),  # the fitted one leaves less
        (1.25, 0.01, True),
        (1.5, 0.01, False),  # neither is right
        (1.9, 0.4, True),
    ],
)
def test_the_rule(share, error, preferred):
    found = ChangedSimulation(share, error, 100.0, 80.0, np.zeros(1))
    assert found.preferred is preferred


def test_a_fall_that_is_worth_no_word():
    assert not ChangedSimulation(1.0, 0.1, 100.0, 99.5, np.zeros(1)).preferred


def test_nothing_is_said_where_the_change_is_one_of_a_parameter():
    jacobian = np.random.default_rng(1).standard_normal((N, 2))
    residuals = np.random.default_rng(2).standard_normal(N)
    run = ce.Experiment("e", 0.0, float(TIMES[-1]), (), (ce.Output("y", TIMES, residuals),))
    records = make_records([run])
    changed = residuals + jacobian @ [1.0, 2.0]
    assert compare_simulations(residuals, changed, jacobian, records) is None
    assert compare_simulations(residuals, residuals, jacobian, records) is None
