import math
import re
from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_fitter,
    made_problem,
    made_refit,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.findings.competing_models import (
    CRITERION_SCALE,
    ResampledChoices,
    likely_sentence,
    likely_structures,
    resampled_choices,
    with_choices,
    with_probabilities,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure


def compared(*pairs):
    return [
        ComparedStructure(1, tuple(effects.split("+")), criterion, 1.0, True, False)
        for effects, criterion in pairs
    ]


NINE_TIMES = 2.0 * CRITERION_SCALE * math.log(9.0)
PATH = compared(("a", -5000.0), ("b", -5000.0 + NINE_TIMES), ("a+b", -3000.0))


def test_twice_the_logarithm_of_the_odds_is_the_difference_of_the_criterion():
    first, second, third, declared = with_probabilities(PATH, 0.0)
    assert (first.probability, second.probability) == pytest.approx((0.9, 0.1))
    assert max(third.probability, declared.probability) < 1e-40


def test_the_declared_model_is_one_of_them():
    only, declared = with_probabilities(compared(("a", -NINE_TIMES)), 0.0)
    assert (only.probability, declared.probability) == pytest.approx((0.9, 0.1))
    assert declared.effects == ()


def test_each_effect_pays_for_the_choice_among_all():
    path = compared(("a", -5000.0), ("a+b", -5000.0 - NINE_TIMES))
    assert with_probabilities(path, 0.0)[1].probability == pytest.approx(0.9)
    assert with_probabilities(path, NINE_TIMES)[1].probability == pytest.approx(0.5)


def test_a_set_counts_once_at_its_best_whatever_the_order_of_its_effects():
    rows = with_probabilities(compared(("a+b", -5000.0), ("b+a", -4900.0), ("b", -1000.0)), 0.0)
    assert rows[0].probability == pytest.approx(1.0)
    assert math.isnan(rows[1].probability)


def test_the_likely_ones_are_the_fewest_that_hold_nine_tenths():
    path = compared(("a", -5000.0), ("b", -4999.0), ("c", -4998.0), ("d", -4000.0))
    likely = likely_structures(with_probabilities(path, 0.0))
    assert [each.effects for each in likely] == [("a",), ("b",), ("c",)]


def test_what_was_added_is_named_in_any_case():
    path = compared(("a", -5000.0), ("b", -4900.0))
    path[1] = replace(path[1], accepted=True)
    likely = likely_structures(with_probabilities(path, 0.0))
    assert [each.effects for each in likely] == [("a",), ("b",)]
    assert likely_sentence(with_probabilities(path, 0.0)).endswith("and less than 1 % for b")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (
            [("a+x", -5000.0), ("b", -4984.0), ("c", -400.0)],
            "4 sets of effects .* the probability is 73 % for a + x and 27 % for b",
        ),
        ([("a", -5000.0), ("c", -400.0)], "the probability is more than 99 % for a"),
        ([("a", -NINE_TIMES + 1.0)], "% for a and 11 % for no effect"),
        ([("a", -5000.0), ("b", -5000.0)], "50 % for a and 50 % for b"),
    ],
)
def test_sentences(path, said):
    found = likely_sentence(with_probabilities(compared(*path), 0.0))
    assert re.search(said.replace("+", r"\+") + "$", found)


def test_a_sentence_names_a_few():
    path = compared(*((f"e{i}", -5000.0) for i in range(30)))
    said = likely_sentence(with_probabilities(path, 0.0))
    assert re.search(r"3 % for e3 and at most this much for each of 2[34] other sets$", said)
    assert "e4" not in said


LAWS = ("coulomb at der(v)", "asymmetric_coulomb(w) at der(v)", "stribeck at der(v)")


