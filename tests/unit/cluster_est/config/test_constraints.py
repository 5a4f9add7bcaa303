"""Constraints on signals and parameters, from a config to numbers checked by hand."""

import numpy as np
import pytest
from support.spoiled import REMOVED, write_input

from cluster_est import read_problem
from workers.residuals.comparison import SimulatedOutputs
from workers.residuals.experiment_residuals import SignalBounds

A = "experiments.0"
INF = np.inf
UNMEASURED = {f"{A}.{key}": REMOVED for key in ("data", "time", "inputs", "outputs")}
STEP = {"initial": 1.0, "final": 3.0, "time": 1.0, "rise_time": 2.0, "settling_time": 4.0}


@pytest.fixture
def build(tmp_path):
    """A problem with constraints."""

    def call(*constraints, rows="", **changes):
        given = {"constraints": list(constraints), **changes}
        path = write_input(tmp_path, given, *([rows] if rows else []))
        return read_problem(path, allow_code=True)

    return call


@pytest.fixture
def bounds(build):
    """The limits of y in a simulation from 0 to 10 s without measured times."""

    def call(**keys):
        changes = {**UNMEASURED, f"{A}.start": 0.0, f"{A}.stop": 10.0}
        (found,) = build({"signal": "y", **keys}, **changes).experiments[0].bounds
        return found

    return call


def violations(bound, signal):
    """By name, of y = signal(t), simulated at the times that are checked."""
    record = np.asarray(signal(bound.times), float)[None, :, None] * np.ones((1, 1, 1))
    simulated = SimulatedOutputs(bound.times, (bound.variable,), record, np.zeros((1, 1)))
    values = SignalBounds((bound,)).compare(simulated).values
    assert values.shape == (1, len(bound.names))
    return dict(zip(bound.names, values[0].tolist(), strict=True))


@pytest.mark.parametrize(
    ("keys", "scale", "signal", "expected"),
    [
        ({"lower": -1, "upper": 2.5}, 2.5, lambda t: t - 2, {"y lower": 0.4, "y upper": 2.2}),
        ({"lower": 4.0}, 4.0, lambda t: 0 * t + 6, {"y lower": -0.5}),
        ({"upper": 4.0}, 4.0, lambda t: 0 * t + 1, {"y upper": -0.75}),
        ({"upper": -3.0}, 3.0, lambda t: 0 * t, {"y upper": 1.0}),
        ({"upper": 0.0}, 1.0, lambda t: 0 * t + 2, {"y upper": 2.0}),
        ({"upper": -3.0, "scale": 0.5}, 0.5, lambda t: 0 * t, {"y upper": 6.0}),
        ({"final": 5.0}, 5.0, lambda t: 0 * t + 4, {"final y": -0.2}),
        ({"final": 0.0}, 1.0, lambda t: t, {"final y": 10.0}),
        ({"final": 0.0, "tolerance": 0.25}, 0.25, lambda t: 0 * t, {
            "final y lower": -1.0, "final y upper": -1.0}),
        ({"final": -5.0, "tolerance": 0.5}, 5.0, lambda t: 0 * t - 6, {
            "final y lower": 0.1, "final y upper": -0.3}),
        ({"name": "box", "lower": 0, "upper": 1}, 1.0, lambda t: 0 * t, {
            "box lower": 0.0, "box upper": -1.0}),
        ({"name": "end", "final": 1.0}, 1.0, lambda t: 0 * t, {"end": -1.0}),
    ],
)  # fmt: skip
def test_a_violation_is_counted_over_the_size_of_its_limit(bounds, keys, scale, signal, expected):
    bound = bounds(**keys)
    assert bound.scale == scale
    assert violations(bound, signal) == pytest.approx(expected)
    assert bound.equality == ("final" in keys and "tolerance" not in keys)
    if "final" in keys:
        assert bound.times.tolist() == [10.0]
    else:
        assert (bound.times[0], bound.times[-1], len(bound.times)) == (0.0, 10.0, 200)


RISING = {
    0.9: (-INF, INF),  # before the step
    1.0: (1.0 - 0.02, 3.0 + 0.2),  # 1 % undershoot and 10 % overshoot of a step by 2
    2.9: (1.0 - 0.02, 3.2),
    3.0: (1.0 + 0.8 * 2.0, 3.2),  # 80 % of it after the rise time
    4.9: (2.6, 3.2),
    5.0: (3.0 - 0.02, 3.0 + 0.02),  # 1 % after the settling time
    10.0: (2.98, 3.02),
}
FALLING = {0.9: (-INF, INF), 1.0: (0.8, 3.02), 3.0: (0.8, 1.4), 5.0: (0.98, 1.02)}
PERCENT = {"final": 10.0, "rise_time": 1.0, "rise": 50.0, "settling_time": 2.0, "settling": 20.0}
LIMITS = [
    (
        {"upper": [[2, 1], [4, 5], [8, 5]], "samples": 11},
        {1: (-INF, INF), 2: (-INF, 1), 3: (-INF, 3), 6: (-INF, 5), 9: (-INF, INF)},
    ),
    ({"upper": [[-5, 0], [15, 20]]}, {0: (-INF, 5), 10: (-INF, 15)}),
    (
        {"upper": [[0, 1], [5, 1], [5, 3], [10, 3]], "samples": 3},
        {0: (-INF, 1), 10: (-INF, 3)},
    ),
    (
        {"lower": [[0, 0], [3.1, 2], [9, 0]], "upper": [[1.23, 7], [2.5, 7]]},
        {3.1: (2, INF), 1.23: (2 * 1.23 / 3.1, 7), 2.5: (2 * 2.5 / 3.1, 7), 9: (0, INF)},
    ),
    ({"step_response": STEP, "samples": 101}, RISING),
    ({"step_response": STEP | {"initial": 3.0, "final": 1.0}, "samples": 101}, FALLING),
    (
        {"step_response": PERCENT | {"overshoot": 30.0, "undershoot": 5.0}, "samples": 11},
        {0: (-0.5, 13), 1: (5, 13), 2: (8, 12)},
    ),
    (
        {"step_response": STEP | {"time": 1.1, "rise_time": 2.3}, "samples": 2},
        {1.1: (0.98, 3.2), 1.1 + 2.3: (2.6, 3.2), 10: (2.98, 3.02)},
    ),
]


