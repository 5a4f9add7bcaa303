"""The probability of each set of effects among those that were compared."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.truth.stacked_noise import autoregressive, stack

from cluster_est.closed_loop.findings.structure_probabilities import (
    likely_sentence,
    likely_structures,
    noise_widening,
    percent,
    with_probabilities,
)
from cluster_est.closed_loop.selection.rounds import ComparedStructure


def compared(*pairs):
    return [
        ComparedStructure(1, tuple(effects.split("+")), criterion, 1.0, True, False)
        for effects, criterion in pairs
    ]


NINE_TIMES = 2.0 * math.log(9.0)
PATH = compared(("a", -500.0), ("b", -500.0 + NINE_TIMES), ("a+b", -300.0))


def test_twice_the_logarithm_of_the_odds_is_the_difference_of_the_criterion():
    first, second, third = with_probabilities(PATH)
    assert (first.probability, second.probability) == pytest.approx((0.9, 0.1))
    assert third.probability < 1e-40


def test_the_declared_model_is_one_of_them():
    (only,) = with_probabilities(compared(("a", -NINE_TIMES)))
    assert only.probability == pytest.approx(0.9)


def test_a_set_counts_once_at_its_best_whatever_the_order_of_its_effects():
    path = with_probabilities(compared(("a+b", -500.0), ("b+a", -490.0), ("b", -400.0)))
    assert path[0].probability == pytest.approx(1.0)
    assert math.isnan(path[1].probability)


def test_autocorrelated_noise_divides_the_evidence():
    first, second, _ = with_probabilities(PATH, widening=2.0)
    assert first.probability / second.probability == pytest.approx(9.0**0.25)


def test_the_widening_is_that_of_the_output_where_it_is_most():
    records = stack(4000, outputs=2)
    noise = autoregressive(records, np.array([[0.0], [0.5]]), np.random.default_rng(3))
    # (1 + 0.5) / (1 - 0.5) = 3, with a standard error of some 5 %
    assert noise_widening(noise, records) == pytest.approx(math.sqrt(3.0), rel=0.1)


def test_the_likely_ones_are_the_fewest_that_hold_nine_tenths():
    path = compared(("a", -500.0), ("b", -499.0), ("c", -498.0), ("d", -480.0))
    likely = likely_structures(with_probabilities(path))
    assert [each.effects for each in likely] == [("a",), ("b",), ("c",)]
    assert (
        sum(each.probability for each in likely)
        >= 0.9
        > sum(each.probability for each in likely[:-1])
    )


def test_sentences():
    path = compared(("a+x", -500.0), ("b", -498.0), ("c", -400.0))
    assert likely_sentence(with_probabilities(path)) == (
        "of the 3 sets of effects that were compared, the data give a + x 73 % of the probability "
        "and b 27 %"
    )
    alone = with_probabilities(compared(("a", -500.0), ("c", -400.0)))
    assert likely_sentence(alone).endswith("the data give a more than 99 % of the probability")


def test_nothing_is_said_where_nothing_is_known():
    assert likely_structures(PATH) == ()
    assert likely_sentence(PATH) == ""
    assert with_probabilities(()) == ()


@pytest.mark.parametrize(
    ("probability", "said"),
    [(0.9999, "more than 99 %"), (0.5, "50 %"), (0.004, "less than 1 %")],
)
def test_no_more_certainty_is_written_than_there_is(probability, said):
    assert percent(probability) == said
