"""Constraints on signals and parameters, from a config to numbers checked by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.spoiled import valid_tree

from cluster_est.config.constraints import (
    constraint_functions,
    parameter_constraints,
    signal_bounds,
)
from cluster_est.config.reader import Config, parse_config
from cluster_est.config.signal_limits import snapped_bound
from cluster_est.config.user_code import UserCode
from cluster_est.errors import ClusterEstError, ConfigError
from workers.messages import Output, SignalBound
from workers.residuals.base import SimulatedOutputs
from workers.residuals.bounds import SignalBounds

PARAMETERS = ("m", "k")
STEP = {"initial": 1.0, "final": 3.0, "time": 1.0, "rise_time": 2.0, "settling_time": 4.0}


def config(*constraints: dict[str, Any]) -> Config:
    return parse_config(valid_tree() | {"constraints": list(constraints)}, "c.toml")


def bounds(start: float = 0.0, stop: float = 10.0, **keys: Any) -> SignalBound:
    parameter_constraints(config({"signal": "y", **keys}), PARAMETERS)
    (found,) = signal_bounds(config({"signal": "y", **keys}), "a", start, stop)
    return found


def at(bound: SignalBound, t: float) -> tuple[float, float]:
    """The limits at a time that is checked."""
    (i,) = np.flatnonzero(np.abs(bound.times - t) < 1e-12)
    return float(bound.lower[i]), float(bound.upper[i])


def violations(bound: SignalBound, signal: Any) -> dict[str, float]:
    """By name, of y = signal(t), simulated at the times that are checked."""
    record = np.asarray(signal(bound.times), float)[None, :, None] * np.ones((1, 1, 1))
    simulated = SimulatedOutputs(bound.times, (bound.variable,), record, np.zeros((1, 1)))
    values = SignalBounds((bound,)).compare(simulated).values
    assert values.shape == (1, len(bound.names))
    return dict(zip(bound.names, values[0].tolist(), strict=True))


def test_a_number_holds_all_the_time():
    bound = bounds(lower=-1, upper=2.5)
    assert bound.names == ("y lower", "y upper")
    assert (bound.times[0], bound.times[-1], len(bound.times)) == (0.0, 10.0, 200)
    assert set(bound.lower) == {-1.0}
    assert set(bound.upper) == {2.5}
    assert bound.scale == 2.5
    found = violations(bound, lambda t: t - 2.0)
    assert found == {"y lower": (-1.0 + 2.0) / 2.5, "y upper": (8.0 - 2.5) / 2.5}


def test_one_side_alone():
    assert bounds(lower=3.0).names == ("y lower",)
    assert bounds(upper=-3.0).names == ("y upper",)
    assert bounds(upper=-3.0).scale == 3.0
    assert bounds(upper=0.0).scale == 1.0
    assert bounds(upper=-3.0, scale=0.5).scale == 0.5
    found = violations(bounds(upper=-3.0, scale=0.5), lambda t: 0.0 * t)
    assert found == {"y upper": 6.0}


def test_satisfied_limits_say_by_how_much():
    assert violations(bounds(upper=4.0), lambda t: 0.0 * t + 1.0) == {"y upper": -0.75}
    assert violations(bounds(lower=4.0), lambda t: 0.0 * t + 6.0) == {"y lower": -0.5}


def test_limits_over_time_are_straight_between_points_and_absent_outside():
    bound = bounds(upper=[[2.0, 1.0], [4.0, 5.0], [8.0, 5.0]], samples=11)
    assert set(range(11)) <= set(bound.times.tolist())
    assert at(bound, 1.0)[1] == np.inf
    assert at(bound, 2.0)[1] == 1.0
    assert at(bound, 3.0)[1] == 3.0
    assert at(bound, 6.0)[1] == 5.0
    assert at(bound, 9.0)[1] == np.inf
    assert np.all(bound.lower == -np.inf)
    found = violations(bound, lambda t: np.where((t == 2.0) | (t > 8.0), 9.0, 0.0))
    assert found == {"y upper": (9.0 - 1.0) / 5.0}


def test_points_of_limits_are_checked_even_between_samples():
    bound = bounds(lower=[[0.0, 0.0], [np.pi, 2.0], [9.0, 0.0]], upper=[[1.2345, 7], [2.5, 7]])
    for t in (np.pi, 9.0, 1.2345, 2.5):
        assert t in bound.times
    assert at(bound, np.pi) == (2.0, np.inf)
    assert np.all(np.diff(bound.times) > 0.0)


def test_points_beyond_the_simulation_are_not_simulated():
    bound = bounds(upper=[[-5.0, 0.0], [15.0, 20.0]], stop=10.0)
    assert (bound.times[0], bound.times[-1]) == (0.0, 10.0)
    assert at(bound, 0.0)[1] == 5.0
    assert at(bound, 10.0)[1] == 15.0


def test_a_limit_may_jump():
    bound = bounds(upper=[[0.0, 1.0], [5.0, 1.0], [5.0, 3.0], [10.0, 3.0]], samples=3)
    assert at(bound, 0.0)[1] == 1.0
    assert at(bound, 10.0)[1] == 3.0


@pytest.mark.parametrize(
    ("between", "expected"),
    [([2.0, 3.0], (2.0, 3.0)), ([-1.0, 3.0], (0.0, 3.0)), ([9.0, 99.0], (9.0, 10.0))],
)
def test_between_is_cut_to_the_simulation(between, expected):
    bound = bounds(upper=1.0, between=between, samples=5)
    assert (bound.times[0], bound.times[-1]) == expected
    np.testing.assert_allclose(bound.times, np.linspace(*expected, 5))


@pytest.mark.parametrize(
    ("t", "lower", "upper"),
    [
        (0.9, -np.inf, np.inf),  # before the step
        (1.0, 1.0 - 0.02, 3.0 + 0.2),  # 1 % undershoot and 10 % overshoot of a step by 2
        (2.9, 1.0 - 0.02, 3.2),
        (3.0, 1.0 + 0.8 * 2.0, 3.2),  # 80 % of it after the rise time
        (4.9, 2.6, 3.2),
        (5.0, 3.0 - 0.02, 3.0 + 0.02),  # 1 % after the settling time
        (10.0, 2.98, 3.02),
    ],
)
def test_the_envelope_of_a_rising_step(t, lower, upper):
    bound = bounds(step_response=STEP, samples=101)
    np.testing.assert_allclose(at(bound, t), (lower, upper), rtol=1e-14)
    assert bound.names == ("y lower", "y upper")
    assert bound.scale == pytest.approx(3.2)


@pytest.mark.parametrize(
    ("t", "lower", "upper"),
    [
        (0.9, -np.inf, np.inf),
        (1.0, 1.0 - 0.1 * 2.0, 3.0 + 0.01 * 2.0),
        (3.0, 0.8, 3.0 - 0.8 * 2.0),
        (5.0, 0.98, 1.02),
    ],
)
def test_the_envelope_of_a_falling_step(t, lower, upper):
    bound = bounds(step_response=STEP | {"initial": 3.0, "final": 1.0}, samples=101)
    np.testing.assert_allclose(at(bound, t), (lower, upper), rtol=1e-14)


def test_the_percentages_of_a_step():
    step = {"final": 10.0, "rise_time": 1.0, "rise": 50.0, "settling_time": 2.0, "settling": 20.0,
            "overshoot": 30.0, "undershoot": 5.0}  # fmt: skip
    bound = bounds(step_response=step, samples=11)
    np.testing.assert_allclose(at(bound, 0.0), (-0.5, 13.0))
    np.testing.assert_allclose(at(bound, 1.0), (5.0, 13.0))
    np.testing.assert_allclose(at(bound, 2.0), (8.0, 12.0))


def test_a_first_order_response_meets_the_envelope_it_was_made_for():
    """1 - exp(-t) rises to 80 % at t = ln 5 and settles to 1 % at t = ln 100."""

    def response(t):
        return 1.0 - np.exp(-t)

    step = {"final": 1.0, "rise_time": np.log(5.0), "settling_time": np.log(100.0)}
    good = violations(bounds(step_response=step), response)
    assert max(good.values()) <= 1e-12
    assert good["y lower"] == pytest.approx(0.0, abs=1e-12)  # it touches both
    for key, factor in (("rise_time", 0.95), ("settling_time", 0.95)):
        hurried = violations(bounds(step_response=step | {key: factor * step[key]}), response)
        assert hurried["y lower"] > 1e-3
        assert hurried["y upper"] <= 0.0


def test_the_moments_of_a_step_are_checked_even_between_samples():
    bound = bounds(step_response=STEP, samples=4)
    for t in (1.0, 3.0, 5.0):
        assert t in bound.times
    odd = bounds(step_response=STEP | {"time": 1.1, "rise_time": 2.3}, samples=2)
    assert at(odd, 1.1 + 2.3)[0] == pytest.approx(2.6)
    late = bounds(step_response=STEP, samples=4, stop=4.0)
    assert late.times[-1] == 4.0


def test_a_final_value_without_tolerance_is_an_equality():
    bound = bounds(final=5.0)
    assert (bound.times.tolist(), bound.equality, bound.scale) == ([10.0], True, 5.0)
    assert bound.names == ("final y",)
    assert violations(bound, lambda t: 0.0 * t + 4.0) == {"final y": -0.2}


def test_a_final_value_with_tolerance_has_two_sides():
    bound = bounds(final=-5.0, tolerance=0.5)
    assert not bound.equality
    found = violations(bound, lambda t: 0.0 * t - 6.0)
    assert found == {"final y lower": pytest.approx(0.1), "final y upper": pytest.approx(-0.3)}


def test_a_final_value_of_zero():
    assert bounds(final=0.0).scale == 1.0
    assert bounds(final=0.0, tolerance=0.25).scale == 0.25


def tracked(start: float = 0.0, stop: float = 10.0, **keys: Any) -> tuple[SignalBound, ...]:
    section = config({"signal": "y", **keys})
    parameter_constraints(section, PARAMETERS)
    times = np.array([0.0, 2.0, 4.0, 6.0])
    measured = (Output("z", times, times), Output("y", times, np.array([1.0, -2.0, 3.0, 0.0])))
    return signal_bounds(section, "a", start, stop, measured)


def test_tracking_is_a_band_around_the_measured_values():
    (bound,) = tracked(tracking={"absolute": 0.5, "relative": 0.1})
    assert bound.times.tolist() == [0.0, 2.0, 4.0, 6.0]
    np.testing.assert_allclose(bound.lower, [0.4, -2.7, 2.2, -0.5])
    np.testing.assert_allclose(bound.upper, [1.6, -1.3, 3.8, 0.5])


def test_tracking_on_one_side():
    (bound,) = tracked(tracking={"absolute": 0.5, "side": "upper"})
    assert len(bound.names) == 1
    assert np.all(bound.lower == -np.inf)
    np.testing.assert_allclose(bound.upper, [1.5, -1.5, 3.5, 0.5])


def test_tracking_in_a_part_of_the_time():
    (bound,) = tracked(tracking={"absolute": 0.5}, between=[1.0, 4.0])
    assert bound.times.tolist() == [2.0, 4.0]


def test_tracking_exactly_is_an_equality():
    (bound,) = tracked(tracking={})
    assert bound.equality
    np.testing.assert_array_equal(bound.lower, [1.0, -2.0, 3.0, 0.0])


def test_only_in_the_experiments_that_are_named():
    tree = valid_tree()
    tree["experiments"].append({**tree["experiments"][0], "id": "b"})
    tree["constraints"] = [
        {"signal": "y", "upper": 1.0, "experiments": ["b"]},
        {"signal": "v", "upper": 2.0},
    ]
    found = parse_config(tree, "c.toml")
    parameter_constraints(found, PARAMETERS)
    assert [b.variable for b in signal_bounds(found, "a", 0.0, 1.0)] == ["v"]
    assert [b.variable for b in signal_bounds(found, "b", 0.0, 1.0)] == ["y", "v"]


def test_names_of_the_users():
    assert bounds(name="box", lower=0.0, upper=1.0).names == ("box lower", "box upper")
    assert bounds(name="end", final=1.0).names == ("end",)


def test_expressions_have_their_scale_and_name():
    found = parameter_constraints(
        config(
            {"expression": "m <= k"},
            {"name": "ratio", "expression": "0 <= m/k <= 2", "scale": 10.0},
        ),
        PARAMETERS,
    )
    assert [(c.name, c.scale, c.equality) for c in found] == [
        ("m <= k", 1.0, False), ("ratio (lower)", 10.0, False), ("ratio (upper)", 10.0, False)
    ]  # fmt: skip


def test_functions_are_found_for_their_experiments(tmp_path):
    (tmp_path / "rules.py").write_text("def rule(run):\n    return 1.0\n")
    code = UserCode(tmp_path, allowed=True)
    section = config(
        {"function": "rules:rule"},
        {"function": "rules:rule", "equality": True, "name": "balance"},
        {"function": "rules:rule", "experiments": ["a"]},
    )
    parameter_constraints(section, PARAMETERS)
    found = constraint_functions(section, "a", code)
    assert [(f.name, f.equality, f.label) for f in found] == [
        ("rule", False, ""), ("rule", True, "balance"), ("rule", False, "")
    ]  # fmt: skip
    assert len(constraint_functions(section, "b", code)) == 2


@pytest.mark.parametrize(
    ("keys", "phrase"),
    [
        ({}, "constraints[0]: must have one of expression, signal and function but has none"),
        (
            {"signal": "y", "expression": "m <= k", "upper": 1},
            "constraints[0]: must have one of expression, signal and function but has expression "
            "and signal",
        ),
        ({"signal": "y"}, "constraints[0].signal: must have a limit but has none; add lower,"),
        ({"name": "box", "signal": "y"}, "constraints[box].signal: must have a limit"),
        ({"signal": "y", "step_response": STEP, "upper": 1}, ".step_response: must stand alone"),
        ({"signal": "y", "final": 1, "upper": 1}, "constraints[0].final: must stand alone"),
        (
            {"signal": "y", "upper": 1, "experiments": ["b"]},
            "constraints[0].experiments: there is no 'b'; it has 'a'",
        ),
        ({"expression": "m <= k", "upper": 1}, "constraints[0].upper: must be left out beside"),
        ({"expression": "m <= k", "equality": True}, "constraints[0].equality: must be left out"),
        ({"expression": "m <= k", "experiments": ["a"]}, "constraints[0].experiments: must be"),
        ({"signal": "y", "upper": 1, "equality": True}, "constraints[0].equality: must be left"),
        ({"signal": "y", "upper": 1, "tolerance": 0.1}, ".tolerance: must be beside final"),
        ({"signal": "y", "final": 1, "between": [0, 1]}, ".between: must be left out beside"),
        ({"function": "a:b", "scale": 2}, "constraints[0].scale: must be left out beside"),
        ({"function": "a:b", "lower": 2}, "constraints[0].lower: must be left out beside"),
        ({"signal": "q", "tracking": {}}, "constraints[0].signal: must be measured in some"),
        ({"expression": "m"}, "constraints[0].expression: must be two formulas"),
        ({"expression": "m <= q"}, "constraints[0].expression: 'q' has the unknown variable 'q'"),
    ],
)
def test_a_constraint_of_no_kind_is_refused(keys, phrase):
    with pytest.raises(ClusterEstError) as refused:
        parameter_constraints(config(keys), PARAMETERS)
    assert phrase in str(refused.value)


@pytest.mark.parametrize(
    ("keys", "phrase"),
    [
        ({"upper": 1, "between": [11, 12]}, ".between: must overlap with the simulation, 0 to 10"),
        ({"upper": 1, "between": [4, 3]}, ".between: must"),
        ({"lower": 2, "upper": 1}, "constraints[0].lower: must not be above upper but is at 0 s"),
        (
            {"lower": [[0, 0], [10, 5]], "upper": 2},
            "constraints[0].lower: must not be above upper but is at 4.0",
        ),
        ({"upper": [[1, 0], [0, 1]]}, "constraints[0].upper: its times must not go back"),
        (
            {"upper": [[20, 0], [30, 1]]},
            "constraints[0].upper: must limit the signal at some time from 0 to 10 s but does not",
        ),
        ({"lower": 0, "upper": [[20, 5], [30, 6]]}, "constraints[0].upper: must limit the signal"),
        ({"step_response": STEP | {"time": 11}}, ".step_response: must limit the signal at some"),
    ],
)
def test_limits_that_cannot_be_are_refused(keys, phrase):
    with pytest.raises(ConfigError) as refused:
        bounds(**keys)
    assert phrase in str(refused.value)


POINTS = st.lists(st.tuples(st.floats(-2.0, 12.0), st.floats(-3.0, 3.0)), min_size=2, max_size=5)


@given(POINTS, st.integers(2, 30), st.floats(-4.0, 4.0), st.floats(-1.0, 1.0))
def test_the_largest_violation_is_the_largest_over_all_times(points, samples, offset, slope):
    points = sorted(dict(points).items())
    if len(points) < 2 or points[0][0] > 10.0 or points[-1][0] < 0.0:
        return
    try:
        bound = bounds(upper=[list(p) for p in points], samples=samples, scale=1.0)
    except ConfigError as error:
        assert "must limit the signal" in str(error)  # noqa: PT017
        return
    (found,) = violations(bound, lambda t: offset + slope * t).values()
    by_hand = [
        offset + slope * t - np.interp(t, *np.array(points).T)
        for t in bound.times.tolist()
        if points[0][0] <= t <= points[-1][0]
    ]
    assert found == pytest.approx(max(by_hand), abs=1e-12)


def test_times_that_fall_together_on_a_measured_one_are_one_with_the_tighter_limits():
    later = np.nextafter(0.3, 1.0)
    band = SignalBound("b", "y", [0.0, 0.3, later, 1.0], [0, 1, 2, 0], [9, 8, 7, np.inf])
    found = snapped_bound(band, np.array([0.3, 0.6]))
    assert found.times.tolist() == [0.0, 0.3, 1.0]
    assert found.lower.tolist() == [0.0, 2.0, 0.0]
    assert found.upper.tolist() == [9.0, 7.0, np.inf]


def test_where_limits_jump_at_a_measured_time_the_later_ones_hold():
    later = np.nextafter(0.3, 1.0)
    stairs = SignalBound("b", "y", [0.0, 0.3, later], [0, 0, 5], [3, 3, 8])
    found = snapped_bound(stairs, np.array([later]))
    assert (found.times.tolist(), at(found, 0.3)) == ([0.0, later], (5.0, 8.0))
