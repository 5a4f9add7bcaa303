"""For each effect of a structure, what the data leave possible in its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.loop_objects import made_candidate, made_fit, made_problem

import cluster_est as ce
from cluster_est.closed_loop.selection.refinement.refine import (
    RefittedCandidate,
    plainest,
    rivals_of,
)
from cluster_est.closed_loop.thresholds import RefinementThresholds

PROBLEM = made_problem(20)
THRESHOLDS = RefinementThresholds()
FAR = THRESHOLDS.alternative


def structure(criterion, *names):
    added = [made_candidate(name) for name in names]
    return RefittedCandidate(made_fit(PROBLEM, np.ones(20), added), criterion, True)


def possible(won, *others):
    found = rivals_of(won, [won, *others], THRESHOLDS)
    assert all(brought_in is won for brought_in, _ in found.values())
    return {name: [c.candidate.effect.name for c in own] for name, (_, own) in found.items()}


def test_one_effect_against_others():
    won = structure(-50.0, "a")
    near, far = structure(-50.0 + 0.9 * FAR, "b"), structure(-50.0 + 1.1 * FAR, "c")
    assert possible(won, near, far) == {"a": ["b"]}


def test_each_effect_of_a_pair_has_those_that_stand_in_its_place():
    won = structure(-50.0, "a", "b")
    others = [
        structure(-49.0, "a", "x"),
        structure(-48.0, "y", "b"),
        structure(-47.0, "x", "y"),
        structure(-46.0, "b", "a"),
        structure(-45.0, "a"),
    ]
    assert possible(won, *others) == {"a": ["y"], "b": ["x"]}


def test_the_order_in_which_effects_were_added_does_not_matter():
    """The rival is counted last, since what it predicts is compared as the winner's."""
    won = structure(-50.0, "a", "b")
    assert possible(won, structure(-49.0, "x", "a")) == {"a": [], "b": ["x"]}


def test_where_the_best_was_refused_its_rivals_are_those_of_the_best():
    """Evidence against a rival is counted from the best fit, whether that stayed bounded or not."""
    won = structure(-50.0, "a")
    best, rest = structure(-70.0, "b"), structure(-55.0, "c")
    assert possible(won, best, rest) == {"a": ["b"]}


def test_among_equals_the_one_with_fewest_unknowns_is_the_plainest():
    small = structure(-48.5, "a")
    model = replace(PROBLEM.model, parameters=(*PROBLEM.model.parameters, "q"))
    parameters = (*PROBLEM.parameters, ce.Parameter("q", 1.0))
    wider = replace(PROBLEM, model=model, parameters=parameters)
    grown = made_fit(wider, np.ones(20), [made_candidate("b")])
    large = RefittedCandidate(grown, -50.0, True)
    assert large.fitted.space.size > small.fitted.space.size
    assert plainest([large, small], THRESHOLDS) is small
    far = structure(-50.0 + 1.1 * THRESHOLDS.equal, "a")
    assert plainest([large, far], THRESHOLDS) is large
