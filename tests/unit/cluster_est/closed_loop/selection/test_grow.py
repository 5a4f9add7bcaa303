"""The beam: the best structures whose predictions differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_bench, made_candidate, made_fit, made_problem

from cluster_est.closed_loop.selection.grow import best_distinct
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate

SIZE = 60
PROBLEM = made_problem(SIZE)
DIRECTIONS = np.linalg.qr(np.random.default_rng(2).standard_normal((SIZE, 6)))[0].T
BASE = made_fit(PROBLEM, 5.0 * DIRECTIONS[0])


def bench(width):
    made = made_bench(PROBLEM)
    return replace(made, settings=replace(made.settings, beam=width))


def contender(name, change, criterion, family="friction", base=BASE):
    fitted = made_fit(PROBLEM, base.residuals + change, [made_candidate(name, family)])
    return RefittedCandidate(fitted, criterion, True)


def names(found):
    return [fitted.added[0].effect.name for fitted in found]


@pytest.mark.parametrize("width", [1, 2, 4, 9])
def test_the_best_are_kept_as_many_as_the_beam_is_wide(width):
    made = [contender(f"e{i}", DIRECTIONS[i], -float(i)) for i in range(6)]
    found = best_distinct(bench(width), BASE, made)
    assert names(found) == ["e5", "e4", "e3", "e2", "e1", "e0"][:width]


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_what_predicts_the_same_takes_one_place(scale):
    """Parallel changes are alike whatever their size; opposite ones are not."""
    base = made_fit(PROBLEM, scale * BASE.residuals)
    changes = {
        "first": DIRECTIONS[1],
        "second name": 2.0 * DIRECTIONS[1] + 0.1 * DIRECTIONS[2],
        "opposite": -DIRECTIONS[1],
        "other": DIRECTIONS[1] + DIRECTIONS[3],
    }
    made = [
        contender(name, scale * change, float(i), base=base)
        for i, (name, change) in enumerate(changes.items())
    ]
    assert names(best_distinct(bench(4), base, made)) == ["first", "opposite", "other"]


def test_the_accepted_one_has_its_place_though_others_fit_better():
    accepted = contender("accepted", DIRECTIONS[1], -1.0).fitted
    made = [contender("alike", 3.0 * DIRECTIONS[1], -9.0), contender("other", DIRECTIONS[2], -5.0)]
    found = best_distinct(bench(4), BASE, made, first=accepted)
    assert found[0] is accepted
    assert names(found) == ["accepted", "other"]


def test_a_free_table_is_no_ground_to_build_on():
    made = [contender("curve", DIRECTIONS[1], -9.0, "table"), contender("e", DIRECTIONS[2], -1.0)]
    assert names(best_distinct(bench(4), BASE, made)) == ["e"]


def test_the_order_of_the_contenders_does_not_matter():
    made = [contender(f"e{i}", DIRECTIONS[i] + DIRECTIONS[1], -float(i)) for i in range(6)]
    one = best_distinct(bench(3), BASE, made)
    assert names(one) == names(best_distinct(bench(3), BASE, made[::-1]))
