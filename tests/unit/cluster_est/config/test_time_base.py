"""Measured signals on a time base: truth by hand, by NumPy and by plain loops."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.spoiled import write_input

from cluster_est import read_problem

A = "experiments.0"
FAST = {0.0: 0.0, 1.0: 10.0, 2.0: 20.0, 3.0: 10.0, 4.0: 0.0}


@pytest.fixture
def compared(tmp_path):
    """The outputs of a config with signals that are measured at times of their own."""

    def call(signals, hows=(), **changes):
        times = sorted({t for signal in signals.values() for t in signal})
        cells = [[repr(t), *(repr(s[t]) if t in s else "" for s in signals.values())]
                 for t in times]  # fmt: skip
        rows = "\n".join(",".join(row) for row in [["time", *signals], *cells])
        hows = hows or ("linear",) * len(signals)
        outputs = {
            name: {"column": name, "interpolation": how}
            for name, how in zip(signals, hows, strict=True)
        }
        given = {f"{A}.inputs": {}, f"{A}.outputs": outputs, **changes}
        return read_problem(write_input(tmp_path, given, f"{rows}\n")).experiments[0].outputs

    return call


def rows(output):
    return dict(zip(output.times.tolist(), output.values.tolist(), strict=True))


NAMES = ["y", "v", "x"]


@st.composite
def signals(draw):
    """Measured signals, how they are interpolated, and the step of the simulated times."""
    found = {}
    for name in NAMES[: draw(st.integers(1, 3))]:
        times = draw(st.lists(st.integers(0, 40), min_size=2, max_size=8, unique=True))
        values = draw(st.lists(st.floats(-9.0, 9.0), min_size=len(times), max_size=len(times)))
        found[name] = dict(zip((np.array(sorted(times)) / 4.0).tolist(), values, strict=True))
    hows = tuple(draw(st.sampled_from(["linear", "hold"])) for _ in found)
    return found, hows, draw(st.integers(1, 16)) / 8.0


def by_hand(signal, how, t):
    """The signal at t, sample by sample."""
    (t0, y0) = [pair for pair in signal.items() if pair[0] <= t][-1]
    (t1, y1) = next(pair for pair in signal.items() if pair[0] >= t)
    if how == "hold" or t0 == t1:
        return y0
    return y0 + (y1 - y0) * (t - t0) / (t1 - t0)


@pytest.mark.parametrize("base", ["measured", "union", "simulated", "both"])
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(case=signals())
def test_every_base_against_a_loop_over_samples(compared, base, case):
    """An output counts between its first and its last sample, interpolated in its own way."""
    measured, hows, step = case
    union = {t for signal in measured.values() for t in signal}
    start, stop = min(union), max(union)
    simulated = {start + i * step for i in range(200) if start + i * step <= stop}
    wanted = {"union": union, "simulated": simulated, "both": union | simulated}
    cost = {"cost": {"time_base": base, "step": step}, f"{A}.start": start, f"{A}.stop": stop}
    inside = [
        [t for t in sorted(wanted.get(base, s)) if min(s) <= t <= max(s)] for s in measured.values()
    ]
    for output, how, times in zip(compared(measured, hows, **cost), hows, inside, strict=True):
        signal = measured[output.variable]
        assert output.times.tolist() == times
        truth = [by_hand(signal, how, t) for t in times]
        np.testing.assert_allclose(output.values, truth, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("step", [0.1, 0.3, 0.02, 1e-3, 0.7])
@pytest.mark.parametrize(("base", "how"), [("both", "linear"), ("simulated", "hold")])
def test_times_that_differ_by_rounding_alone_are_one(compared, step, base, how):
    """A file says 0.9 where three steps of 0.3 are 0.8999999999999999."""
    written = {float(f"{i * step:.10g}"): float(i) for i in range(200)}
    (output,) = compared({"y": written}, (how,), cost={"time_base": base, "step": step})
    np.testing.assert_array_equal(output.values, np.arange(200.0))


def test_times_that_differ_by_more_are_two(compared):
    cost = {"time_base": "both", "step": 0.3}
    (output,) = compared({"y": {0.0: 0.0, 0.3 + 1e-8: 1.0, 1e6: 0.0}}, cost=cost,
                         **{f"{A}.stop": 1.0})  # fmt: skip
    assert output.times.tolist() == [0.0, 0.3, 0.3 + 1e-8]


@pytest.mark.parametrize(
    ("keys", "times"),
    [
        ({}, [0.0, 1.0, 2.0, 3.0, 4.0]),
        ({"start": 0.5, "stop": 3.0}, [1.0, 2.0, 3.0]),
        ({"windows": [[0.5, 2.0]]}, [1.0, 2.0]),
        ({"windows": [[1.0, 1.0]]}, [1.0]),
        ({"windows": [[0.0, 1.0], [3.0, 9.0]]}, [0.0, 1.0, 3.0, 4.0]),
        ({"windows": [[0.0, 2.0], [1.0, 3.0]]}, [0.0, 1.0, 2.0, 3.0]),
        ({"windows": [[0.0, 3.0]], "warm_up": 1.5}, [2.0, 3.0]),
    ],
)
def test_only_what_lies_in_the_windows_and_after_the_warm_up_counts(compared, keys, times):
    (output,) = compared({"y": FAST}, **{f"{A}.{key}": value for key, value in keys.items()})
    assert rows(output) == {t: FAST[t] for t in times}


@pytest.mark.parametrize(("weight", "share"), [(1.0, 1.0), (4.0, 0.5), (0.25, 2.0)])
@pytest.mark.parametrize(
    ("values", "sizes"),
    [
        (list(FAST.values()), {"sigma": 0.5, "max": 20.0, "range": 20.0}),
        ([-50.0, -40.0, -30.0, -40.0, -50.0], {"sigma": 0.5, "max": 50.0, "range": 20.0}),
        ([-3.0] * 5, {"max": 3.0, "range": 1.0}),
        ([0.0] * 5, {"max": 1.0, "range": 1.0}),
    ],
)
def test_what_residuals_are_divided_by(compared, values, sizes, weight, share):
    """So that squares count as often as the weight says."""
    signal = dict(zip(FAST, values, strict=True))
    for normalise, size in sizes.items():
        cost = {"normalise": normalise, "weights": {"y": weight}}
        (output,) = compared({"y": signal}, cost=cost, **{f"{A}.sigma": {"y": 0.5}})
        assert output.sigma == size * share
        assert output.has_sigma == (normalise == "sigma" and output.sigma != 1.0)


@pytest.mark.parametrize(
    ("keys", "known"),
    [
        ({f"{A}.sigma": {"y": 0.5}}, True),
        ({f"{A}.sigma": {"y": 0.5}, f"{A}.weight": 4.0}, True),
        ({f"{A}.sigma": {"y": 0.5}, f"{A}.sigma_known": False}, False),
        ({f"{A}.weight": 4.0}, False),
        ({"cost": {"weights": {"y": 4.0}}}, False),
        ({}, False),
    ],
)
def test_only_a_given_sigma_is_knowledge_of_the_noise(compared, keys, known):
    (output,) = compared({"y": FAST}, **keys)
    assert output.has_sigma is known