@pytest.mark.parametrize(("keys", "limits"), LIMITS)
def test_limits_over_time(bounds, keys, limits):
    """Straight between points, absent outside; also where no sample is but the limit bends."""
    bound = bounds(**keys)
    assert np.all(np.diff(bound.times) > 0.0)
    assert (bound.times[0], bound.times[-1]) == (0.0, 10.0)
    for t, expected in limits.items():
        (i,) = np.flatnonzero(np.abs(bound.times - t) < 1e-12)
        np.testing.assert_allclose((bound.lower[i], bound.upper[i]), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("between", "expected"),
    [([2.0, 3.0], (2.0, 3.0)), ([-1.0, 3.0], (0.0, 3.0)), ([9.0, 99.0], (9.0, 10.0))],
)
def test_between_is_cut_to_the_simulation(bounds, between, expected):
    bound = bounds(upper=1.0, between=between, samples=5)
    np.testing.assert_allclose(bound.times, np.linspace(*expected, 5))


UPPER = {"absolute": 0.5, "side": "upper"}


@pytest.mark.parametrize(
    ("keys", "times", "lower", "upper"),
    [
        (
            {"tracking": {"absolute": 0.5, "relative": 0.1}},
            [0, 2, 4, 6],
            [0.4, -2.7, 2.2, -0.5],
            [1.6, -1.3, 3.8, 0.5],
        ),
        ({"tracking": UPPER}, [0, 2, 4, 6], [-INF] * 4, [1.5, -1.5, 3.5, 0.5]),
        ({"tracking": {"absolute": 0.5}, "between": [1.0, 4.0]}, [2, 4], [-2.5, 2.5], [-1.5, 3.5]),
        ({"tracking": {}}, [0, 2, 4, 6], [1, -2, 3, 0], [1, -2, 3, 0]),
    ],
)
def test_tracking_is_a_band_around_the_measured_values(build, keys, times, lower, upper):
    rows = "time,force,position\n0,1,1\n2,1,-2\n4,0,3\n6,0,0\n"
    (bound,) = build({"signal": "y", **keys}, rows=rows).experiments[0].bounds
    assert bound.times.tolist() == times
    np.testing.assert_allclose(bound.lower, lower)
    np.testing.assert_allclose(bound.upper, upper)
    assert bound.equality == (keys["tracking"] == {})
    assert len(bound.names) == (1 if bound.equality or -INF in lower else 2)


LATER = np.nextafter(0.3, 1.0).item()


@pytest.mark.parametrize(
    ("measured", "keys", "times", "lower", "upper"),
    [
        (
            (0.3, 0.6, 1.0),
            {
                "lower": [[0, 0], [0.3, 1], [LATER, 2], [1, 0]],
                "upper": [[0, 9], [0.3, 8], [LATER, 7]],
            },
            [0.0, 0.3, 1.0],
            [0.0, 2.0, 0.0],
            [9.0, 7.0, INF],
        ),
        (
            (LATER,),
            {"lower": [[0, 0], [0.3, 0], [LATER, 5]], "upper": [[0, 3], [0.3, 3], [LATER, 8]]},
            [0.0, LATER],
            [0.0, 5.0],
            [3.0, 8.0],
        ),
    ],
    ids=["the tighter limits hold", "the later ones where limits jump"],
)
def test_times_that_fall_together_are_one(build, measured, keys, times, lower, upper):
    rows = "".join(f"{t!r},0,0\n" for t in (0.0, *measured))
    problem = build({"signal": "y", "samples": 2, **keys}, rows=f"time,force,position\n{rows}")
    (bound,) = problem.experiments[0].bounds
    assert (bound.times.tolist(), bound.lower.tolist()) == (times, lower)
    assert bound.upper.tolist() == upper


def test_only_in_the_experiments_that_are_named(tmp_path, build):
    (tmp_path / "rules.py").write_text("def rule(run):\n    return 1.0\n")
    a = {"id": "a", "data": "a.csv", "time": "time", "outputs": {"y": "position"}}
    problem = build(
        {"signal": "y", "upper": 1.0, "experiments": ["b"]},
        {"signal": "v", "upper": 2.0},
        {"function": "rules:rule", "equality": True, "name": "balance"},
        {"function": "rules:rule", "experiments": ["a"]},
        experiments=[a, {**a, "id": "b"}],
    )
    first, second = problem.experiments
    assert [b.variable for b in first.bounds] == ["v"]
    assert [b.variable for b in second.bounds] == ["y", "v"]
    rules = [(f.name, f.equality, f.label) for f in first.constraint_functions]
    assert rules == [("rule", True, "balance"), ("rule", False, "")]
    assert len(second.constraint_functions) == 1


def test_expressions_have_their_scale_and_name(build):
    ratio = {"name": "ratio", "expression": "0 <= m/k <= 2", "scale": 10.0}
    found = build({"expression": "m <= k"}, ratio).constraints
    assert [(c.name, c.scale, c.equality) for c in found] == [
        ("m <= k", 1.0, False), ("ratio (lower)", 10.0, False), ("ratio (upper)", 10.0, False)
    ]  # fmt: skip
