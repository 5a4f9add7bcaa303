import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.problems.unloaded import unloaded_problem

from cluster_est.errors import ProblemError
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import make_space


def derived(name, expression, **more):
    return Parameter(name, 0.0, expression=expression, **more)  # type: ignore[arg-type]


@settings(max_examples=30)
@given(st.permutations(range(6)), st.lists(st.floats(-3.0, 3.0), min_size=2, max_size=2))
def test_a_chain_may_be_declared_in_any_order(order, x):
    chain = [
        Parameter("p0", 1.0),
        Parameter("p1", 1.0),
        derived("p2", "p0 * p1"),
        derived("p3", "p2 - p0"),
        derived("p4", "max(p3, 0.5)"),
        derived("p5", "p4 * p2 + 1"),
    ]
    space = make_space(unloaded_problem([chain[i] for i in order]), (0,))
    names = [u.label for u in space.unknowns]
    assert sorted(names) == ["p0", "p1"]
    truth = dict(zip(names, x, strict=True))
    truth["p2"] = truth["p0"] * truth["p1"]
    truth["p3"] = truth["p2"] - truth["p0"]
    truth["p4"] = max(truth["p3"], 0.5)
    truth["p5"] = truth["p4"] * truth["p2"] + 1.0
    row = space.physical(np.array(x))[0]
    np.testing.assert_allclose(row, [truth[f"p{i}"] for i in order], rtol=1e-14, atol=1e-14)


def test_tied_parameters_have_one_value():
    """The same one in all experiments, which is shown once."""
    problem = unloaded_problem([Parameter("k1", 2.0), derived("k2", "k1")], experiments=3)
    space = make_space(problem, (0, 1, 2))
    np.testing.assert_array_equal(space.physical(np.array([0.3])), [[0.3, 0.3]] * 3)
    assert space.derived(np.array([0.3])) == {"k2": 0.3}


def test_auxiliary_parameters_never_reach_the_model():
    parameters = [
        Parameter("ratio", 0.1, auxiliary=True),
        Parameter("k", 2.0),
        derived("limit", "k * ratio", auxiliary=True),
        derived("c", "ratio * k"),
        Parameter("m", 5.0),
    ]
    problem = unloaded_problem(parameters, constraints=["limit <= 1"])
    assert problem.model.parameters == ("k", "c", "m")
    space = make_space(problem, (0,))
    assert [u.label for u in space.unknowns] == ["ratio", "k", "m"]
    x = np.array([0.5, 4.0, 7.0])
    physical = space.physical(x)
    np.testing.assert_array_equal(physical, [[4.0, 2.0, 7.0]])
    assert physical.flags.c_contiguous
    assert space.derived(x) == {"limit": 2.0, "c": 2.0}
    assert space.parameter_constraints(x).tolist() == [1.0]


def test_a_value_of_an_experiments_own_makes_one_there_of_what_follows():
    parameters = [
        Parameter("k", 2.0),
        Parameter("x0", 0.5, per="experiment"),
        derived("v0", "k * x0"),
    ]
    space = make_space(unloaded_problem(parameters, experiments=3), (0, 1, 2))
    x = np.array([10.0, 1.0, 2.0, 3.0])
    assert [u.label for u in space.unknowns] == ["k", "x0[e0]", "x0[e1]", "x0[e2]"]
    np.testing.assert_array_equal(space.physical(x)[:, 2], [10.0, 20.0, 30.0])
    assert space.derived(x) == {"v0[e0]": 10.0, "v0[e1]": 20.0, "v0[e2]": 30.0}
    assert len(space.colours) == 2


def test_known_values_win_over_formulas_and_go_into_them():
    parameters = [Parameter("k", 2.0), derived("c", "3 * k"), derived("d", "c + 1")]
    known = {1: {"k": 10.0}, 2: {"c": -1.0}}
    space = make_space(unloaded_problem(parameters, 3, known=known), (0, 1, 2))
    np.testing.assert_array_equal(
        space.physical(space.start), [[2.0, 6.0, 7.0], [10.0, 30.0, 31.0], [2.0, -1.0, 0.0]]
    )


def test_fixed_logarithmic_and_kept_sources():
    parameters = [
        Parameter("k", 20.0, (1.0, 100.0), scale="log"),
        Parameter("m", 5.0, fixed=True),
        derived("c", "k / m"),
    ]
    problem = unloaded_problem(parameters, experiments=2)
    space = make_space(problem, (0,))
    assert [u.label for u in space.unknowns] == ["k"]
    found = space.physical(np.array([math.log(50.0)]))
    np.testing.assert_allclose(found, [[50.0, 5.0, 10.0]], rtol=1e-14)
    kept = make_space(problem, (1,), known={"k": 7.0})
    assert kept.size == 0
    np.testing.assert_allclose(kept.physical(kept.start), [[7.0, 5.0, 1.4]], rtol=1e-14)


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_another_start_stays_within_the_bounds_and_changes_no_other_value(a, b):
    parameters = [
        Parameter("k", 2.0, (0.1, 7.0), scale="log"),
        Parameter("m", 1.0, (0.3, 0.7 + 0.6)),
    ]
    space = make_space(unloaded_problem(parameters), (0,))
    x = space.lower + np.array([a, b]) * (space.upper - space.lower)
    x = np.clip(x, space.lower, space.upper)
    moved = space.starting_at(x)
    assert (moved.lower <= moved.start).all()
    assert (moved.start <= moved.upper).all()
    np.testing.assert_allclose(moved.start, x, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(moved.physical(x), space.physical(x))


@pytest.mark.parametrize(
    ("expressions", "pattern"),
    [
        ({"a": "a + 1"}, "parameters.a.expression: .*depend on itself.*through a"),
        ({"a": "b", "b": "2 * a"}, "depend on itself.*through a, b"),
        ({"a": "b", "b": "d", "d": "a * k"}, "depend on itself.*through a, b, d"),
        ({"a": "q"}, "parameters.a.expression.*unknown variable 'q'"),
    ],
)
def test_a_formula_that_cannot_be_followed_is_refused(expressions, pattern):
    parameters = [Parameter("k", 1.0), *(derived(n, text) for n, text in expressions.items())]
    with pytest.raises(ProblemError, match=pattern):
        unloaded_problem(parameters)


@pytest.mark.parametrize(
    ("changes", "key"),
    [({"fixed": True}, "fixed"), ({"per": "experiment"}, "per"), ({"scale": "log"}, "scale")],
)
def test_a_formula_says_all_of_a_value(changes, key):
    with pytest.raises(ProblemError, match=rf"parameters\.c\.{key}: must not be used with expr"):
        Parameter("c", 1.0, expression="2 * k", **changes)


def test_the_start_of_a_derived_parameter_is_nowhere_looked_at():
    low = Parameter("c", 0.0, (5.0, 6.0), expression="k")
    space = make_space(unloaded_problem([Parameter("k", 2.0), low]), (0,))
    assert space.physical(space.start).tolist() == [[2.0, 2.0]]


def test_two_parameters_for_one_variable_are_refused():
    with pytest.raises(ProblemError, match=r"variable 'k'.*appears twice"):
        unloaded_problem([Parameter("k", 1.0), derived("c", "2 * k", variable="k")])
