"""Inputs that are interpolated in the wrong way; the data are SciPy's, held or joined by lines."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim
from support.problems.springs import FMU, TRUE

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.loop import with_interpolation
from cluster_est.problem.thinning import ThinningSettings
from cluster_est.results.facts import interpolation_sentences
from cluster_est.results.interpolation import (
    InterpolationTest,
    PreferredInterpolation,
    with_effects_added,
)

TIMES = 0.02 * np.arange(300)
ONE = ce.Resources(workers=1)
KEY = 'inputs.F = { column = "COLUMN", interpolation = "%s" }'


def force(kind, seed):
    generator = np.random.default_rng(seed)
    steps = np.repeat(generator.uniform(-1.0, 1.0, 10), 30)
    if kind == "a sine with steps":
        return np.sin(3.0 * TIMES) + steps
    if kind == "pulses":
        return 1.0 * (np.arange(300) % 20 < 20 * (0.5 + 0.4 * np.sin(2.0 * TIMES)))
    if kind == "a staircase":
        return steps
    return np.interp(TIMES, [0.0, 1.0, 2.5, 4.0, 6.0], [0.0, 1.0, -1.0, 1.0, 0.0])


def spring(kind, truth, how, noise=0.02, seed=1):
    """Two runs of a mass on a spring, whose force is one thing and is declared to be another."""
    m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]
    system = StateSpace([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    runs = []
    for number in range(2):
        pushed = force(kind, [seed, number])
        y = lsim(system, pushed, TIMES, X0=[0.1, 0.0], interp=truth == "linear")[1]
        y = y + noise * np.std(y) * np.random.default_rng([seed, number, 1]).standard_normal(300)
        given = ce.Input("F", TIMES, pushed, how)
        outputs = (ce.Output("y", TIMES, y),)
        values = (("x", 0.1),)
        runs.append(
            ce.Experiment(f"run {number}", 0.0, TIMES[-1], (given,), outputs, values=values)
        )
    solver = ce.Solver("dormand_prince")
    model = ce.Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
    starts = {"m": (1.0, (0.1, 10.0)), "k": (25.0, (1.0, 200.0)), "c": (0.5, (0.0, 10.0))}
    return ce.Problem(model, [ce.Parameter(name, *g) for name, g in starts.items()], runs)


CASES = [
    (kind, truth, how, noise)
    for kind, noise in (
        ("a sine with steps", 0.02),
        ("pulses", 0.02),
        ("a staircase", 0.02),
        ("slow ramps", 0.01),
    )
    for truth, how in (("hold", "linear"), ("linear", "hold"))
    if (kind, how) != ("slow ramps", "linear")  # nothing jumps: no fit looks at it
]


@pytest.mark.parametrize(("kind", "truth", "how", "noise"), CASES)
def test_the_interpolation_that_the_data_prefer_is_named(kind, truth, how, noise):
    found = ce.fit(spring(kind, truth, how, noise), resources=ONE)
    assert found.interpolation is not None
    assert (found.interpolation.variable, found.interpolation.preferred) == ("F", truth)
    assert found.interpolation.share == pytest.approx(1.0, abs=4.0 * found.interpolation.error)
    (said,) = [note for note in found.notes if "fits better with input F" in note]
    assert KEY % truth in said
    assert found.facts()["interpolation"]["preferred"] == truth
    right = ce.fit(spring(kind, truth, truth, noise), resources=ONE)
    assert right.interpolation is None
    assert right.cost == pytest.approx((1.0 - found.interpolation.fall) * found.cost, rel=0.05)


def with_few_samples(truth, how, values):
    """Two runs of the spring; of its force, only some samples were recorded."""
    given = spring("a staircase", "hold", how)
    m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]
    system = StateSpace([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], [[1.0, 0.0]], [[0.0]])
    runs = []
    for number, run in enumerate(given.experiments):
        generator = np.random.default_rng([7, number])
        rows, recorded = values(generator)
        held = recorded[np.searchsorted(rows, np.arange(300), side="right") - 1]
        pushed = held if truth == "hold" else np.interp(np.arange(300), rows, recorded)
        y = lsim(system, pushed, TIMES, X0=[0.1, 0.0], interp=truth == "linear")[1]
        y = y + 0.01 * np.std(y) * generator.standard_normal(300)
        inputs = (ce.Input("F", TIMES[rows], recorded, how),)
        runs.append(replace(run, inputs=inputs, outputs=(ce.Output("y", TIMES, y),)))
    return replace(given, experiments=tuple(runs))


def changes(generator):
    """A record of changes: irregular times, and another value at each of them."""
    rows = np.concatenate([[0], np.cumsum(generator.integers(5, 30, 30))])
    return rows[rows < 300], 10.0 * generator.uniform(-1.0, 1.0, int(np.sum(rows < 300)))


def slow_sensor(generator):
    rows = np.arange(0, 300, 20)
    return rows, np.sin(0.03 * rows + generator.uniform(0.0, 6.0))


@pytest.mark.parametrize("values", [changes, slow_sensor])
@pytest.mark.parametrize("truth", ["hold", "linear"])
def test_an_input_with_few_samples_is_tested_too(values, truth):
    other = "linear" if truth == "hold" else "hold"
    found = ce.fit(with_few_samples(truth, other, values), resources=ONE)
    assert found.interpolation is not None
    assert (found.interpolation.preferred, found.interpolation.slow) == (
        truth,
        values is slow_sensor and truth == "hold",
    )
    (said,) = [note for note in found.notes if "fits better with input F" in note]
    assert ("a missing delay of about one" in said) is found.interpolation.slow
    right = ce.fit(with_few_samples(truth, truth, values), resources=ONE)
    assert right.interpolation is None
    assert right.cost < 0.1 * found.cost
    known = {each.label: each.value for each in right.estimates}
    assert known["k"] == pytest.approx(TRUE["k"], rel=0.02)


def test_the_wrong_interpolation_is_named_before_the_model():
    found = ce.fit(with_few_samples("hold", "linear", changes), resources=ONE)
    better, missing = (
        [i for i, note in enumerate(found.notes) if words in note]
        for words in ("fits better with input F", "input F has the wrong interpolation, or")
    )
    assert better < missing


def test_what_was_fitted_is_right_and_nothing_is_said():
    for seed, how in enumerate(("linear", "hold")):
        found = ce.fit(spring("a sine with steps", how, how, seed=seed), resources=ONE)
        assert found.interpolation is None
        assert not interpolation_sentences(found)
        assert found.facts()["interpolation"] is None
        assert found.linear_inputs == (("F",) if how == "linear" else ())
        assert not any("into a ramp" in note for note in found.notes)


def test_it_is_silent_where_noise_hides_it():
    found = ce.fit(spring("a sine with steps", "hold", "linear", noise=2.0), resources=ONE)
    assert found.interpolation is None
    assert found.linear_inputs == ()
    assert any("into a ramp" in note for note in found.notes)  # it may still be so


def preference(fall):
    return PreferredInterpolation("F", "hold", KEY % "hold", 1.0, 0.1, fall, 2, "run 0", 1.0)


@pytest.mark.parametrize(
    ("declared", "again", "as_good", "delayed", "left"),
    [
        (0.17, None, 0.98, "", None),  # the effects explain what the hold does, and much more
        (0.17, 0.2, 0.98, "", 0.2),
        (0.65, None, 0.64, "", 0.65),  # the effects imitate the hold
        (0.65, None, 0.98, "F", 0.65),  # one of them does
        (0.65, None, 0.98, "G", None),
        (None, 0.3, 0.9, "", 0.3),
        (None, None, 0.9, "F", None),
    ],
)
def test_the_test_at_the_model_with_effects_decides_unless_they_imitate(
    declared, again, as_good, delayed, left
):
    tests = [
        InterpolationTest(None if fall is None else preference(fall), ("G",))
        for fall in (declared, again)
    ]
    found = with_effects_added(*tests, as_good, [delayed])
    assert (None if found.preferred is None else found.preferred.fall) == left
    assert found.linear == ("G",)


@pytest.mark.parametrize(("as_good", "kept"), [(0.6, True), (0.98, False)])
def test_straight_lines_that_are_confirmed_with_a_delay_are_right(as_good, kept):
    """Unless a hold without the delay is as good."""
    declared, again = InterpolationTest(preference(0.65)), InterpolationTest(None, ("F", "G"))
    found = with_effects_added(declared, again, as_good, ["F"])
    assert found == (InterpolationTest(preference(0.65), ("G",)) if kept else again)


def test_effects_are_compared_in_the_experiments_that_show_the_preference():
    """The hold explains most of the second experiment, and the effect only the first."""
    runs = spring("a sine with steps", "hold", "linear").experiments
    large = np.random.default_rng(4).standard_normal(600)
    after = np.concatenate([0.1 * large[:300], large[300:]])
    one, both = (
        InterpolationTest(preference(0.4), (), positions).as_good_as(runs, large, after, 2)
        for positions in ((1,), (0, 1))
    )
    assert one < 0.0
    assert both > 0.4
    assert InterpolationTest().as_good_as(runs, large, after, 2) == 0.0


@pytest.mark.parametrize(("fall", "doubt"), [(0.17, True), (0.4, True), (0.6, False)])
def test_what_removes_a_small_part_of_the_error_may_imitate_an_effect(fall, doubt):
    assert ("an effect that the model lacks" in preference(fall).sentence) is doubt


@pytest.mark.parametrize(
    ("fall", "verdict", "first"),
    [
        (0.17, Verdict.PARTIAL, False),
        (0.17, Verdict.UNEXPLAINED, False),
        (0.17, Verdict.NONE, False),
        (0.17, Verdict.FOUND, True),
        (0.6, Verdict.UNEXPLAINED, True),
    ],
)
def test_an_interpolation_is_the_first_thing_to_set_only_if_little_else_is_missing(
    fall, verdict, first
):
    nothing = ce.LoopResult(
        verdict, "said", (), *2 * [None], *3 * [()], {}, (), (), 0, 0, 0, 0, 0.0
    )
    found = with_interpolation(nothing, preference(fall))
    assert ("set it first" in found.message) is first
    assert found.first == (f"set {preference(fall).key}" if first else "")
    assert found.notes == (preference(fall).sentence,)


def test_a_poor_fit_names_the_record_and_the_time_of_a_jump():
    """A motor's current answers at once; the voltage was held."""
    times = np.arange(401) * 0.005
    volts = np.where(times < 0.1, 0.0, np.where(times < 1.0, 6.0, 9.0))
    resistance, inductance, constant, inertia, friction = 1.0, 0.004, 0.05, 5e-4, 2e-4
    system = StateSpace(
        [[-resistance / inductance, -constant / inductance],
         [constant / inertia, -friction / inertia]],
        [[1.0 / inductance], [0.0]], np.eye(2), np.zeros((2, 1)),
    )  # fmt: skip
    current = lsim(system, volts, times, interp=False)[1][:, 0]
    current = current + 0.005 * np.random.default_rng(3).standard_normal(401)
    motor = FMU.with_name("dc_motor.fmu")
    model = ce.Model(
        motor.name, motor.read_bytes(), "model_exchange", ce.Solver("dormand_prince"), ("K", "J")
    )
    run = ce.Experiment(
        "the motor", 0.0, 2.0, (ce.Input("V", times, volts),),
        (ce.Output("current", times, current, 0.005),),
        values=(("R", resistance), ("L", inductance), ("b", friction)),
    )  # fmt: skip
    parameters = [ce.Parameter("K", 0.04, (0.01, 0.2)), ce.Parameter("J", 4e-4, (1e-5, 1e-2))]
    found = ce.fit(ce.Problem(model, parameters, [run]), resources=ONE)
    (other,) = interpolation_sentences(found)
    assert "fits better with input V held" in other
    assert "in experiment 'the motor' after the jump at 0.095 s" in other
    (said,) = interpolation_sentences(replace(found, interpolation=None))
    assert said.startswith("the error of current is largest just after jumps of input V")
    assert "in experiment 'the motor', after the jump at 0.095 s" in said
    assert 'inputs.V = { column = "COLUMN", interpolation = "hold" }' in said
    fine = replace(found, diagnostics=replace(found.diagnostics, outputs=(), together=None))
    assert not interpolation_sentences(replace(fine, interpolation=None))


@pytest.mark.parametrize("rows", [None, 150])
def test_a_closed_loop_says_it_first(rows):
    """On thinned records too, from all of their samples."""
    problem = spring("a sine with steps", "hold", "linear", noise=0.02)
    thinning = ThinningSettings(rows=rows) if rows else None
    found = ce.close_loop(problem, ONE, thinning=thinning)
    (said,) = [note for note in found.notes if "fits better with input F held" in note]
    assert found.notes[0] == said
    assert found.message.endswith(f". But the model fits better with {KEY % 'hold'}: set it first")
    assert KEY % "hold" in said


def test_a_closed_loop_gives_no_advice_where_straight_lines_are_right():
    found = ce.close_loop(spring("a sine with steps", "linear", "linear"), ONE)
    assert found.verdict is Verdict.NONE
    assert not any("hold" in note for note in found.notes)
