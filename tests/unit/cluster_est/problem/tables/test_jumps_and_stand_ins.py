import tomllib

import numpy as np
import pytest
from scipy.signal import lfilter

import cluster_est as ce
from cluster_est.errors import DataError
from cluster_est.problem.tables.jumps import count_jumps, jump_findings, jump_times
from cluster_est.problem.tables.stand_ins import stand_ins, written

TIMES = 0.01 * np.arange(400)
STEPS = np.repeat(np.random.default_rng(3).uniform(-1.0, 1.0, 8), 50)
BINARY = np.repeat(np.sign(np.random.default_rng(7).standard_normal(200)), 2)
HOURS = np.linspace(0.0, 24.0, 300)
ROOM = 21.0 + 1.2 * np.sin(2.0 * np.pi * HOURS / 24.0)
NOISY = np.random.default_rng(8).standard_normal(400)
POINTS = np.sort(np.concatenate([np.arange(12.0), [2.99, 6.99]]))
SIGNALS = {
    "steps": (TIMES, STEPS, 7),
    "small, shifted steps": (1e3 * TIMES, 1e-9 * (STEPS + 5.0), 7),
    "large, falling steps": (1e3 * TIMES, -1e9 * STEPS, 7),
    "a binary sequence with the clock of the record": (TIMES, BINARY, (np.diff(BINARY) != 0).sum()),
    "a staircase": (TIMES[:300], np.repeat([0.0, 1.0, 2.0, 3.0, 2.0, 1.0], 50), 5),
    "smooth": (TIMES, np.sin(TIMES), 0),
    "constant": (TIMES, np.ones(400), 0),
    "the steps of a converter": (TIMES, np.round(np.sin(TIMES) / 0.02) * 0.02, 0),
    "a ramp between two values that it keeps": (TIMES, np.clip(TIMES, 1.0, 2.0), 0),
    "with a gap": (TIMES, np.where(np.arange(400) == 9, np.nan, STEPS), 0),
    "noise": (TIMES, np.random.default_rng(4).standard_normal(400), 0),
    "a room's temperature on a display": (HOURS, np.round(ROOM / 0.5) * 0.5, 0),
    "the same on a finer one": (HOURS, np.round(ROOM / 0.3) * 0.3, 0),
    "steps on a sine, of which one is small": (TIMES, np.sin(3.0 * TIMES) + STEPS, 6),
    "steps on a ramp with noise": (TIMES, TIMES + STEPS + 0.002 * NOISY, 6),
    "a staircase on a ramp": (TIMES[:300], TIMES[:300] + np.repeat(np.arange(6.0), 50), 5),
    "spikes on a sine": (TIMES, np.sin(TIMES) + 2.0 * (np.arange(400) % 90 == 50), 0),
    "a sine that is sampled coarsely": (TIMES, np.sin(150.0 * TIMES), 0),
    "answers to steps": (TIMES, lfilter([0.2], [1.0, -0.8], STEPS), 0),
    "one step on a sine": (TIMES, np.sin(TIMES) + (TIMES > 2.0), 0),
    "a walk": (TIMES, np.cumsum(NOISY), 0),
    # straight lines are meant: the two points of a ramp are closer than the others
    "a ramp with points of its own": (
        POINTS,
        1.0 + 3.0 * (POINTS >= 3.0) - 2.0 * (POINTS >= 7.0),
        0,
    ),
}


@pytest.mark.parametrize("signal", SIGNALS)
def test_the_jumps_of_steps_are_counted_and_others_have_none(signal):
    times, values, count = SIGNALS[signal]
    assert count_jumps(times, values) == count


def test_what_is_held_already_needs_no_note():
    outputs = (ce.Output("y", TIMES, TIMES, 1.0),)

    def notes(how, holds=(), columns=()):
        given = (ce.Input("u", TIMES, STEPS, how),)
        runs = [ce.Experiment(f"run {i}", 0.0, 4.0, given, outputs) for i in range(2)]
        return jump_findings(runs, holds.__contains__, dict(columns))

    assert notes("hold") == ()
    assert notes("linear", holds="u") == ()
    ((said, do),) = notes("linear")
    largest = int(np.argmax(np.abs(np.diff(STEPS))))
    at, levels = TIMES[largest], STEPS[[largest, largest + 1]]
    where = f"from {levels[0]:.4g} to {levels[1]:.4g} at t = {at:g} s in 'run 0'"
    assert said.startswith(
        "input u jumps between samples in experiments 'run 0' (7 times) and 'run 1' (7 times); the "
        f"largest jump is {where}; linear interpolation"
    )
    assert 'inputs.u = { column = "COLUMN", interpolation = "hold" }' in do
    ((said, do),) = notes("linear", columns=[("inputs.u", 'set "point"')])
    assert '(column "set \\"point\\"") jumps between samples' in said
    assert (
        tomllib.loads(do.partition("set ")[2].partition(" in the exp")[0])["inputs"]["u"]["column"]
        == 'set "point"'
    )


