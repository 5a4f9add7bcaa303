"""What was done at a model is not done again, as long as the model has not moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_candidate, made_fit, made_problem
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.visited_models import VisitedModels
from cluster_est.closed_loop.settings import LoopSettings

SETTINGS = LoopSettings(forms=("bias", "linear"), sites=("input current", "parameter R0"))
PROBLEM = made_problem(50)
SMALL, LARGE = 0.09, 0.11


def battery(interface):
    return opened(missing_effect_problem("battery", interface=interface, signals=()), SETTINGS)


def moved(fitted, by):
    """With residuals that are this far away."""
    step = np.linspace(-1.0, 1.0, len(fitted.residuals))
    return replace(fitted, residuals=fitted.residuals + by * step / np.linalg.norm(step))


def grown(names, criterion, family="friction", *, full=True):
    added = [made_candidate(name, family) for name in names]
    return RefittedCandidate(made_fit(PROBLEM, np.ones(50), added), criterion, full)


def fit_of(*names):
    return made_fit(PROBLEM, np.zeros(50), [made_candidate(name, "friction") for name in names])


@pytest.mark.parametrize(("by", "noise", "again"), [
    (0.0, 1.0, False), (SMALL, 1.0, False), (LARGE, 1.0, True), (0.9, 100.0, False),
])  # fmt: skip
def test_what_has_not_moved_beside_the_noise_is_not_simulated_again(by, noise, again):
    visited = VisitedModels(noise)
    with battery("co_simulation") as bench:
        fitted = unfitted(bench)
        first = visited.ranking(bench, fitted)
        before = bench.meter.full
        second = visited.ranking(bench, moved(fitted, by))
        simulated = bench.meter.full - before
    assert (second is not first) is again
    assert (simulated > 0) is again


def test_a_ranking_that_is_handed_over_is_kept():
    visited = VisitedModels(1.0)
    with battery("co_simulation") as bench:
        fitted = unfitted(bench)
        made = VisitedModels(1.0).ranking(bench, fitted)
        visited.keep(bench, fitted, made)
        assert visited.ranking(bench, fitted) is made


def test_where_a_ranking_takes_no_simulation_of_its_own_it_is_made_again():
    visited = VisitedModels(1.0)
    with battery("model_exchange") as bench:
        fitted = unfitted(bench)
        assert visited.ranking(bench, fitted) is not visited.ranking(bench, fitted)


def test_what_was_grown_from_a_model_is_known_with_the_new_effect_last():
    visited = VisitedModels(1.0)
    visited.add(fit_of("a"), [grown("ba", 5.0), grown("ac", 4.0)])
    visited.add(fit_of("b"), [grown("ba", 5.0)])
    known = visited.grown_from(moved(fit_of("a"), SMALL))
    assert [[c.effect.name for c in one.fitted.added] for one in known] == [["a", "b"], ["a", "c"]]
    (other,) = visited.grown_from(fit_of("b"))
    assert other.candidate.effect.name == "a"


def test_a_model_that_has_moved_has_grown_nothing_yet():
    visited = VisitedModels(1.0)
    visited.add(fit_of("a"), [grown("ab", 5.0)])
    assert visited.grown_from(moved(fit_of("a"), LARGE)) == []
    assert visited.grown_from(fit_of("c")) == []


def test_of_one_structure_the_better_refit_stays_whatever_the_order():
    refits = [grown("ab", 5.0), grown("ab", 3.0), grown("ab", 4.0)]
    for order in (refits, refits[::-1]):
        visited = VisitedModels(1.0)
        for each in order:
            visited.add(fit_of("a"), [each])
        assert [c.criterion for c in visited.grown_from(fit_of("a"))] == [3.0]


def test_brief_refits_and_free_curves_are_not_known():
    visited = VisitedModels(1.0)
    visited.add(fit_of("a"), [grown("ab", 5.0, full=False), grown("ac", 4.0, "table")])
    assert visited.grown_from(fit_of("a")) == []
