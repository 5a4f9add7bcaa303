from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_fit,
    made_problem,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.answer import (
    best_ancestors,
    ending_at,
    strength_p,
)
from cluster_est.closed_loop.selection.rounds import AcceptedStructure, RejectionReason
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import make_space
from cluster_est.uncertainty import assess

PROBLEM = made_problem(30, 30, 30)
A, B, C = (made_candidate(name) for name in "abc")
CURVE = made_candidate("curve", "table")


def prediction(*squares):
    return LeaveOneOutPrediction(np.array(squares, float))


def searched(*path):
    """A search that has accepted these structures: their effects and what they predict."""
    accepted = [
        AcceptedStructure(fit_with_squares(PROBLEM, 9.0, added), prediction(*squares), rounds=n)
        for n, (added, squares) in enumerate(path)
    ]
    screening = made_screening(np.ones((90, 1)), np.ones(90), [np.ones((90, 1))], [A])
    rounds = [made_round(None, screening) for _ in accepted[:-1]]
    last = made_round(RejectionReason.NOT_SIGNIFICANT, screening)
    found = made_selection(accepted[0].model, accepted[-1].model, last)
    return replace(found, accepted=tuple(accepted), steps=(*rounds, last))


def effects(found):
    return [candidate.effect.name for candidate in found.current.added]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        pytest.param([((), (9, 9, 9)), ((A,), (1, 1, 1))], ["a"], id="better everywhere"),
        pytest.param([((), (9, 9, 9)), ((A,), (1, 1, 10))], ["a"], id="better in two of three"),
        pytest.param([((), (9, 9, 9)), ((A,), (1, 10, 10))], [], id="better in one of three"),
        pytest.param([((), (9, 9, 9)), ((A,), (1, 9, 9))], ["a"], id="two do not tell"),
        pytest.param([((), (9, 9, 9)), ((A,), (8, 8, 90))], [], id="worse in all"),
        pytest.param(
            [((), (9, 9, 9)), ((A,), (1, 1, 1)), ((A, B), (2, 2, 2))],
            ["a"],
            id="a second effect spoils it",
        ),
        pytest.param(
            [((), (9, 9, 9)), ((A,), (20, 20, 20)), ((A, B), (1, 1, 1))],
            ["a", "b"],
            id="it gets worse before it gets right",
        ),
        pytest.param(
            [((), (9, 9, 9)), ((A, B), (1, 1, 1)), ((C,), (1, 1, 1))],
            ["c"],
            id="the plainer one wins a tie",
        ),
        pytest.param(
            [((), (9, 9, 9)), ((A, B), (1, 1, 1)), ((C,), (2, 2, 2))],
            ["a", "b"],
            id="what is plainer must not predict worse",
        ),
    ],
)
def test_the_answer_is_what_predicts_left_out_parts(path, expected):
    found = searched(*path)
    assert effects(ending_at(found, best_ancestors(found.accepted)[-1])) == expected


def test_the_answers_before_it_come_next():
    path = [((), (9, 9, 9)), ((A,), (4, 4, 4)), ((A, B), (5, 5, 5)), ((A, B, C), (1, 1, 1))]
    found = searched(*path)
    chain = best_ancestors(found.accepted)
    assert [effects(ending_at(found, n)) for n in chain] == [[], ["a"], ["a", "b", "c"]]


def test_what_is_no_answer_is_passed_over():
    path = [((), (9, 9, 9)), ((A,), (4, 4, 4)), ((A, B), (1, 1, 1))]
    assert best_ancestors(searched(*path).accepted, {2}) == [0, 1]


def test_what_came_after_the_answer_is_no_longer_accepted_and_the_reason_is_said():
    found = searched(((), (9, 9, 9)), ((A,), (1, 1, 1)), ((A, B), (2, 2, 2)))
    best = ending_at(found, best_ancestors(found.accepted)[-1])
    assert best.last.why is RejectionReason.REFITS
    assert len(best.steps) == 2
    assert best.prediction.total == 3.0
    assert ending_at(found, 2).last.why is RejectionReason.NOT_SIGNIFICANT


def test_what_a_revision_changed_may_be_the_answer():
    """The first round accepts a, of which the revision makes b: the second round begins at b."""
    found = searched(((), (9, 9, 9)), ((A,), (1, 1, 1)), ((B,), (2, 2, 2)))
    declared, first, revised = found.accepted
    found = replace(
        found, accepted=(declared, first, replace(revised, rounds=1)), steps=found.steps[1:]
    )
    best = ending_at(found, best_ancestors(found.accepted)[-1])
    assert effects(best) == ["a"]
    assert [each.why for each in best.steps] == [None, RejectionReason.REFITS]


