"""Records cut into segments, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.costs.robust import HuberCost
from cluster_est.errors import ProblemError
from cluster_est.methods.simplex.nelder_mead import NelderMead
from cluster_est.problem.search_space.space import make_space
from cluster_est.shooting.segments import cut
from cluster_est.shooting.settings import Shooting
from cluster_est.shooting.shoot import check_shooting
from cluster_est.shooting.space import make_segment_space, weighted

PROBLEM = spring_problem(2, 41).problem


def whole(problem):
    return make_space(problem, problem.indices("train"))


def test_every_measured_value_is_in_one_segment_and_every_state_ends_each_but_the_last():
    segmented = cut(PROBLEM, Shooting(segments=4))
    assert len(segmented.segments) == 8
    for record in (0, 1):
        parts = [segmented.segments[i] for i in segmented.of_record(record)]
        places = np.concatenate([s.places[s.places >= 0] for s in parts])
        np.testing.assert_array_equal(np.sort(places), np.arange(41))
        assert [len(s.ends) for s in parts] == [2, 2, 2, 0]
        for before, after in pairwise(parts):
            assert before.experiment.stop == after.experiment.start
            assert after.experiment.outputs[0].times[0] == after.experiment.start
        assert parts[0].experiment.start == PROBLEM.experiments[record].start
        assert parts[-1].experiment.stop == PROBLEM.experiments[record].stop


def test_inputs_are_what_they_were():
    segmented = cut(PROBLEM, Shooting(segments=4))
    for segment in segmented.segments:
        old = PROBLEM.experiments[segment.record].inputs[0]
        new = segment.experiment.inputs[0]
        inside = np.linspace(segment.experiment.start, segment.experiment.stop, 57)
        expected = np.interp(inside, old.times, old.values)
        np.testing.assert_array_equal(np.interp(inside, new.times, new.values), expected)
        assert len(new.times) < len(old.times)


@pytest.mark.parametrize(("length", "count"), [(0.2, 4), (0.3, 3), (5.0, 1)])
def test_a_length_is_the_longest_that_a_segment_may_be(length, count):
    segmented = cut(PROBLEM, Shooting(length=length))
    assert len(segmented.of_record(0)) == count


def test_more_segments_than_samples_are_as_many_as_there_are_samples():
    segmented = cut(PROBLEM, Shooting(segments=1000))
    assert len(segmented.of_record(0)) == 40


def test_a_state_that_is_an_output_gets_a_sample_more():
    experiments = tuple(
        replace(e, outputs=(replace(e.outputs[0], variable="x", sigma=0.1),))
        for e in PROBLEM.experiments
    )
    segmented = cut(replace(PROBLEM, experiments=experiments), Shooting(segments=2))
    first = segmented.segments[0]
    assert [o.variable for o in first.experiment.outputs] == ["x", "v"]
    assert first.experiment.outputs[0].times[-1] == first.experiment.stop
    assert first.places[first.ends[0]] == -1
    assert first.sigmas == (0.1, 1.0)


def test_the_fits_unknowns_come_first_and_states_of_later_segments_follow():
    train, segmented = whole(PROBLEM), cut(PROBLEM, Shooting(segments=3))
    space = make_segment_space(segmented, train, np.zeros((6, 2)), np.ones(2))
    assert [u.label for u in space.unknowns[: train.size]] == [u.label for u in train.unknowns]
    assert space.size == train.size + 2 * 2 * 2
    names = {u.label: u.experiments for u in space.unknowns}
    assert names["m"] == (0, 1, 2, 3, 4, 5)
    assert names["x0[e1]"] == (3,)
    assert names["x[e1 segment 2]"] == (4,)
    # a state acts on the segment that it begins, and on the one that must end in it
    acting = {space.unknowns[i].label for i in space.acting[3]}
    assert acting == {"m", "k", "c", "x0[e1]", "x[e1 segment 2]", "v[e1 segment 2]"}
    for colour in space.colours:
        touched = [set(np.flatnonzero(space.acts_on[i])) for i in colour]
        assert sum(map(len, touched)) == len(set().union(*touched))


def test_weights_and_scales_of_the_continuity():
    train, segmented = whole(PROBLEM), cut(PROBLEM, Shooting(segments=2))
    space = make_segment_space(segmented, train, np.zeros((4, 2)), np.ones(2))
    heavy = weighted(space, 7.0, np.array([2.0, 3.0]))
    assert heavy.continuity.weight == 7.0
    np.testing.assert_array_equal(heavy.continuity.scales, [2.0, 3.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("shooting", "sentence"),
    [
        (Shooting(), r"method\.shooting: must have segments or length, but has neither"),
        (Shooting(segments=3, length=1.0), r"method\.shooting: .* has both"),
        (Shooting(segments=1), r"method\.shooting\.segments: must be .*2"),
        (Shooting(length=0.0), r"method\.shooting\.length: must be .*0"),
    ],
)
def test_settings_that_say_nothing(shooting, sentence):
    with pytest.raises(ProblemError, match=sentence):
        shooting.check()


def test_a_dictionary_is_as_good_as_the_class():
    assert Shooting.of({"segments": 20}) == Shooting(segments=20)
    with pytest.raises(ProblemError, match=r"method\.shooting: must have segments or length but"):
        Shooting.of({"parts": 3})


def refused(problem, sentence, method=None):
    with pytest.raises(ProblemError, match=sentence):
        check_shooting(whole(problem), method or ce.LeastSquares(), Shooting(segments=3))


def test_what_belongs_to_a_whole_record_is_refused():
    first = PROBLEM.experiments[0]
    free = replace(first, outputs=(replace(first.outputs[0], free_offset=True),))
    refused(
        replace(PROBLEM, experiments=(free, *PROBLEM.experiments[1:])),
        r"cannot cut experiment 'e0', because it has an output with a free scale or offset",
    )


def test_effects_that_remember_are_refused():
    lag = ce.Effect("late", "output y", "lag")
    parameters = (*PROBLEM.parameters, ce.Parameter("late.tau", 0.1, 0.01, 1.0))
    refused(
        replace(PROBLEM, effects=(lag,), parameters=parameters),
        r"method\.shooting: cannot be used with effect 'late', which has a state of its own",
    )
    delay = ce.Effect("late", "input F", "delay")
    parameters = (*PROBLEM.parameters, ce.Parameter("late.tau", 0.1, 0.0, 1.0))
    refused(
        replace(PROBLEM, effects=(delay,), parameters=parameters),
        r"effect 'late', which depends on the past",
    )


def test_a_model_without_states_is_refused():
    model = ce.read_model(ROOT / "configs" / "league" / "models" / "ur5e.fmu", ["J"])
    times = np.arange(5.0)
    run = ce.Experiment("a", 0.0, 4.0, (), (ce.Output("i", times, times),))
    refused(ce.Problem(model, (ce.Parameter("J", 1.0),), (run,)), "needs a model with states")


def test_other_methods_costs_and_starts_are_refused():
    refused(PROBLEM, r"needs method\.name least_squares but it is nelder_mead", NelderMead())
    refused(replace(PROBLEM, cost=HuberCost()), r'needs cost\.name = "sse"')
    with pytest.raises(ProblemError, match="multistart asks for 3 starts"):
        ce.fit(PROBLEM, shooting={"segments": 3}, multistart=ce.Multistart(n=3))
