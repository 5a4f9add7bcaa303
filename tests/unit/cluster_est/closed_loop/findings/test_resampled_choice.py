"""Sets of effects are chosen again where the experiments are drawn anew."""

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_problem,
    made_refit,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.findings.resampled_choice import (
    ResampledChoices,
    resampled_choices,
    with_choices,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure


def searched(runs, rival_worse):
    """An effect that was added, and a rival that is worse in some experiments, better in others."""
    problem = made_problem(*runs)
    bench = made_bench(problem)
    generator = np.random.default_rng(1)
    base = fit_with_squares(problem, 9.0 * sum(runs))
    noise = generator.standard_normal(sum(runs))
    current = fit_with_squares(problem, 1.0, [made_candidate("added")])
    current = replace(current, residuals=noise)
    factor = np.repeat([1.0 + each for each in rival_worse], runs)
    rival = replace(current, residuals=factor * noise, added=(made_candidate("rival", "load"),))
    screening = made_screening(current.jacobian, current.residuals, [], [])
    last = made_round(None, screening)
    contender = made_refit(rival, rival.criterion(bench.records))
    return bench, made_selection(base, current, replace(last, contenders=(contender,)))


def test_one_that_is_better_everywhere_is_always_chosen():
    bench, found = searched([60] * 6, [0.5] * 6)
    choices = resampled_choices(bench, found)
    (own,) = (labels for labels, share in choices.shares.items() if share == 1.0)
    assert own == tuple(each.label for each in found.current.added)
    assert choices.sentence.startswith("of 200 times that the 6 experiments were drawn anew, the ")
    assert choices.sentence.endswith(f"best set is {own[0]} in more than 99 %")


def test_one_that_is_better_in_a_part_of_the_experiments_is_chosen_sometimes():
    bench, found = searched([60] * 6, [0.3, 0.3, 0.3, 0.3, -0.25, -0.25])
    shares = sorted(resampled_choices(bench, found).shares.values())
    assert shares[-1] + shares[-2] == pytest.approx(1.0)
    assert 0.02 < shares[-2] < 0.5
    again = sorted(resampled_choices(bench, found).shares.values())
    assert shares == again


def test_of_few_experiments_parts_of_the_records_are_drawn():
    bench, found = searched([100], [0.5])
    choices = resampled_choices(bench, found)
    assert "tenths of the records" in choices.sentence
    assert max(choices.shares.values()) == 1.0


def test_nothing_where_nothing_was_added():
    bench, found = searched([100], [0.5])
    assert resampled_choices(bench, replace(found, current=found.base)) is None


def test_the_best_row_of_a_set_has_its_share():
    rows = [
        ComparedStructure(1, ("a",), -10.0, 0.9, converged=True, accepted=True),
        ComparedStructure(2, ("a",), -20.0, 0.9, converged=True, accepted=True),
        ComparedStructure(2, ("b", "a"), -15.0, 0.9, converged=False, accepted=False),
        ComparedStructure(2, ("c",), -5.0, 0.5, converged=False, accepted=False),
    ]
    choices = ResampledChoices("the 6 experiments", {("a",): 0.7, ("a", "b"): 0.3})
    found = [each.chosen for each in with_choices(rows, choices)]
    assert found == pytest.approx([np.nan, 0.7, 0.3, np.nan], nan_ok=True)
    assert choices.sentence.endswith("the best set is a in 70 % and a + b in 30 %")
    assert with_choices(rows, None) == tuple(rows)
