import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import make_space
from cluster_est.problem.unknowns import StateContinuity, StateEnd
from workers.messages import Output

PER = [None, "experiment", "group:rig", "group:day"]
few = settings(max_examples=30)


@st.composite
def spaces(draw):
    count = draw(st.integers(1, 8))
    kinds = draw(st.lists(st.sampled_from(PER), min_size=1, max_size=6))
    parameters = [
        Parameter(
            f"p{i}", 1.0 + i, (0.1, 100.0), draw(st.sampled_from(["linear", "log"])), per=per,
            fixed=draw(st.integers(0, 4)) == 0,
        )
        for i, per in enumerate(kinds)
    ]  # fmt: skip
    known = {
        e: {f"p{i}": 50.0 + e for i in range(len(kinds)) if draw(st.integers(0, 4)) == 0}
        for e in range(count)
    }
    chosen = draw(st.sets(st.integers(0, count - 1), min_size=1))
    return make_space(unloaded_problem(parameters, count, known=known), tuple(sorted(chosen)))


@few
@given(spaces())
def test_unknowns_of_a_colour_share_no_experiment_and_each_has_one(space):
    members = np.concatenate([np.zeros(0, int), *space.colours])
    assert sorted(members) == list(range(space.size))
    for colour in space.colours:
        assert (space.acts_on[colour].sum(axis=0) <= 1).all()


@few
@given(spaces())
def test_unknown_moves_just_its_own_experiments(space):
    before = space.physical(space.start)
    for i, unknown in enumerate(space.unknowns):
        x = space.start.copy()
        x[i] += 0.5
        moved = space.physical(x) != before
        assert moved[:, unknown.column].tolist() == space.acts_on[i].tolist()
        assert moved.sum() == space.acts_on[i].sum()


@few
@given(spaces())
def test_values_are_known_or_the_starts(space):
    physical = space.physical(space.start)
    assert physical.shape == (len(space.experiments), len(space.problem.parameters))
    for row, e in zip(physical, space.experiments, strict=True):
        known = dict(space.problem.experiments[e].values)
        expected = [known.get(p.target, p.start) for p in space.problem.parameters]
        np.testing.assert_allclose(row, expected, rtol=1e-15)


@few
@given(spaces())
def test_unknowns_are_named_after_what_they_are_for(space):
    labels = [u.label for u in space.unknowns]
    assert len(set(labels)) == len(labels)
    for unknown in space.unknowns:
        runs = [space.problem.experiments[space.experiments[e]] for e in unknown.experiments]
        per = unknown.parameter.per
        for run in runs:
            scope = {None: "", "experiment": f"[{run.id}]"}.get(per)
            if scope is None:
                scope = f"[{dict(run.groups)[str(per).removeprefix('group:')]}]"
            assert unknown.label == unknown.parameter.name + scope
        assert not unknown.parameter.fixed
        assert all(unknown.parameter.target not in dict(run.values) for run in runs)


@few
@given(spaces())
def test_values_given_by_label_are_kept_instead_of_searched(space):
    given_values = {u.label: 2.0 + i for i, u in enumerate(space.unknowns) if i % 2 == 0}
    fewer = make_space(space.problem, space.experiments, given_values)
    left = [u.label for u in space.unknowns if u.label not in given_values]
    assert [u.label for u in fewer.unknowns] == left
    x = space.start.copy()
    for i, unknown in enumerate(space.unknowns):
        if unknown.label in given_values:
            x[i] = unknown.to_search(given_values[unknown.label])
    np.testing.assert_allclose(fewer.physical(fewer.start), space.physical(x), rtol=1e-15)


@given(st.floats(1e-300, 1e300))
def test_log_scale_goes_there_and_back(value):
    parameter = Parameter("p", value, (0.0, math.inf), scale="log")
    space = make_space(unloaded_problem([parameter], 1), (0,))
    assert space.start[0] == math.log(value)
    assert space.lower[0] == -math.inf
    assert space.upper[0] == math.inf
    np.testing.assert_allclose(space.physical(space.start)[0, 0], value, rtol=1e-12)
    assert space.estimates(space.start)["p"] == space.physical(space.start)[0, 0]