def test_no_order_of_parts_and_no_unit_matters():
    random = np.random.default_rng(1)
    for _ in range(100):
        one, other = random.uniform(1.0, 2.0, (2, 5))
        order, unit = random.permutation(5), 10.0 ** random.uniform(-9.0, 9.0)
        better = prediction(*one).is_better_than(prediction(*other))
        assert better is prediction(*one[order]).is_better_than(prediction(*other[order]))
        assert better is prediction(*(unit * one)).is_better_than(prediction(*(unit * other)))
        assert not (better and prediction(*other).is_better_than(prediction(*one)))


def two_strengths(truth, noise=0.3, collinear=0.0):
    """A model that is linear in k and the two strengths of one effect, fitted."""
    problem = made_problem(40, 40)
    added = made_candidate("a", "table")
    names = [f"a.{strength}" for strength in added.strengths[:2]]
    more = tuple(Parameter(name, 0.0, bounds=(-10.0, 10.0)) for name in names)
    model = replace(problem.model, parameters=("k", *names))
    problem = replace(problem, model=model, parameters=(*problem.parameters, *more))
    space = make_space(problem, (0, 1))
    random = np.random.default_rng(3)
    matrix = random.normal(size=(80, 3))
    matrix[:, 2] = collinear * matrix[:, 1] + (1.0 - collinear) * matrix[:, 2]
    measured = matrix @ np.array([1.0, *truth]) + noise * random.normal(size=80)
    x = np.linalg.lstsq(matrix, measured, rcond=None)[0]
    fitted = made_fit(made_problem(40, 40), matrix @ x - measured, [added])
    return replace(fitted, space=space, x=x, jacobian=matrix), matrix, measured


@pytest.mark.parametrize("truth", [(0.0, 0.0), (0.05, -0.1), (1.0, 0.0)])
def test_strengths_are_tested_jointly_as_by_the_f_test_of_two_nested_fits(truth):
    fitted, matrix, measured = two_strengths(truth)
    solution = Solution(fitted.x, fitted.sse, Ending.CONVERGED, jacobian=fitted.jacobian)
    known = assess(fitted.space, solution)
    if known.basis != "white":
        pytest.skip("another law of the noise was chosen")
    alone = np.linalg.lstsq(matrix[:, :1], measured, rcond=None)[0]
    fall = np.sum((measured - matrix[:, :1] @ alone) ** 2) - fitted.sse
    expected = stats.f.sf(fall / 2.0 / (fitted.sse / 77.0), 2, 77)
    p = strength_p(fitted.added, fitted.space, fitted.x, known)[0]
    assert p == pytest.approx(expected, rel=1e-6)


def test_two_strengths_that_each_may_be_zero_are_not_both():
    fitted, *_ = two_strengths((0.5, 0.5), collinear=0.98)
    solution = Solution(fitted.x, fitted.sse, Ending.CONVERGED, jacobian=fitted.jacobian)
    known = assess(fitted.space, solution)
    for i in (1, 2):
        assert known.intervals[i].lower95 < 0.0 < known.intervals[i].upper95
    assert strength_p(fitted.added, fitted.space, fitted.x, known)[0] < 1e-6


def test_a_strength_that_does_nothing_is_not_determined():
    fitted, *_ = two_strengths((0.5, 0.5))
    jacobian = fitted.jacobian.copy()
    jacobian[:, 1:] = 0.0
    solution = Solution(fitted.x, fitted.sse, Ending.CONVERGED, jacobian=jacobian)
    known = assess(fitted.space, solution)
    assert strength_p(fitted.added, fitted.space, fitted.x, known)[0] == 1.0


def test_effects_of_one_place_and_argument_are_one_finding():
    """Two powers of one speed, which each may be zero beside the other, and not both."""
    fitted, *_ = two_strengths((0.5, 0.5), collinear=0.98)
    (both,) = fitted.added
    parts = [replace(both, effect=replace(both.effect, name=name)) for name in ("one", "other")]
    first, *_, second, third = fitted.space.unknowns
    names = [f"{part.effect.name}.{part.strengths[0]}" for part in parts]
    split = tuple(
        replace(u, label=name, parameter=replace(u.parameter, name=name))
        for u, name in zip((second, third), names, strict=True)
    )
    space = replace(fitted.space, unknowns=(first, *split))
    solution = Solution(fitted.x, fitted.sse, Ending.CONVERGED, jacobian=fitted.jacobian)
    known = assess(space, solution)
    together = strength_p(parts, space, fitted.x, known)
    assert max(together) < 1e-6
    alone = [strength_p([part], space, fitted.x, known)[0] for part in parts]
    assert min(alone) > 0.05
    elsewhere = replace(parts[1], effect=replace(parts[1].effect, variables=("x",)))
    assert strength_p([parts[0], elsewhere], space, fitted.x, known) == alone
