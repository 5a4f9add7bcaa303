import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import make_space
from cluster_est.running.search_state import assemble_evaluation
from workers.messages import Outcome, Status, UserFunction

PER = [None, "experiment", "group:rig", "group:day"]


A, B = Parameter("a", 2.0), Parameter("b", 5.0)
RIG, X0 = Parameter("a", 2.0, per="group:rig"), Parameter("x0", 0.0, per="experiment")
Y0 = Parameter("y0", 0.0, expression="a * x0")


@pytest.mark.parametrize(
    ("parameters", "text", "chosen", "where", "x", "values"),
    [
        ([A, B], "a <= b", (0, 1, 2, 3), [""], [7.0, 4.0], [3.0]),
        ([A, X0], "x0 <= a", (0, 2), [" [e0]", " [e2]"], [1.0, 5.0, -2.0], [4.0, -3.0]),
        ([RIG], "a <= 1", (0, 1, 2, 3), [" [e0]", " [e1]"], [3.0, 10.0], [2.0, 9.0]),
        ([A, X0, Y0], "y0 <= 1", (0, 1), [" [e0]", " [e1]"], [2.0, 3.0, 4.0], [5.0, 7.0]),
    ],
    ids=["shared", "of each experiment", "of each group", "by a formula"],
)
def test_a_constraint_holds_once_for_each_value(parameters, text, chosen, where, x, values):
    space = make_space(unloaded_problem(parameters, 4, [text]), chosen)
    assert space.constraint_names == tuple(text + each for each in where)
    assert space.parameter_constraints(np.array(x)).tolist() == values


@st.composite
def cases(draw):
    """A problem with parameters of all kinds, and a point of its space."""
    kinds = draw(st.lists(st.sampled_from(PER), min_size=2, max_size=4))
    parameters = [
        Parameter(f"p{i}", 1.5, (0.5, 4.0), draw(st.sampled_from(["linear", "log"])), per=per)
        for i, per in enumerate(kinds)
    ]
    count = draw(st.integers(1, 6))
    known = {
        e: {f"p{i}": 2.0 + e + 10 * i for i in range(len(kinds)) if draw(st.integers(0, 5)) == 0}
        for e in range(count)
    }
    used = draw(st.sets(st.integers(0, len(kinds) - 1), min_size=1))
    text = " + ".join(f"{i + 1}*p{i}" for i in sorted(used)) + " <= 3"
    problem = unloaded_problem(parameters, count, [text], known)
    chosen = tuple(sorted(draw(st.sets(st.integers(0, count - 1), min_size=1))))
    space = make_space(problem, chosen)
    unit = draw(st.lists(st.floats(0.0, 1.0), min_size=space.size, max_size=space.size))
    x = space.lower + np.array(unit) * (space.upper - space.lower)
    return space, np.clip(x, space.lower, space.upper), sorted(used)


@settings(max_examples=30)
@given(cases())
def test_it_holds_wherever_it_says_something_new(case):
    space, x, used = case
    table = space.physical(x)
    by_hand = [sum((i + 1) * row[i] for i in used) - 3.0 for row in table]
    found = space.parameter_constraints(x)
    assert len(found) == len(space.constraint_names) == len(set(space.constraint_names))
    np.testing.assert_allclose(np.unique(found.round(9)), np.unique(np.round(by_hand, 9)))
    labels = {
        tuple(
            dict(space.problem.experiments[e].values).get(
                f"p{i}", next((u.label for u in space.unknowns
                               if u.parameter.name == f"p{i}" and position in u.experiments), None))
            for i in used
        )
        for position, e in enumerate(space.experiments)
    }  # fmt: skip
    assert len(found) == len(labels)


@settings(max_examples=30)
@given(cases())
def test_slopes_are_the_derivatives_even_at_the_bounds(case):
    space, x, used = case
    slopes = space.parameter_constraint_jacobian(x)
    assert slopes.shape == (len(space.constraint_names), space.size)
    position = {name: space.constraint_names.index(name) for name in space.constraint_names}
    for name, row in position.items():
        label = name.partition("[")[2].removesuffix("]")
        e = [space.problem.experiments[e].id for e in space.experiments].index(label or "e0") \
            if label else 0  # fmt: skip
        for j, unknown in enumerate(space.unknowns):
            i = int(unknown.parameter.name[1:])
            factor = (i + 1) * (unknown.to_physical(float(x[j])) if unknown.log else 1.0)
            truth = factor if i in used and e in unknown.experiments else 0.0
            assert slopes[row, j] == pytest.approx(truth, rel=1e-4, abs=1e-7)