def test_groups_of_one_key_share_a_colour():
    parameters = [Parameter("k", 1.0), Parameter("b", 1.0, per="group:rig")]
    space = make_space(unloaded_problem(parameters, 6), tuple(range(6)))
    assert [u.label for u in space.unknowns] == ["k", "b[A]", "b[B]"]
    assert [u.experiments for u in space.unknowns[1:]] == [(0, 2, 4), (1, 3, 5)]
    assert len(space.colours) == 2


def test_residuals_stand_experiment_after_experiment():
    problem = unloaded_problem([Parameter("k", 1.0)], 5)
    runs = [
        replace(run, outputs=(Output("y", np.linspace(0.0, 1.0, i + 1), np.zeros(i + 1)),))
        for i, run in enumerate(problem.experiments)
    ]
    space = make_space(replace(problem, experiments=tuple(runs)), (1, 3, 4))
    assert space.rows == (slice(0, 2), slice(2, 6), slice(6, 11))


@pytest.mark.parametrize(
    ("parameter", "size"),
    [
        (Parameter("p", -3.0, (-50.0, 100.0)), 3.0),
        (Parameter("p", 0.0, (-4.0, 1.0)), 0.5),
        (Parameter("p", 0.0, (-4.0, math.inf)), 1.0),
        (Parameter("p", 7.0, (1.0, 1e6), "log"), 1.0),
    ],
    ids=["its own size", "a tenth of its range", "nothing is known", "a logarithm"],
)
def test_a_noticeable_change(parameter, size):
    assert make_space(unloaded_problem([parameter], 1), (0,)).typical.tolist() == [size]


def test_a_search_begins_at_what_is_known_and_within_the_bounds():
    parameters = [
        Parameter("p", 2.0, (0.5, 10.0), per="experiment"),
        Parameter("q", 3.0, (1.0, 9.0)),
    ]
    space = make_space(unloaded_problem(parameters, 2), (0, 1), starts={"p[e1]": 4.0, "q": 99.0})
    assert [unknown.label for unknown in space.unknowns] == ["p[e0]", "p[e1]", "q"]
    assert space.start.tolist() == [2.0, 4.0, 9.0]


def test_a_difference_of_states_between_segments_counts_over_its_scale_and_by_its_weight():
    # the first segment ends at compared - sigma * residual = 5 - 2 * 1.5 = 2
    ends = (StateEnd(0, row=1, compared=5.0, sigma=2.0, unknown=3, scale=4.0),)
    continuity = StateContinuity(ends, weight=10.0)
    x = np.array([0.0, 0.0, 0.0, 2.5])
    sent = np.array([7.0, 1.5])
    np.testing.assert_allclose(continuity.applied(0, x, sent), [7.0, 10.0 * 0.5 / 4.0])
    np.testing.assert_array_equal(sent, [7.0, 1.5])
    np.testing.assert_allclose(continuity.differences([continuity.applied(0, x, sent)]), [0.5])
    np.testing.assert_allclose(continuity.scales, [4.0])


def test_segments_that_end_a_record_stay_as_they_are():
    continuity = StateContinuity((StateEnd(0, 0, 0.0, 1.0, 1, 1.0),))
    sent = np.array([1.0, 2.0])
    assert continuity.applied(1, np.zeros(2), sent) is sent
    assert continuity.acting(0) == [1]
    assert continuity.acting(1) == []


@pytest.mark.parametrize("weight", [0.5, 100.0])
def test_no_difference_is_no_residual_whatever_the_weight(weight):
    ends = tuple(StateEnd(0, j, 0.0, 1.0, j, 3.0) for j in range(2))
    continuity = StateContinuity(ends, weight)
    x = np.array([1.25, -0.5])
    np.testing.assert_array_equal(continuity.applied(0, x, -x), np.zeros(2))
