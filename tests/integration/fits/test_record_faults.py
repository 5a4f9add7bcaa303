"""Records with one thing wrong; the data are SciPy's, and what is wrong was put in by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim
from support.problems.springs import FMU, TRUE

import cluster_est as ce
from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.record_faults.find import TESTS, too_few_records, with_column

TIMES = 0.02 * np.arange(300)
ONE = ce.Resources(workers=1)
NOISE = 0.003


def measured(pushed, x=0.0, v=0.0):
    """Position and velocity of a mass on a spring."""
    m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]
    system = StateSpace(
        [[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], np.eye(2), np.zeros((2, 1))
    )
    return lsim(system, pushed, TIMES, X0=[x, v])[1].T


def springs(change=lambda number, pushed, y: (pushed, y), count=4):
    """Records of a spring; `change` puts something wrong into what was written down."""
    runs = []
    for number in range(count):
        generator = np.random.default_rng([5, number])
        pushed = np.repeat(generator.uniform(-3.0, 3.0, 12), 25)
        pushed = np.interp(TIMES, TIMES[::5], pushed[::5])
        y = measured(pushed)[0] + NOISE * generator.standard_normal(300)
        pushed, y = change(number, pushed, y)
        given, output = ce.Input("F", TIMES, pushed), ce.Output("y", TIMES, y, NOISE)
        runs.append(ce.Experiment(f"run {number}", 0.0, TIMES[-1], (given,), (output,)))
    solver = ce.Solver("dormand_prince")
    model = ce.Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ("m", "k", "c"))
    starts = {"m": (1.0, 0.2, 5.0), "k": (25.0, 5.0, 120.0), "c": (0.5, 0.05, 5.0)}
    return ce.Problem(
        model,
        [ce.Parameter(name, g, bounds=(low, high)) for name, (g, low, high) in starts.items()],
        runs,
    )


def only(wrong, which=2):
    """Let something be wrong in one record alone."""
    return lambda number, pushed, y: wrong(pushed, y) if number == which else (pushed, y)


def late(pushed, y):
    return pushed, np.interp(TIMES - 0.1, TIMES, y)


def elsewhere(pushed, y):
    return pushed, y + measured(np.zeros(300), x=0.05)[0]


ODD = {
    "gain": (lambda pushed, y: (pushed, 1.3 * y), 1.3, "factor = 0.76"),
    "offset": (lambda pushed, y: (pushed, y + 0.04), 0.04, "offset = -0.0"),
    "sign": (lambda pushed, y: (pushed, -y), -1.0, "factor = -1"),
    "delay": (late, 0.1, "{ late = 0."),
    "unit": (lambda pushed, y: (pushed, 1000.0 * y), 1000.0, "factor = 0.001"),
    "initial state": (elsewhere, 0.05, "values.x = 0.0"),
}
"""By kind: what is wrong, its size, and words of the key that mends it."""


@pytest.mark.parametrize("kind", ODD)
def test_the_odd_record_is_named_with_what_mends_it(kind):
    wrong, size, key = ODD[kind]
    found = ce.fit(springs(only(wrong)), resources=ONE)
    (fault,) = found.record_faults
    assert (fault.kind, fault.experiment) == (kind, "run 2")
    assert fault.size == pytest.approx(size, rel=0.08)
    assert fault.before > 2.0
    assert fault.after < 1.3
    assert found.notes[0] == fault.sentence
    assert key in fault.sentence
    assert found.facts()["record_faults"][0]["experiment"] == "run 2"


def test_what_was_mended_is_right():
    gain = ce.fit(springs(only(ODD["gain"][0])), resources=ONE)
    (fault,) = gain.record_faults
    mended = springs(only(lambda pushed, y: (pushed, 1.3 * fault.factor * y)))
    assert not ce.fit(mended, resources=ONE).record_faults
    healthy = ce.fit(springs(), resources=ONE)
    assert not healthy.record_faults
    assert healthy.simulated < gain.simulated


def test_a_foreign_source_has_another_frequency_in_each_record():
    def hum(number, pushed, y):
        frequency = 2.4 + 0.4 * number
        return pushed, y + 0.03 * np.sin(2.0 * np.pi * frequency * TIMES + number)

    (fault,) = ce.fit(springs(hum), resources=ONE).record_faults
    assert fault.kind == "foreign source"
    assert fault.frequencies == pytest.approx((2.4, 3.6), abs=0.02)
    assert "in no input" in fault.sentence


def test_a_line_of_one_frequency_or_in_an_input_is_no_foreign_source():
    def hum(number, pushed, y):
        return pushed, y + 0.03 * np.sin(2.0 * np.pi * 3.0 * TIMES + number)

    assert not ce.fit(springs(hum), resources=ONE).record_faults


def test_an_effect_that_shows_in_one_record_is_no_fault_of_it():
    """A spring that grows stiffer, in the one record with large forces."""

    def stiffer(number, pushed, y):
        if number != 1:
            return pushed, y
        m, k, c = TRUE["m"], TRUE["k"], TRUE["c"]
        x, v, found = 0.0, 0.0, []
        for force in 4.0 * pushed:
            found.append(x)
            for _ in range(20):
                v += 0.001 * (force - k * x - 60.0 * x**3 - c * v) / m
                x += 0.001 * v
        return 4.0 * pushed, np.array(found) + NOISE * np.random.default_rng(1).standard_normal(300)

    found = ce.fit(springs(stiffer), resources=ONE)
    assert found.rmse("train") > 2.0
    assert not found.record_faults


def test_two_records_say_nothing_of_which_is_odd():
    found = ce.fit(springs(only(ODD["gain"][0], which=1), count=2), resources=ONE)
    assert not found.record_faults
    (note,) = [each for each in found.notes if "training experiments" in each]
    assert "cannot be distinguished from a missing effect" in note
    assert note.endswith("to look for one, measure more experiments")


def test_a_note_names_test_experiments_that_would_show_which_record_is_odd():
    def roles(problem, *roles):
        runs = zip(problem.experiments, roles, strict=True)
        return replace(problem, experiments=tuple(replace(run, role=role) for run, role in runs))

    odd = springs(only(ODD["gain"][0], which=1))
    found = ce.fit(roles(odd, "train", "train", "test", "test"), resources=ONE)
    assert any(each.endswith('set role = "train" for run 2') for each in found.notes)
    (note,) = too_few_records(roles(odd, "train", "test", "test", "test"))
    assert note.endswith('set role = "train" for run 1 and run 2')
    (note,) = too_few_records(roles(springs(count=2), "train", "test"))
    assert note.endswith('set role = "train" for run 1 and measure more experiments')
    assert too_few_records(roles(odd, "train", "train", "train", "test")) == ()
    right = ce.fit(roles(springs(), "train", "train", "test", "test"), resources=ONE)
    assert not any("training experiments" in each for each in right.notes)


def test_a_loop_says_it_first_and_looks_for_no_effect():
    found = ce.close_loop(springs(only(ODD["gain"][0])), resources=ONE)
    assert found.verdict == "unexplained"
    assert found.message.startswith("check the record of experiment run 2 first")
    assert found.facts()["first"] == found.first == "correct the records"
    assert not found.effects
    assert not found.findings


def test_numbers_that_are_no_measurements_are_said_first_and_left_out_of_a_loop():
    def sentinel(pushed, y):
        y = y.copy()
        y[100:105] = -9999.0
        return pushed, y

    problem = springs(only(sentinel))
    assert "-9999" in ce.fit(problem, resources=ONE).notes[0]
    found = ce.close_loop(problem, resources=ONE)
    assert found.message.startswith("check the records first: output y is -9999")
    assert found.verdict == "none"
    assert found.after.x["k"] == pytest.approx(TRUE["k"], rel=0.02)


def test_the_tests_have_names_of_their_own():
    assert len({each.name for each in TESTS}) == len(TESTS)


def test_an_output_that_is_compared_up_to_scale_is_not_tested():
    problem = springs(only(ODD["gain"][0]))
    runs = [
        replace(run, outputs=tuple(replace(o, free_scale=True) for o in run.outputs))
        for run in problem.experiments
    ]
    assert not ce.fit(replace(problem, experiments=tuple(runs)), resources=ONE).record_faults


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (["t_min", "t_min"], "columns.t_min = { factor = 60 } corrects it"),
        (["t_min", "t"], "or a sample_time multiplied by 60, corrects it"),
        ([None], "or a sample_time multiplied by 60, corrects it"),
        ([], "or a sample_time multiplied by 60, corrects it"),
    ],
)
def test_times_in_a_wrong_unit_are_corrected_in_the_time_column(times, said):
    fault = RecordFault("unit", "", "times", ("times",), 1 / 60, 9.0, 1.0, factor=60.0)
    tables = [SimpleNamespace(time=time) for time in times]
    fitted = SimpleNamespace(problem=SimpleNamespace(tables=tables, columns={}))
    assert said in with_column(fitted, fault).sentence
