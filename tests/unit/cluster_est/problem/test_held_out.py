from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.errors import DataError
from workers.messages import Curve, Experiment, Output

NOISE = 0.005
END = [(2.0, 3.0)]


def truth():
    return spring_problem(experiments=1, noise=NOISE)


def split(windows, spoiled=0.0):
    """One record of 3 s, with windows that are held out and may have been spoiled before."""
    problem = truth().problem
    (run,) = problem.experiments
    (y,) = run.outputs
    inside = np.any([(y.times >= a) & (y.times <= b) for a, b in windows], axis=0)
    run = replace(run, outputs=(replace(y, values=y.values + spoiled * inside),))
    return replace(problem, experiments=run.hold_out(windows))


@pytest.fixture(scope="module")
def ended():
    """The fit of a record whose end is held out."""
    return ce.fit(split(END))


def test_the_held_out_part_is_predicted_from_the_same_start(ended):
    labels = [each.label for each in ended.estimates if each.parameter == "x0"]
    assert labels == ["x0[e0]"]
    assert {each.estimated_on for each in ended.estimates} == {"train"}
    assert ended.x["x0[e0]"] == pytest.approx(truth().values["x0[e0]"], abs=0.01)
    frequency = np.sqrt([ended.x["k"] / ended.x["m"], TRUE["k"] / TRUE["m"]])
    assert frequency[0] == pytest.approx(frequency[1], rel=0.01)
    errors = {each.experiment: each for each in ended.errors}
    assert errors["e0"].role == "train"
    assert errors["e0 (held out)"].role == "test"
    assert errors["e0 (held out)"].rmse_after == pytest.approx(NOISE, rel=0.3)


def test_what_is_held_out_changes_no_bit_of_the_estimates(ended):
    spoiled = ce.fit(split(END, spoiled=100.0))
    assert ended.x == spoiled.x
    assert ended.cost == spoiled.cost
    assert spoiled.errors[-1].rmse_after > 99.0


@pytest.mark.parametrize("windows", [END, [(0.5, 0.7), (1.5, 2.0)], [(0.0, 0.0)]])
def test_every_sample_is_in_one_part(windows):
    (run,) = truth().problem.experiments
    train, test = run.hold_out(windows)
    (y,), (kept,), (held,) = run.outputs, train.outputs, test.outputs
    assert np.sort(np.concatenate([kept.times, held.times])).tolist() == y.times.tolist()
    assert all(any(a <= t <= b for a, b in windows) for t in held.times)
    assert not any(a <= t <= b for a, b in windows for t in kept.times)
    assert held.values.tolist() == [y.values[y.times.tolist().index(t)] for t in held.times]


def test_training_is_not_simulated_beyond_its_last_value():
    (run,) = truth().problem.experiments
    train, test = run.hold_out(END)
    assert train.stop == train.outputs[0].times[-1] < 2.0
    assert test.stop == run.stop
    middle, _ = run.hold_out([(1.0, 2.0)])
    assert middle.stop == run.stop


def test_what_belongs_to_the_whole_course_stays_with_the_training():
    (run,) = truth().problem.experiments
    points = np.array([[0.0, 0.0], [1.0, 1.0]])
    curve = Curve(("y", "v"), points, run.outputs[0].times, (0.0, 0.0))
    train, test = replace(run, curve=curve).hold_out(END)
    assert train.curve is not None
    assert train.stop == run.stop
    assert test.curve is None


def test_a_value_of_a_held_out_experiment_of_its_own_is_said_to_be_fitted_to_it(ended):
    problem = spring_problem(experiments=2, noise=NOISE).problem
    first, second = problem.experiments
    apart = ce.fit(replace(problem, experiments=(first, replace(second, role="test"))))
    said = "x0 (value for 'e1') was fitted to the held-out data, because no training experiment"
    assert any(said in note for note in apart.notes)
    assert not any("held-out" in note for note in ended.notes)


def two_outputs():
    times = np.arange(4.0)
    return Experiment(
        "run", 0.0, 3.0, (), (Output("a", times, times), Output("b", times[:2], times[:2]))
    )


def test_an_output_may_have_nothing_in_a_window():
    train, test = two_outputs().hold_out([(2.0, 3.0)])
    assert [len(output.times) for output in train.outputs] == [2, 2]
    assert [len(output.times) for output in test.outputs] == [2, 0]


@pytest.mark.parametrize(
    ("windows", "said"),
    [
        ([(5.0, 6.0)], "must leave at least one measured value within the windows"),
        ([(0.0, 3.0)], "must leave at least one measured value outside the windows"),
        ([(2.0, 1.0)], "with from before to, but is"),
        ([(float("nan"), 1.0)], "with from before to, but is"),
        ([], "must be a list of"),
        ([1.0, 2.0], "must be a list of"),
        (None, "must be a list of"),
    ],
)
def test_windows_that_are_refused(windows, said):
    with pytest.raises(DataError, match=said) as refused:
        two_outputs().hold_out(windows)
    assert str(refused.value).startswith("experiment 'run'.test_windows: ")


def test_what_is_held_out_already_is_refused():
    with pytest.raises(DataError, match='the role of this experiment is "test"'):
        replace(two_outputs(), role="test").hold_out(END)
