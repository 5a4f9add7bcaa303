import tomllib

import numpy as np
import pytest

import cluster_est as ce
from cluster_est.problem.tables.jumps import jump_times, recorded_at_changes
from cluster_est.problem.tables.sparse_inputs import few_samples, sparse_inputs

RNG = np.random.default_rng(2)
EVEN = np.arange(0.0, 60.0, 2.0)
UNEVEN = np.cumsum(RNG.uniform(1.0, 3.0, 30))
LEVELS = RNG.uniform(-6.0, 6.0, 30).round(1)
WARM = 10.0 + 5.0 * np.sin(UNEVEN / 12.0)
SIGNALS = {
    "levels": (UNEVEN, LEVELS, True),
    "small and late": (1e4 + 1e3 * UNEVEN, 1e-9 * LEVELS, True),
    "a valve": (UNEVEN, np.arange(30) % 2.0, True),
    "gears": (UNEVEN, 1.0 + np.abs(np.arange(30) % 8 - 4.0), False),
    "levels at even times": (EVEN, LEVELS, False),
    "levels with an uneven clock": (EVEN + RNG.uniform(-0.05, 0.05, 30), LEVELS, False),
    "a thermocouple": (EVEN, 10.0 + 5.0 * np.sin(EVEN / 12.0), False),
    "a temperature that somebody wrote down": (UNEVEN, WARM, False),
    "the same with noise": (UNEVEN, WARM + 0.3 * RNG.standard_normal(30), False),
    "points of a profile": (UNEVEN, np.repeat(LEVELS[:15], 2), False),
    "a constant": (UNEVEN, np.ones(30), False),
    "few": (UNEVEN[:5], LEVELS[:5], False),
    "with an empty cell": (UNEVEN, np.where(np.arange(30) == 9, np.nan, LEVELS), False),
}


@pytest.mark.parametrize("signal", SIGNALS)
def test_a_record_of_changes_has_irregular_times_and_jumps(signal):
    times, values, expected = SIGNALS[signal]
    assert recorded_at_changes(times, values) is expected


def run(times, values, how="linear", name="run", step=0.1):
    often = np.arange(0.0, 50.0, step)
    outputs = (ce.Output("y", often, often), ce.Output("z", often[::2], often[::2]))
    return ce.Experiment(name, 0.0, 50.0, (ce.Input("u", times, values, how),), outputs)


def test_each_change_of_a_held_record_of_changes_is_a_jump():
    held = ce.Input("u", UNEVEN, LEVELS, "hold")
    np.testing.assert_array_equal(jump_times(held), UNEVEN[1:])
    assert not len(jump_times(ce.Input("u", UNEVEN, LEVELS)))
    assert not len(jump_times(ce.Input("u", UNEVEN, WARM, "hold")))


@pytest.mark.parametrize(
    ("times", "step", "sparse"),
    [
        (UNEVEN, 0.1, True),
        (EVEN, 0.1, True),
        (EVEN[::10], 0.1, True),
        (EVEN, 1.0, False),  # half as many
        (0.1 * np.arange(100.0), 0.1, False),  # as often, but it ends early
        (EVEN[:1], 0.1, False),
    ],
)
def test_few_samples_are_a_third_of_those_of_another_signal_or_less(times, step, sparse):
    each = run(times, np.resize(LEVELS, len(times)), step=step)
    assert (few_samples(each, each.inputs[0]) is not None) is sparse


def test_only_samples_in_the_simulated_time_count():
    found = few_samples(run(UNEVEN, LEVELS), run(UNEVEN, LEVELS).inputs[0])
    assert (found.samples, found.others, found.other) == (np.sum(UNEVEN <= 50.0), 500, "y")


def test_the_finding_has_all_numbers_and_a_key_that_keeps_the_clock():
    runs = [run(UNEVEN, LEVELS, name=f"run {i}") for i in range(5)]
    (found,) = sparse_inputs(runs, lambda _: False)
    said, do = found.finding({"inputs.u": "voltage", "inputs.u.time": "t_u"})
    count = int(np.sum(UNEVEN <= 50.0))
    assert said.startswith(
        f'input u (column "voltage") has {count} samples in run 0, where y has 500, {count} of 500 '
        f"in run 1, {count} of 500 in run 2, and few in 2 more experiments; its times are irregular"
    )
    given = tomllib.loads(do.partition(", if")[0])["inputs"]["u"]
    assert given == {"column": "voltage", "interpolation": "hold", "time": "t_u"}


def test_a_slow_sensor_is_told_from_a_record_of_changes():
    (slow,) = sparse_inputs([run(EVEN, np.sin(EVEN / 12.0))], lambda _: False)
    assert slow.slow
    assert not slow.at_changes
    assert "recorded only" not in slow.finding({})[0]
    (few,) = sparse_inputs([run(EVEN[::10], LEVELS[:3])], lambda _: False)
    assert not few.slow
    assert not few.at_changes
    assert sparse_inputs([run(UNEVEN, LEVELS, "hold")], lambda _: False) == ()
    assert sparse_inputs([run(UNEVEN, LEVELS)], lambda name: name == "u") == ()