@pytest.mark.parametrize(("interpolation", "early"), [("linear", 0.01), ("hold", 0.0)])
def test_a_jump_begins_where_the_signal_begins_to_change(interpolation, early):
    """Between two samples it is a ramp, unless it is held."""
    at = jump_times(ce.Input("u", TIMES, STEPS, interpolation))
    np.testing.assert_allclose(at, 0.5 * np.arange(1, 8) - early)


def test_what_keeps_no_value_has_no_jumps():
    assert not len(jump_times(ce.Input("u", TIMES, np.sin(TIMES))))


RNG = np.random.default_rng(5)
SAMPLED = 0.02 * np.arange(500)
WAVE = 0.3 * np.sin(3.0 * SAMPLED) + 0.001 * RNG.standard_normal(500)
NOISE = RNG.standard_normal(500)


def with_values(signal, *pairs):
    changed = np.array(signal, float)
    for rows, value in pairs:
        changed[rows] = value
    return changed


HOLES = slice(10, 13)
SINGLE = float(np.float32(9.9e37))
MISSING = {
    "three of -9999": (with_values(WAVE, (HOLES, -9999.0)), [-9999.0]),
    "one of -9999": (with_values(WAVE, (10, -9999.0)), [-9999.0]),
    "65535": (with_values(WAVE, (HOLES, 65535.0)), [65535.0]),
    "-32768": (with_values(100.0 + 20.0 * WAVE, (400, -32768.0)), [-32768.0]),
    "9.9e37": (with_values(WAVE, ([3, 99], 9.9e37)), [9.9e37]),
    "9.9e37 in single precision": (with_values(WAVE, (HOLES, SINGLE)), [SINGLE]),
    "two kinds": (with_values(WAVE, (HOLES, -9999.0), (80, 9999.0)), [-9999.0, 9999.0]),
    "beside an outlier": (with_values(WAVE, (HOLES, -9999.0), (80, 2e4)), [-9999.0]),
    "in a constant": (with_values(0.0 * WAVE + 5.0, (HOLES, -999.0)), [-999.0]),
    "at the start": (with_values(WAVE, (slice(0, 200), -9999.0)), [-9999.0]),
    "any number, now and then": (with_values(20.0 + WAVE, (HOLES, 0.0), ([90, 200], 0.0)), [0.0]),
    "beside empty cells": (with_values(WAVE, (HOLES, -9999.0), (30, np.nan)), [-9999.0]),
}
PEAK = 1.0 / np.sqrt((1.0 - (SAMPLED / 5.0) ** 2) ** 2 + (0.002 * SAMPLED) ** 2)
HIT = np.where(np.arange(500) % 100 == 50, 5.0, 0.0) + 0.01 * NOISE
MEASURED = {
    "a wave": WAVE,
    "a saturated sensor": np.clip(WAVE, -0.2, 0.2),
    "a converter at its end": np.clip(np.round(2e5 * WAVE), -32768, 32767),
    "a counter up to 65535": np.linspace(0.0, 65535.0, 500),
    "a constant": np.full(500, 5.0),
    "a constant of 9999": np.full(500, -9999.0),
    "a quantised signal": np.round(WAVE / 0.05) * 0.05,
    "a switch": 1.0 * (NOISE > 1.5),
    "a switch of full scale": 32767.0 * (NOISE > 1.5),
    "steps": np.repeat([0.0, 1.0, 2.0, 40.0, 1.0], 100),
    "a supply that is switched on": np.where(SAMPLED < 1.0, 0.0, 12.0 + 0.01 * NOISE),
    "one that is off for a while": np.where(abs(SAMPLED - 5.0) < 0.3, 0.0, 12.0 + 0.01 * NOISE),
    "a resonance": PEAK,
    "impacts": HIT,
    "one impact": with_values(WAVE, (100, 30.0)),
    "noise": NOISE,
    "heavy tails": RNG.standard_cauchy(500),
    "very few samples": np.array([0.0, 1.0, -9999.0]),
    "large values": with_values(1e4 * WAVE, (HOLES, 999.0)),
}


