"""Signals that keep their value and jump."""

import tomllib

import numpy as np
import pytest

import cluster_est as ce
from cluster_est.problem.tables.jumps import count_jumps, jump_findings, jump_times

TIMES = 0.01 * np.arange(400)
STEPS = np.repeat(np.random.default_rng(3).uniform(-1.0, 1.0, 8), 50)
BINARY = np.repeat(np.sign(np.random.default_rng(7).standard_normal(200)), 2)
HOURS = np.linspace(0.0, 24.0, 300)
ROOM = 21.0 + 1.2 * np.sin(2.0 * np.pi * HOURS / 24.0)
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
    assert said.startswith("input u keeps its value and jumps 14 times; straight lines")
    assert 'inputs.u = { column = "COLUMN", interpolation = "hold" }' in do
    ((_, do),) = notes("linear", columns=[("inputs.u", 'set "point"')])
    assert tomllib.loads(do.partition(", if")[0])["inputs"]["u"]["column"] == 'set "point"'


@pytest.mark.parametrize(("interpolation", "early"), [("linear", 0.01), ("hold", 0.0)])
def test_a_jump_begins_where_the_signal_begins_to_change(interpolation, early):
    """Between two samples it is a ramp, unless it is held."""
    at = jump_times(ce.Input("u", TIMES, STEPS, interpolation))
    np.testing.assert_allclose(at, 0.5 * np.arange(1, 8) - early)


def test_what_keeps_no_value_has_no_jumps():
    assert not len(jump_times(ce.Input("u", TIMES, np.sin(TIMES))))