@pytest.mark.parametrize(
    ("names", "shared"),
    [
        (LAWS, "; each of them has friction at der(v)"),
        ((*LAWS[:2], "quadratic at der(v)"), ""),  # a drag
        ((*LAWS[:2], "coulomb at der(w)"), ""),
        ((*LAWS[:2], "mine at der(v)"), ""),  # not of the library
        (("gain at output y+" + LAWS[0], LAWS[1] + "+gain at output y"),
         "; each of them has friction at der(v) and gain at output y"),
        (LAWS[:1], ""),
    ],
)  # fmt: skip
def test_a_sentence_says_what_all_likely_sets_share(names, shared):
    path = with_probabilities(compared(*((name, -5000.0) for name in names)), 0.0)
    assert likely_sentence(path).partition(";")[2].partition(";")[2] == shared.removeprefix(";")


def test_a_sentence_tells_the_probability_of_a_set_from_that_of_a_claim():
    path = with_probabilities(compared((LAWS[0], -5000.0), (LAWS[2], -5000.0)), 0.0)
    assert likely_sentence(path, claims=True) == (
        f"{likely_sentence(path)}; this compares exactly these sets by their fits; the probability "
        "that an effect is right comes from similar claims, and also counts laws that agree on the "
        "data"
    )


def test_nothing_is_said_where_nothing_is_known():
    assert likely_structures(PATH) == ()
    assert likely_sentence(PATH) == ""


def searched(runs, rival_worse, *, converged=True):
    """An effect that was added, and a rival that is worse in some experiments, better in others."""
    problem = made_problem(*runs)
    fitter = made_fitter(problem)
    generator = np.random.default_rng(1)
    base = fit_with_squares(problem, 9.0 * sum(runs))
    noise = generator.standard_normal(sum(runs))
    current = fit_with_squares(problem, 1.0, [made_candidate("added")])
    current = replace(current, residuals=noise)
    factor = np.repeat([1.0 + each for each in rival_worse], runs)
    rival = replace(
        current,
        residuals=factor * noise,
        added=(made_candidate("rival", "load"),),
        converged=converged,
    )
    screening = made_screening(current.jacobian, current.residuals, [], [])
    last = made_round(None, screening)
    contender = made_refit(rival, rival.criterion(fitter.records))
    return fitter, made_selection(base, current, replace(last, contenders=(contender,)))


def test_one_that_is_better_everywhere_is_always_chosen():
    fitter, found = searched([60] * 6, [0.5] * 6)
    choices = resampled_choices(fitter, found)
    (own,) = (labels for labels, share in choices.shares.items() if share == 1.0)
    assert own == tuple(each.label for each in found.current.added)
    assert choices.sentence.startswith("in 200 resamplings of the 6 experiments, the ")
    assert choices.sentence.endswith(f"best set of effects was {own[0]} in more than 99 %")


def test_a_set_whose_refit_has_not_converged_is_not_chosen():
    """Its linear model may promise a fit that it would never reach."""
    fitter, found = searched([60] * 6, [-0.3] * 6, converged=False)
    shares = resampled_choices(fitter, found).shares
    assert list(shares) == [tuple(each.label for each in found.current.added)]


def test_one_that_is_better_in_a_part_of_the_experiments_is_chosen_sometimes():
    fitter, found = searched([60] * 6, [0.3, 0.3, 0.3, 0.3, -0.25, -0.25])
    shares = sorted(resampled_choices(fitter, found).shares.values())
    assert shares[-1] + shares[-2] == pytest.approx(1.0)
    assert 0.02 < shares[-2] < 0.5
    again = sorted(resampled_choices(fitter, found).shares.values())
    assert shares == again


def test_of_few_experiments_parts_of_the_records_are_drawn():
    fitter, found = searched([100], [0.5])
    choices = resampled_choices(fitter, found)
    assert "tenths of the records" in choices.sentence
    assert max(choices.shares.values()) == 1.0


def test_nothing_where_nothing_was_added():
    fitter, found = searched([100], [0.5])
    assert resampled_choices(fitter, replace(found, current=found.base)) is None


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
    assert choices.sentence.endswith("the best set of effects was a in 70 % and a + b in 30 %")
    assert with_choices(rows, None) == tuple(rows)
