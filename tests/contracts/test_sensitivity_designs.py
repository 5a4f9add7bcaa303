"""What every design of a sensitivity analysis must do. A new one is picked up by its line."""

import numpy as np
import pytest

from cluster_est.sensitivity.designs import DESIGNS

SIZE, GROUPS = 4, 64
EVERY = pytest.mark.parametrize("name", DESIGNS)


def sampled(name, size=SIZE, groups=GROUPS, seed=7):
    return DESIGNS[name].sample(size, groups, np.random.default_rng(seed))


def indices(name, points, values, seed=1):
    found = DESIGNS[name].indices(points, values, np.random.default_rng(seed))
    return {index.name: index for index in found}


def values_of(points):
    """The third unknown does nothing, the second the most."""
    return 1.0 + points[:, 0] + 5.0 * points[:, 1] + 2.0 * points[:, 3] ** 2 * points[:, 0]


@EVERY
def test_it_is_known_by_its_own_name(name):
    assert DESIGNS[name].name == name


@EVERY
@pytest.mark.parametrize("size", [1, 2, 7])
@pytest.mark.parametrize("groups", [8, 20])
def test_it_samples_whole_groups_in_the_unit_cube(name, size, groups):
    points = sampled(name, size, groups)
    assert points.shape[1] == size
    assert len(points) % DESIGNS[name].group(size) == 0
    assert len(points) >= groups * DESIGNS[name].group(size)
    assert ((points >= 0.0) & (points <= 1.0)).all()


@EVERY
def test_the_seed_decides(name):
    np.testing.assert_array_equal(sampled(name), sampled(name))
    assert not np.array_equal(sampled(name), sampled(name, seed=8))
    points = sampled(name)
    one, other = (indices(name, points, values_of(points)) for _ in range(2))
    for index, found in one.items():
        np.testing.assert_array_equal(found.values, other[index].values)
        np.testing.assert_array_equal(found.half_widths, other[index].half_widths)


@EVERY
def test_what_does_nothing_is_last_and_what_does_the_most_is_first(name):
    points = sampled(name)
    ranks = indices(name, points, values_of(points))[DESIGNS[name].ranks]
    assert np.argmin(ranks.values) == 2
    assert np.argmax(ranks.values) == 1
    assert ranks.values[2] == pytest.approx(0.0, abs=1e-9)
    assert ranks.half_widths.shape == (SIZE,)


@EVERY
def test_an_offset_does_not_matter_and_a_unit_changes_no_order(name):
    points = sampled(name)
    plain = indices(name, points, values_of(points))[DESIGNS[name].ranks].values
    scaled = indices(name, points, -1e3 * values_of(points) + 40.0)[DESIGNS[name].ranks].values
    np.testing.assert_array_equal(np.argsort(plain), np.argsort(scaled))
    np.testing.assert_allclose(scaled / scaled.max(), plain / plain.max(), atol=1e-6)


@EVERY
def test_some_groups_may_be_gone(name):
    points = sampled(name)
    group = DESIGNS[name].group(SIZE)
    kept = np.repeat(np.arange(len(points) // group) % 3 != 0, group)
    ranks = indices(name, points[kept], values_of(points[kept]))[DESIGNS[name].ranks]
    assert np.argmax(ranks.values) == 1


@EVERY
def test_a_quantity_that_does_not_move_has_no_index(name):
    points = sampled(name)
    found = indices(name, points, np.full(len(points), 3.0))
    assert set(found) == set(indices(name, points, values_of(points)))
    assert all(np.isnan(index.values).all() for index in found.values())


@EVERY
def test_the_fewest_groups_are_fewer_than_the_usual(name):
    assert 1 < DESIGNS[name].fewest < DESIGNS[name].usual