@pytest.mark.parametrize("name", MISSING)
def test_what_is_no_measurement_is_found(name):
    values, expected = MISSING[name]
    assert [each.value for each in stand_ins(values)] == expected


@pytest.mark.parametrize("name", MEASURED)
def test_what_may_well_be_measured_is_not(name):
    assert stand_ins(MEASURED[name]) == ()


def test_it_is_counted_and_compared():
    (found,) = stand_ins(MISSING["three of -9999"][0])
    rest = np.delete(WAVE, np.r_[HOLES])
    assert (found.count, found.samples) == (3, 500)
    assert (found.low, found.high) == (rest.min(), rest.max())


@pytest.mark.parametrize("value", [-9999.0, 65535.0, 2147483647.0, 9.9e37, SINGLE, -999.25, 1e38])
def test_a_number_is_written_so_that_it_leaves_itself_out(value):
    (given,) = tomllib.loads(f"missing = [{written(value)}]")["missing"]
    columns = {"t": SAMPLED, "y": with_values(WAVE, (HOLES, value))}
    run = ce.Experiment.from_table(columns, id="a", time="t", outputs=["y"], missing=[given])
    np.testing.assert_array_equal(run.outputs[0].values, np.delete(WAVE, np.r_[HOLES]))


def test_missing_numbers_are_those_of_the_file_and_no_times():
    """They are left out before a column is changed, and its mean is that of the others."""
    times = np.array([0.0, 9999.0, 2e4, 3e4])
    columns = {"t": times, "u": [1.0, 9999.0, 2.0, 3.0], "y": [4.0, 8.0, 9999.0, 6.0]}
    given = {"inputs": ["u"], "outputs": ["y"], "columns": {"y": {"factor": 2.0, "demean": True}}}
    run = ce.Experiment.from_table(columns, id="a", time="t", missing=9999.0, **given)
    assert run.inputs[0].times.tolist() == [0.0, 2e4, 3e4]
    assert run.outputs[0].times.tolist() == [0.0, 9999.0, 3e4]
    assert run.outputs[0].values.tolist() == [-4.0, 4.0, 0.0]


def test_samples_are_left_out_by_their_times():
    columns = {"t": SAMPLED, "y": WAVE, "z": WAVE}
    left_out = {"y": [SAMPLED[3], SAMPLED[7] * (1.0 + 1e-14)]}
    run = ce.Experiment.from_table(columns, id="a", time="t", outputs=["y", "z"], left_out=left_out)
    np.testing.assert_array_equal(run.outputs[0].times, np.delete(SAMPLED, [3, 7]))
    np.testing.assert_array_equal(run.outputs[1].times, SAMPLED)


@pytest.mark.parametrize(
    ("left_out", "said"),
    [
        ({"w": [1.0]}, r"left_out\.w: must be one of the outputs"),
        (
            {"y": [-5.0]},
            r"left_out\.y: must be the times of samples, but there is no sample at -5 s",
        ),
        ({"y": ["x"]}, r"left_out\.y\[0\]"),
    ],
)
def test_what_names_no_sample_is_refused(left_out, said):
    columns = {"t": SAMPLED, "y": WAVE}
    with pytest.raises(DataError, match=said):
        ce.Experiment.from_table(columns, id="a", time="t", outputs=["y"], left_out=left_out)


@pytest.mark.parametrize("given", ["x", [float("nan")], [None], {1: 2}])
def test_what_is_no_list_of_numbers_is_refused(given):
    columns = {"t": SAMPLED, "y": WAVE}
    with pytest.raises(DataError, match=r"experiment 'a'\.missing"):
        ce.Experiment.from_table(columns, id="a", time="t", outputs=["y"], missing=given)


def test_words_in_an_order_are_no_numbers():
    columns = {"t": SAMPLED[:12], "y": ["low", "mid", "high"] * 4}
    given = {"y": {"column": "y", "ordinal": ["low", "mid", "high"]}}
    run = ce.Experiment.from_table(columns, id="a", time="t", outputs=given, missing=[2])
    assert len(run.outputs[0].values) == 12
