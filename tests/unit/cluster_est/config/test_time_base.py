"""Measured signals on a time base: truth by hand, by NumPy and by plain loops."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster_est.config.time_base import compared_at, counted, snapped, weighted
from workers.messages import Output

FAST = Output("x", np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.0, 10.0, 20.0, 10.0, 0.0]))
SLOW = Output("T", np.array([0.5, 2.0, 3.5]), np.array([1.0, 4.0, 2.0]), 0.5)
NOTHING = np.zeros(0)


def rows(output: Output) -> dict[float, float]:
    return dict(zip(output.times.tolist(), output.values.tolist(), strict=True))


def both_on(base, how="linear", simulated=NOTHING):
    return compared_at([FAST, SLOW], [how, how], base, simulated)


def test_measured_leaves_everything_as_it_is():
    assert both_on("measured", simulated=np.arange(4.0)) == (FAST, SLOW)


def test_union_of_signals_with_different_sampling():
    fast, slow = both_on("union")
    assert rows(fast) == {0.0: 0.0, 0.5: 5.0, 1.0: 10.0, 2.0: 20.0, 3.0: 10.0, 3.5: 5.0, 4.0: 0.0}
    # a straight line from 1 at 0.5 to 4 at 2, then to 2 at 3.5; nothing before or after
    assert list(rows(slow)) == [0.5, 1.0, 2.0, 3.0, 3.5]
    np.testing.assert_allclose(slow.values, [1.0, 2.0, 4.0, 4.0 - 2.0 / 1.5, 2.0])


def test_union_of_held_signals_keeps_the_last_sample():
    fast, slow = both_on("union", "hold")
    assert rows(fast) == {0.0: 0.0, 0.5: 0.0, 1.0: 10.0, 2.0: 20.0, 3.0: 10.0, 3.5: 10.0, 4.0: 0.0}
    assert rows(slow) == {0.5: 1.0, 1.0: 1.0, 2.0: 4.0, 3.0: 4.0, 3.5: 2.0}


def test_each_output_is_interpolated_in_its_own_way():
    fast, slow = compared_at([FAST, SLOW], ["hold", "linear"], "union", NOTHING)
    assert rows(fast)[0.5] == 0.0
    assert rows(slow)[1.0] == 2.0


def test_simulated_times_alone():
    fast, slow = both_on("simulated", simulated=np.array([0.0, 0.75, 1.5, 2.25, 3.0, 3.75]))
    assert rows(fast) == {0.0: 0.0, 0.75: 7.5, 1.5: 15.0, 2.25: 17.5, 3.0: 10.0, 3.75: 2.5}
    np.testing.assert_allclose(slow.times, [0.75, 1.5, 2.25, 3.0])
    np.testing.assert_allclose(slow.values, np.interp(slow.times, SLOW.times, SLOW.values))


def test_both_is_the_union_of_all_times():
    simulated = np.array([0.25, 1.0, 4.5])
    fast, slow = both_on("both", simulated=simulated)
    assert fast.times.tolist() == [0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 3.5, 4.0]
    assert slow.times.tolist() == [0.5, 1.0, 2.0, 3.0, 3.5]


def test_sigma_stays():
    assert [o.sigma for o in both_on("both", simulated=np.arange(4.0))] == [1.0, 0.5]


@st.composite
def signals(draw):
    count = draw(st.integers(1, 3))
    found = []
    for i in range(count):
        times = draw(st.lists(st.integers(0, 40), min_size=1, max_size=8, unique=True))
        values = draw(st.lists(st.floats(-9.0, 9.0), min_size=len(times), max_size=len(times)))
        found.append(Output(f"y{i}", np.array(sorted(times)) / 4.0, np.array(values)))
    hows = [draw(st.sampled_from(["linear", "hold"])) for _ in range(count)]
    simulated = np.array(sorted(draw(st.sets(st.integers(0, 60), max_size=9)))) / 6.0
    return found, hows, simulated


def by_hand(output, how, t):
    """The signal at t, sample by sample."""
    pairs = list(zip(output.times.tolist(), output.values.tolist(), strict=True))
    before = [pair for pair in pairs if pair[0] <= t]
    after = [pair for pair in pairs if pair[0] >= t]
    (t0, y0), (t1, y1) = before[-1], after[0]
    if how == "hold" or t0 == t1:
        return y0
    return y0 + (y1 - y0) * (t - t0) / (t1 - t0)


@given(signals(), st.sampled_from(["union", "simulated", "both"]))
def test_every_base_against_a_loop_over_samples(case, base):
    outputs, hows, simulated = case
    union = {t for output in outputs for t in output.times.tolist()}
    times = {
        "union": union,
        "simulated": set(simulated.tolist()),
        "both": union | set(simulated.tolist()),
    }[base]
    for output, how, found in zip(
        outputs, hows, compared_at(outputs, hows, base, simulated), strict=True
    ):
        wanted = sorted(t for t in times if output.times[0] <= t <= output.times[-1])
        assert found.times.tolist() == wanted
        truth = [by_hand(output, how, t) for t in wanted]
        np.testing.assert_allclose(found.values, truth, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("step", [0.1, 0.3, 0.02, 1e-3, 0.7])
def test_times_that_differ_by_rounding_alone_are_one(step):
    """A file says 0.9 where three steps of 0.3 are 0.8999999999999999."""
    written = np.array([float(f"{i * step:.10g}") for i in range(200)])
    simulated = np.arange(200) * step
    output = Output("y", written, np.arange(200.0))
    both = compared_at([output], ["linear"], "both", simulated)[0]
    assert len(both.times) == 200
    held = compared_at([output], ["hold"], "simulated", simulated)[0]
    np.testing.assert_array_equal(held.values, np.arange(200.0))


def test_snapping_moves_nothing_that_is_another_time():
    onto = np.array([0.0, 0.3, 1e6])
    times = np.array([-1.0, 0.1 + 0.2, 0.3 + 1e-8, 5.0, 1e6 - 1e-4, 2e6])
    found = snapped(times, onto)
    assert found.tolist() == [-1.0, 0.3, 0.3 + 1e-8, 5.0, 1e6 - 1e-4, 2e6]
    assert snapped(times, NOTHING).tolist() == times.tolist()


@given(st.floats(0.0, 4.0), st.floats(0.0, 4.0))
def test_only_what_lies_between_first_and_last_counts(a, b):
    kept = counted(FAST, a, b, ())
    assert rows(kept) == {t: y for t, y in rows(FAST).items() if a <= t <= b}


@pytest.mark.parametrize(
    ("windows", "times"),
    [
        ([], [0.0, 1.0, 2.0, 3.0, 4.0]),
        ([(0.5, 2.0)], [1.0, 2.0]),
        ([(1.0, 1.0)], [1.0]),
        ([(0.0, 1.0), (3.0, 9.0)], [0.0, 1.0, 3.0, 4.0]),
        ([(0.0, 2.0), (1.0, 3.0)], [0.0, 1.0, 2.0, 3.0]),
        ([(2.1, 2.9)], []),
    ],
)
def test_windows(windows, times):
    assert counted(FAST, -math.inf, math.inf, windows).times.tolist() == times


def test_warm_up_and_windows_together():
    kept = counted(FAST, 1.5, math.inf, [(0.0, 3.0)])
    assert rows(kept) == {2.0: 20.0, 3.0: 10.0}


@pytest.mark.parametrize(("normalise", "size"), [("sigma", 0.5), ("max", 20.0), ("range", 20.0)])
def test_what_residuals_are_divided_by(normalise, size):
    output = replace(FAST, sigma=0.5)
    assert weighted(output, normalise, 1.0).sigma == size
    assert weighted(output, normalise, 4.0).sigma == size / 2.0
    assert weighted(output, normalise, 0.25).sigma == size * 2.0


def test_normalising_a_signal_that_is_negative_or_constant():
    shifted = replace(FAST, values=FAST.values - 50.0)
    assert weighted(shifted, "max", 1.0).sigma == 50.0
    assert weighted(shifted, "range", 1.0).sigma == 20.0
    flat = replace(FAST, values=np.full(5, -3.0))
    assert weighted(flat, "max", 1.0).sigma == 3.0
    assert weighted(flat, "range", 1.0).sigma == 1.0
    zero = replace(FAST, values=np.zeros(5))
    assert weighted(zero, "max", 1.0).sigma == 1.0
    empty = replace(FAST, times=NOTHING, values=NOTHING)
    assert weighted(empty, "range", 1.0).sigma == 1.0


@given(st.floats(0.01, 100.0), st.floats(-5.0, 5.0))
def test_a_weight_counts_squares_as_often(weight, simulated):
    plain, twice = (weighted(FAST, "max", w) for w in (1.0, weight))
    squares = [float(np.sum(((o.values - simulated) / o.sigma) ** 2)) for o in (plain, twice)]
    assert squares[1] == pytest.approx(weight * squares[0], rel=1e-12)
