import numpy as np
import pytest
from support.problems.curves import Curves

from cluster_est import LeastSquares, Parameter
from cluster_est.methods import ScipyLeastSquares
from cluster_est.methods.method import Ending
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import examine

TIMES = np.linspace(0.0, 3.0, 12)
SHARED = np.array([1.0, 0.5, 2.0, 0.3, 0.7])


def formula(times, values, experiment):
    """A gain and an offset of the experiment's own around a shape that all share."""
    a, b, w, c, d, gain, offset = values
    shape = a * np.exp(-b * times) + np.sin(w * times + 0.1 * experiment)
    return gain * (shape + c * np.cos(3.0 * times) + d * np.sin(5.0 * times)) + offset


def many(experiments, bounded=False, noise=0.05):
    """5 shared unknowns, and a gain and an offset of each experiment."""
    generator = np.random.default_rng(3)
    gains = generator.uniform(0.5, 1.5, experiments)
    offsets = generator.normal(size=experiments)
    measured = [
        formula(TIMES, [*SHARED, gains[e], offsets[e]], e) + noise * generator.normal(size=12)
        for e in range(experiments)
    ]
    shared = [
        Parameter(name, start=1.2 * value, bounds=(0.01, 10.0))
        for name, value in zip("abwcd", SHARED, strict=True)
    ]
    bounds = (0.6, 1.4) if bounded else (0.01, 10.0)
    gain = Parameter("gain", 1.0, bounds, per="experiment")
    edge = 0.8 if bounded else 10.0
    offset = Parameter("offset", 0.1, (-edge, edge), per="experiment")
    return Curves(formula, (*shared, gain, offset), TIMES, measured)


@pytest.mark.parametrize("bounded", [False, True])
def test_enough_experiments_for_blocks_end_where_scipy_sees_no_better_point(bounded):
    runner, space, blocks = many(110, bounded).solve()
    assert space.size == 5 + 220
    assert blocks.ending is Ending.CONVERGED
    whole = ScipyLeastSquares(algorithm="dogbox")
    (theirs,) = runner.run([SearchRequest("whole", whole, space.starting_at(blocks.x))])
    assert blocks.cost == pytest.approx(theirs.cost, rel=1e-12)
    np.testing.assert_allclose(blocks.x, theirs.x, atol=1e-6)
    held = [np.minimum(s.x - space.lower, space.upper - s.x) < 1e-9 for s in (blocks, theirs)]
    np.testing.assert_array_equal(*held)
    assert held[0].sum() > 10 if bounded else not held[0].any()


@pytest.mark.slow
def test_intervals_from_a_jacobian_that_is_too_large_for_one_array():
    """A slope that all share and an offset of each: their variances are known."""
    count, times = 1100, np.linspace(0.0, 1.0, 7)
    truth = np.random.default_rng(5).normal(size=(count, 8))
    measured = [2.0 * times + row[0] + 0.1 * row[1:] for row in truth]
    parameters = Parameter("slope", 1.0), Parameter("offset", 0.0, per="experiment")
    lines = Curves(lambda t, v, e: v[0] * t + v[1], parameters, times, measured)
    runner, space, solution = lines.solve(LeastSquares(trials=1))
    assert solution.jacobian is None
    assert solution.block_jacobian is not None
    noise = solution.cost / (7 * count - count - 1)
    spread = 1.0 / (count * np.sum((times - times.mean()) ** 2))
    expected = [spread, *[1.0 / 7.0 + times.mean() ** 2 * spread] * count]
    found = [each.std_error for each in examine(runner, space, solution).intervals]
    np.testing.assert_allclose(found, np.sqrt(noise * np.array(expected)), rtol=1e-5)


def test_directions_are_measured_again_where_the_jacobian_is_in_blocks(monkeypatch):
    def twice(times, values, experiment):
        shared, one, other = values
        return shared * times + (one + other) * np.cos(times + experiment)

    parameters = (
        Parameter("k", 1.0),
        Parameter("one", 0.3, per="experiment"),
        Parameter("other", 0.6, per="experiment"),
    )
    measured = [twice(TIMES, [2.0, 0.5, 0.5 * e], e) + 0.01 * TIMES**2 for e in range(8)]
    monkeypatch.setattr("cluster_est.methods.block_matrix.LEAST_SIZE", 10)
    monkeypatch.setattr("cluster_est.methods.differences.LARGE_JACOBIAN", 0)
    runner, space, blocks = Curves(twice, parameters, TIMES, measured).solve()
    found = examine(runner, space, blocks)
    assert blocks.jacobian is None
    assert [d.kind for d in found.directions] == ["undetermined"] * 8
    assert {d.labels for d in found.directions} == {
        (f"one[e{e}]", f"other[e{e}]") for e in range(8)
    }
    assert np.isfinite(found.intervals[0].std_error)
    assert all(np.isnan(each.std_error) for each in found.intervals[1:])