def test_slopes_do_not_depend_on_the_size_of_an_unknown():
    parameters = [Parameter("big", 1e9, (0.0, 2e9)), Parameter("small", 1e-9, (0.0, 2e-9))]
    problem = unloaded_problem(parameters, constraints=["big * small <= 1", "big^2 <= 1"])
    space = make_space(problem, (0,))
    slopes = space.parameter_constraint_jacobian(space.start)
    np.testing.assert_allclose(slopes, [[1e-9, 1e9], [2e9, 0.0]], rtol=1e-6)


def test_a_violation_is_counted_in_its_scale():
    problem = unloaded_problem([Parameter("a", 2.0)], constraints=["a <= 1"], scale=4.0)
    space = make_space(problem, (0,))
    assert space.parameter_constraints(np.array([7.0])).tolist() == [1.5]
    np.testing.assert_allclose(space.parameter_constraint_jacobian(np.array([7.0])), [[0.25]])


def test_bounds_of_what_follows_become_constraints():
    parameters = [
        Parameter("k", 2.0),
        Parameter("c", 0.0, (-5.0, 20.0), expression="3 * k"),
        Parameter("d", 0.0, (0.0, np.inf), expression="k - 1"),
        Parameter("free", 0.0, expression="k"),
    ]
    space = make_space(unloaded_problem(parameters), (0,))
    assert space.constraint_names == ("-5.0 <= c", "c <= 20.0", "0.0 <= d")
    assert not space.equality.any()
    found = space.parameter_constraints(np.array([10.0]))
    np.testing.assert_allclose(found, [-35.0 / 20.0, 10.0 / 20.0, -9.0])


def outcome(constraints=(), residuals=(1.0, 2.0)):
    return Outcome(0, Status.OK, np.array(residuals), constraints=np.array(constraints, float))


FAILED = Outcome(0, Status.SOLVER_FAILURE, message="no")


def test_a_point_is_judged_by_all_its_constraints():
    problem = unloaded_problem(
        [Parameter("a", 1.0)],
        2,
        ["a <= 3", "a = 1"],
        constraint_functions=(UserFunction("none", "f"), UserFunction("none", "g", equality=True)),
    )
    space = make_space(problem, (0, 1))
    names = ("a <= 3", "a = 1", *(f"{name} [e{e}]" for e in (0, 1) for name in "fg"))
    assert space.constraint_names == names
    assert space.equality.tolist() == [False, True] * 3
    assert space.constraint_rows == (slice(2, 4), slice(4, 6))
    x = np.array([1.0])
    good = assemble_evaluation(space, x, (outcome([-1.0, 0.0]), outcome([-2.0, 1e-7])), 5)
    assert good.constraints.tolist() == [-2.0, 0.0, -1.0, 0.0, -2.0, 1e-7]
    assert (good.violation, good.feasible, good.index) == (1e-7, True, 5)
    assert (good.cost, good.rank) == (10.0, (0.0, 10.0))
    bad = assemble_evaluation(space, x, (outcome([-1.0, -0.25]), outcome([0.125, 0.0])), 6)
    assert (bad.violation, bad.feasible, bad.rank) == (0.25, False, (0.25, 10.0))
    failed = assemble_evaluation(space, x, (outcome([-1.0, 0.0]), FAILED), 7)
    assert math.isnan(failed.cost)
    assert not failed.feasible
    assert good.rank < bad.rank < failed.rank == (math.inf, math.inf)


def test_a_constraint_without_a_value_is_as_bad_as_can_be():
    problem = unloaded_problem([Parameter("a", 1.0)], 1, ["sqrt(a) <= 3"])
    space = make_space(problem, (0,))
    at = assemble_evaluation(space, np.array([-1.0]), (outcome(),), 0)
    assert at.violation == math.inf
    assert not at.feasible
    assert at.rank[0] == math.inf
    np.testing.assert_array_equal(space.parameter_constraint_jacobian(np.array([-1.0])), [[0.0]])
