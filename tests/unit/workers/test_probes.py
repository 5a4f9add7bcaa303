import numpy as np

from workers.probes.probes import difference, differences

TRUTH = np.array([[0.0, 2.0], [0.0, -4.0], [0.0, 1.0]])


def test_each_output_is_measured_by_its_own_size():
    found = TRUTH + np.array([[0.0, 0.0], [0.0, 0.2], [0.0, -0.1]])
    np.testing.assert_allclose(differences(found, TRUTH), [0.0, 0.05])


def test_an_output_that_stays_at_zero_has_the_size_one():
    found = TRUTH + np.array([0.01, 0.0])
    assert difference(found, TRUTH) == 0.01


def test_what_is_the_same_does_not_differ():
    assert differences(np.full((3, 2), np.nan), np.full((3, 2), np.nan)).tolist() == [0.0, 0.0]
