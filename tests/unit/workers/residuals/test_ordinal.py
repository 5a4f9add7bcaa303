"""Residuals of outputs of which only the order is known, against brute force."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from cluster_est import Output
from cluster_est.errors import DataError
from workers.residuals.observed import observed_residuals
from workers.residuals.ordinal import category_bounds, disparities, ordinal_residuals

SHARE_OF_GAPS = 0.5
"""All gaps together, in spreads: the definition, written down again."""


def residuals(grades, simulated, sigma=1.0):
    return ordinal_residuals(category_bounds(grades, simulated), grades, simulated, sigma)


def cost(grades, simulated):
    return float(np.sum(residuals(grades, simulated) ** 2))


def least_cost(grades, simulated, generator):
    """The smallest cost over thresholds that SLSQP finds, in standardised values."""
    known, numbers = np.unique(grades, return_inverse=True)
    count = len(known)
    gap = SHARE_OF_GAPS / count
    places = (simulated - simulated.mean()) / simulated.std()

    def squares(thresholds):
        lower = np.concatenate([[-np.inf], thresholds + gap / 2])[numbers]
        upper = np.concatenate([thresholds - gap / 2, [np.inf]])[numbers]
        under, over = np.maximum(lower - places, 0.0), np.maximum(places - upper, 0.0)
        slope = np.zeros(count)
        np.add.at(slope, numbers, -2.0 * over)  # of the threshold above a category
        below = np.zeros(count)
        np.add.at(below, numbers, 2.0 * under)
        return np.sum(under**2 + over**2), slope[:-1] + below[1:]

    constraints = [
        {"type": "ineq", "fun": lambda t, i=i: t[i + 1] - t[i] - gap} for i in range(count - 2)
    ]
    start = np.sort(generator.normal(size=count - 1)) + gap * np.arange(count - 1)
    options = {"ftol": 1e-14, "maxiter": 2000}
    return minimize(
        squares, start, jac=True, constraints=constraints, method="SLSQP", options=options
    ).fun


@pytest.mark.parametrize("order", ["none", "part"])
@pytest.mark.parametrize("seed", range(8))
def test_the_bounds_are_the_best_ones_there_are(seed, order):
    generator = np.random.default_rng(seed)
    count, size = generator.integers(2, 6), generator.integers(6, 30)
    simulated = 10.0 ** generator.uniform(-3, 3) * generator.normal(size=size) + 5.0
    noisy = simulated + 0.4 * simulated.std() * generator.normal(size=size)
    judged = noisy if order == "part" else generator.normal(size=size)
    grades = np.digitize(judged, np.quantile(judged, np.linspace(0, 1, count + 1)[1:-1]))
    expected = least_cost(grades.astype(float), simulated, generator)
    assert cost(grades.astype(float), simulated) == pytest.approx(expected, rel=1e-6, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 4), st.floats(-1.0, 1.0)), min_size=3, max_size=25),
    st.floats(0.01, 1e4),
    st.floats(-1e3, 1e3),
)
def test_an_order_says_nothing_of_scale_and_offset_nor_of_the_names_of_grades(pairs, scale, offset):
    grades, simulated = np.array(pairs, float).T.copy()
    if simulated.std() < 1e-3:
        return
    usual = residuals(grades, simulated)
    np.testing.assert_allclose(residuals(grades, scale * simulated + offset), usual, atol=1e-6)
    np.testing.assert_array_equal(residuals(np.exp(grades) - 100.0, simulated), usual)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.floats(-1.0, 1.0)), min_size=4, max_size=20))
def test_bounds_are_in_order_with_a_gap_between_them(pairs):
    grades, simulated = np.array(pairs, float).T.copy()
    bounds = category_bounds(grades, simulated)
    if not bounds.spread > 0.0:
        return
    gap = SHARE_OF_GAPS / len(bounds.categories) * bounds.spread
    assert (bounds.upper[:-1] + gap <= bounds.lower[1:] + 1e-9).all()
    assert (bounds.lower <= bounds.upper + 1e-9).all()
    nearest = disparities(bounds, grades, simulated)
    rows = np.searchsorted(bounds.categories, grades)
    assert (nearest >= bounds.lower[rows] - 1e-9).all()
    assert (nearest <= bounds.upper[rows] + 1e-9).all()


def test_what_is_in_order_and_apart_fits_and_ties_may_lie_anywhere_in_their_category():
    grades = np.array([1.0, 1.0, 2.0, 2.0, 3.0])
    np.testing.assert_array_equal(residuals(grades, np.array([0.0, 4.0, 11.0, 9.0, 20.0])), 0.0)


def test_the_distance_is_the_one_to_the_categories_bounds():
    """Two samples in the wrong order: the threshold lies between them, with half a gap each way."""
    grades, simulated = np.array([0.0, 0.0, 1.0, 1.0]), np.array([-3.0, 1.0, -1.0, 3.0])
    spread, gap = np.sqrt(5.0), SHARE_OF_GAPS / 2
    expected = np.array([0.0, -(1.0 / spread + gap / 2), 1.0 / spread + gap / 2, 0.0])
    np.testing.assert_allclose(residuals(grades, simulated, sigma=0.1), 10.0 * expected)


def test_a_simulation_without_an_order_fits_none():
    """Neither one that does not move, nor one of which a single sample does."""
    generator = np.random.default_rng(2)
    truth = np.sin(0.3 * np.arange(60.0))
    grades = np.digitize(truth + 0.1 * generator.normal(size=60), [-0.5, 0.5]).astype(float)
    right, reversed_order = cost(grades, truth), cost(grades, -truth)
    still = cost(grades, np.full(60, 3.0))
    spike = cost(grades, np.where(np.arange(60) == np.argmax(truth), 1.0, 0.0))
    assert right < 0.2 * spike
    assert right < 0.05 * reversed_order
    assert still >= reversed_order
    np.testing.assert_array_equal(residuals(grades, np.full(60, 3.0), sigma=0.5), 2.5)


@pytest.mark.parametrize("seed", range(5))
def test_the_cost_has_a_derivative_though_the_bounds_move(seed):
    """Central differences of three steps agree, whatever categories are pooled."""
    generator = np.random.default_rng(seed)
    simulated, direction = generator.normal(size=(2, 40))
    grades = generator.integers(0, 6, 40).astype(float)
    found = []
    for step in (1e-3, 1e-4, 1e-5):
        ahead, behind = (cost(grades, simulated + s * step * direction) for s in (1.0, -1.0))
        found.append((ahead - behind) / (2.0 * step))
    assert found[0] == pytest.approx(found[2], rel=0.02, abs=0.02)
    assert found[1] == pytest.approx(found[2], rel=2e-3, abs=2e-3)


def test_a_held_out_part_is_compared_with_the_bounds_of_its_training_part():
    times = np.arange(6.0)
    train = Output("y", times, [1.0, 1.0, 3.0, 3.0, 4.0, 4.0], ordinal=True)
    simulated = np.array([0.0, 1.0, 10.0, 11.0, 20.0, 21.0])
    held_out = Output("y", times, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], ordinal=True, reference=train)
    bounds = category_bounds(train.values, simulated)
    assert (bounds.upper[0], bounds.lower[1]) == pytest.approx(
        (5.5 - bounds.spread / 12, 5.5 + bounds.spread / 12)
    )
    # 0 and 5 were never seen: they lie somewhere below 1 and above 4; 2 between 1 and 3
    found = observed_residuals(held_out, np.array([0.0, 8.0, 5.5, 12.0, 12.0, 99.0]), simulated)
    expected = np.array([0.0, bounds.upper[0] - 8.0, 0.0, 0.0, bounds.lower[2] - 12.0, 0.0])
    np.testing.assert_allclose(found, expected / bounds.spread)


def test_what_is_not_finite_stays_so():
    assert np.isnan(residuals(np.array([0.0, 1.0]), np.array([0.0, np.nan]))).all()
    assert np.isnan(residuals(np.array([0.0, 1.0]), np.array([1e308, -1e308]))).all()


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"free_scale": True}, "ordinal: must not be used with free_scale"),
        ({"free_offset": True}, "ordinal: must not be used with free_offset"),
        ({"detection_limit": 0.5}, "ordinal: must not be used with detection_limit"),
        ({"relative_sigma": 0.1}, "ordinal: must not be used with relative_sigma"),
        ({"reference": Output("z", [0.0], [1.0])}, "reference: must be the same output"),
        ({"reference": "y"}, "reference: must be an Output, but is 'y'"),
    ],
)
def test_what_contradicts_an_order_is_refused(how, said):
    with pytest.raises(DataError, match=said):
        Output("y", [0.0, 1.0], [0.0, 1.0], ordinal=True, **how)
