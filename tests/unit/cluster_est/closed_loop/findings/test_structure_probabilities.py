"""The probability of each set of effects among those that were compared."""

import math
import re
from dataclasses import replace

import pytest

from cluster_est.closed_loop.findings.structure_probabilities import (
    TEMPERATURE,
    likely_sentence,
    likely_structures,
    with_probabilities,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure


def compared(*pairs):
    return [
        ComparedStructure(1, tuple(effects.split("+")), criterion, 1.0, True, False)
        for effects, criterion in pairs
    ]


NINE_TIMES = 2.0 * TEMPERATURE * math.log(9.0)
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
    assert likely_sentence(with_probabilities(path, 0.0)).endswith("and b less than 1 %")


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (
            [("a+x", -5000.0), ("b", -4984.0), ("c", -400.0)],
            "of the 4 sets of effects .* a + x 73 % of the probability and b 27 %",
        ),
        ([("a", -5000.0), ("c", -400.0)], "give a more than 99 % of the probability"),
        ([("a", -NINE_TIMES + 1.0)], "% of the probability and no effect 11 %"),
        ([("a", -5000.0), ("b", -5000.0)], "a 50 % of the probability and b 50 %"),
    ],
)
def test_sentences(path, said):
    found = likely_sentence(with_probabilities(compared(*path), 0.0))
    assert re.search(said.replace("+", r"\+") + "$", found)


def test_a_sentence_names_a_few():
    path = compared(*((f"e{i}", -5000.0) for i in range(30)))
    said = likely_sentence(with_probabilities(path, 0.0))
    assert re.search(r"e3 3 % and 2[34] more the rest$", said)
    assert "e4" not in said


def test_nothing_is_said_where_nothing_is_known():
    assert likely_structures(PATH) == ()
    assert likely_sentence(PATH) == ""
