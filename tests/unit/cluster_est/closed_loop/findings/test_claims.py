from dataclasses import replace

import numpy as np
import pytest
from support.named_effects import estimate

from cluster_est.closed_loop.findings.claim_evidence import how_sure, with_claims, without_claims
from cluster_est.closed_loop.findings.claims import (
    CALIBRATION,
    FEW,
    ClaimCalibration,
    ClaimEvidence,
    LikeClaims,
    claim,
    lead,
)
from cluster_est.closed_loop.findings.effects import ErrorChange, NamedEffect, Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.closed_loop.selection.rounds import ComparedStructure
from workers.messages import Effect

EVIDENCE = ClaimEvidence(
    effects=1, shared=False, left=1.0, closed=1.0, rival=99.0, chosen=1.0, at_end=False, free=False
)  # fmt: skip
KNOWN = ClaimCalibration(
    origin="",
    intercept=-1.0,
    fewer=1.0,
    clean=1.0,
    apart=1.0,
    chosen=1.0,
    alike=(LikeClaims(0.0, 20, 50), LikeClaims(0.5, 40, 50), LikeClaims(0.9, 38, 40)),
    doubtful=LikeClaims(0.0, 9, 21),
    curves=LikeClaims(0.0, 3, 5),
    leads=LikeClaims(0.0, 12, 75),
    lead_places=LikeClaims(0.0, 33, 75),
)


@pytest.mark.parametrize(
    "worse",
    [{"effects": 3}, {"left": 3.0}, {"shared": True}, {"chosen": 0.3}],
    ids=str,
)
@pytest.mark.parametrize("known", [KNOWN, CALIBRATION], ids=["made", "of the package"])
def test_what_speaks_against_an_effect_makes_its_claim_less_sure(known, worse):
    doubted = replace(EVIDENCE, left=1.5, effects=2)  # below what the surest claims allow for
    assert claim(replace(doubted, **worse), known).probability < claim(doubted, known).probability


def test_nothing_is_surer_than_the_surest_claims_of_the_benchmark_allow_for():
    sure = claim(EVIDENCE, replace(KNOWN, intercept=50.0))
    assert sure.probability == pytest.approx(39 / 42)
    assert sure.sentence.endswith(
        f"of the 40 surest claims in the benchmark, 38 were right {AGREEING}"
    )


AGREEING = "(a law that agrees with the true one on the data counts as right)"


@pytest.mark.parametrize(
    ("intercept", "like"),
    [
        (-1.0, "of 50 claims with 50 % to 90 % in the benchmark, 40 were right"),
        (1.0, "of the 40 surest claims in the benchmark, 38 were right"),
    ],
)
def test_a_claim_says_how_many_were_right_in_which_range_of_probabilities(intercept, like):
    found = claim(EVIDENCE, replace(KNOWN, intercept=intercept))
    sure = f"place and law are right with a probability of {100 * found.probability:.0f} %"
    assert found.sentence == f"{sure}: {like} {AGREEING}"


def test_a_lead_is_not_compared_with_claims_that_are_surer():
    found = claim(EVIDENCE, replace(KNOWN, intercept=-4.0))
    sure = f"place and law are right with a probability of {100 * found.probability:.0f} %"
    assert found.sentence == f"this is a lead, not a claim: {sure} {AGREEING}"


def test_a_claim_below_all_of_the_benchmark_is_like_the_least_sure_ones():
    known = replace(KNOWN, alike=(LikeClaims(0.7, 20, 50), LikeClaims(0.8, 40, 50)))
    found = claim(replace(EVIDENCE, left=1.1), replace(known, intercept=-2.0))
    assert 0.5 <= found.probability < 0.7
    assert "of 50 claims with less than 80 %" in found.sentence


@pytest.mark.parametrize("doubt", [{"left": 1.6}, {"at_end": True}], ids=str)
def test_a_claim_in_doubt_is_no_surer_than_those_of_the_benchmark(doubt):
    sure = replace(KNOWN, intercept=50.0)
    found = claim(replace(EVIDENCE, **doubt), sure)
    assert found.probability == pytest.approx(10 / 23)
    assert not found.claimed
    assert found.sentence == (
        "this is a lead, not a claim: place and law are right with a probability of 43 %: of 21 "
        f"equally doubtful claims in the benchmark (a small number), 9 were right {AGREEING}"
    )
    doubted = claim(replace(EVIDENCE, left=40.0, effects=4), replace(KNOWN, intercept=-3.0))
    assert doubted.probability < 10 / 23
    share = f"{100 * doubted.probability:.0f} %" if doubted.probability >= 0.01 else "less than 1 %"
    said = f"a probability of {share} {AGREEING}"
    assert doubted.sentence.endswith(said)  # 9 of 21 is not the reason


def test_a_choice_that_nobody_made_is_as_sure_as_one_that_is_made_always():
    unknown = claim(replace(EVIDENCE, chosen=np.nan, left=1.5), KNOWN)
    assert unknown.probability == claim(replace(EVIDENCE, left=1.5), KNOWN).probability


def test_a_free_curve_is_a_place_and_no_law():
    found = claim(replace(EVIDENCE, free=True), KNOWN)
    assert found.sentence == (
        "this is a place without a law: of 5 free curves in the benchmark (a small number), 3 were "
        "at the right place"
    )
    assert found.probability == pytest.approx(4 / 7)


def test_a_lead_is_no_claim_and_has_no_probability():
    found = lead(EVIDENCE, KNOWN)
    assert np.isnan(found.probability)
    assert found.sentence == (
        "this is a lead, not a claim: of 75 leads in the benchmark, in which the missing effect "
        "is known, 12 (16%) were right in place and law, and 33 (44%) at least in place"
    )


def test_the_calibration_rests_on_enough_claims_and_no_weight_is_negative():
    assert min(bin_.of for bin_ in CALIBRATION.alike) >= FEW
    assert f"{sum(bin_.of for bin_ in CALIBRATION.alike)} claims" in CALIBRATION.origin
    weights = CALIBRATION.fewer, CALIBRATION.clean, CALIBRATION.apart, CALIBRATION.chosen
    assert min(weights) >= 0.0
    shares = [bin_.right / bin_.of for bin_ in CALIBRATION.alike]
    assert shares[-1] > shares[0]


ERROR = ErrorChange("a", "train", "y", "m", 100, 2.0, 1.1, 2.0, 1.1)
HELD_OUT = replace(ERROR, experiment="b", role="test", normalised_before=5.0, normalised_after=1.0)


def named(form: str, site: str = "der(v)", *variables: str) -> NamedEffect:
    effect = Effect(form, site, form, variables)
    return NamedEffect(effect, "", "", (), label=f"{form} at {site}")


def row(criterion: float, closed: float, chosen: float, *effects: NamedEffect) -> ComparedStructure:
    labels = tuple(effect.label for effect in effects)
    return ComparedStructure(1, labels, criterion, closed, True, False, chosen=chosen)


FRICTION, GAIN, DRAG = named("coulomb"), named("gain", "output y"), named("quadratic")
ROWS = (
    row(-90.0, 0.9, 0.6, FRICTION, GAIN),
    row(-60.0, 0.5, 0.3, FRICTION),
    row(-10.0, 0.2, 0.1, GAIN),
)


def evidence(effects, errors=(ERROR, HELD_OUT), structures=ROWS) -> list[ClaimEvidence]:
    found = with_claims(effects, errors, structures, declared=True, claimed=True)
    return [each.claim.evidence for each in found]


def test_an_effect_is_compared_with_all_that_lacks_it():
    first, second = evidence([FRICTION, GAIN])
    assert first.effects == second.effects == 2
    assert (first.rival, second.rival) == (80.0, 30.0)
    assert (first.chosen, second.chosen) == pytest.approx((0.9, 0.7))


def test_the_gap_is_that_of_held_out_data_where_there_are_some():
    (both,) = evidence([FRICTION])
    assert (both.closed, both.left) == pytest.approx((1.0, 1.1))
    (training,) = evidence([FRICTION], [ERROR])
    assert training.closed == pytest.approx((4.0 - 1.21) / 3.0)


def test_effects_of_one_place_and_argument_share_it():
    assert [each.shared for each in evidence([FRICTION, GAIN, DRAG])] == [True, False, True]
    over = [named("linear", "der(v)", "u"), named("square", "der(v)", "w")]
    assert not any(each.shared for each in evidence(over))


@pytest.mark.parametrize(("declared", "left"), [(True, 1.5), (False, 1.25)])
def test_experiments_may_differ_in_noise_that_is_estimated(declared, left):
    loud = replace(HELD_OUT, normalised_after=1.5)
    quiet = replace(ERROR, experiment="c", normalised_after=0.8)
    errors = [replace(ERROR, normalised_after=1.2), quiet, loud]
    (found,) = with_claims([FRICTION], errors, ROWS, declared=declared, claimed=True)
    assert found.claim.evidence.left == pytest.approx(left)


def by_experiment(form, *intervals, shared=()):
    """An effect with a strength a for each experiment, and other coefficients."""
    rows = [
        replace(estimate("a", 0.5 * (low + high)), label=f"e.a[run {i}]", lower95=low, upper95=high)
        for i, (low, high) in enumerate(intervals)
    ]
    made = replace(named(form, "der(v)"), coefficients=(*rows, *shared))
    return replace(made, effect=replace(made.effect, name="e"))


@pytest.mark.parametrize(
    ("effect", "claimed"),
    [
        (by_experiment("emptying", (-1.0, 2.0), (-3.0, 1.0), shared=[estimate("tau", 9.0)]), False),
        (by_experiment("emptying", (-1.0, np.nan), (np.nan, np.nan)), False),
        (by_experiment("emptying", (-1.0, 2.0), (0.1, 1.0)), True),
        (by_experiment("store_from_elsewhere", (-1.0, 2.0), shared=[estimate("k", 2.0)]), True),
    ],
)
def test_strengths_by_experiment_that_may_all_be_zero_are_no_claim(effect, claimed):
    (found,) = with_claims([effect], [ERROR, HELD_OUT], ROWS, declared=True, claimed=True)
    assert found.claimed is claimed


def test_nothing_is_said_where_no_noise_is_known():
    unknown = replace(ERROR, normalised_before=np.nan, normalised_after=np.nan)
    assert with_claims([FRICTION], [unknown], ROWS, declared=True, claimed=True) == (FRICTION,)
    assert how_sure([FRICTION], claimed=True) == ""


def test_the_summary_says_how_sure_each_effect_is():
    curve = replace(GAIN, family="table")
    found = with_claims([FRICTION, curve], [ERROR, HELD_OUT], ROWS, declared=True, claimed=True)
    said = how_sure(found, claimed=True)
    assert said.startswith("probability that place and law are right: coulomb at der(v) ")
    assert said.endswith("(its place)")
    loud = replace(HELD_OUT, normalised_after=9.0)
    doubtful = with_claims([FRICTION], [ERROR, loud], ROWS, declared=True, claimed=True)
    assert not doubtful[0].claimed
    assert how_sure(doubtful, claimed=True).endswith(
        ". Below 50 %, an effect is only a lead: check coulomb at der(v) by a test or an "
        "inspection before you rely on it"
    )
    leads = with_claims([FRICTION, GAIN], [ERROR, HELD_OUT], ROWS, declared=True, claimed=False)
    assert how_sure(leads, claimed=False).startswith(
        "best guess: coulomb at der(v) and gain at output y: for each effect, this is a lead"
    )
    told = replace(leads[0], words="Coulomb friction", equation="der(v) += -k * tanh(v / w)")
    assert how_sure([told], claimed=False).startswith(
        "best guess: coulomb at der(v) (Coulomb friction: der(v) += -k * tanh(v / w)): this is"
    )


SURE, UNSURE = claim(EVIDENCE, CALIBRATION), claim(replace(EVIDENCE, left=9.0), CALIBRATION)
NONE_OF_THEM = "The effects follow the data, but none of them is more likely right than wrong"
ONE = "The effect follows the data, but it is more likely wrong than right"


@pytest.mark.parametrize(
    ("claims", "verdict", "said"),
    [
        ([UNSURE, UNSURE], Verdict.PARTIAL, f". {NONE_OF_THEM}"),
        ([UNSURE], Verdict.PARTIAL, f". {ONE}"),
        ([UNSURE, SURE], Verdict.FOUND, ""),
        ([None, None], Verdict.FOUND, ""),  # unknown noise
        ([], Verdict.FOUND, ""),
    ],
)
def test_leads_alone_are_not_found(claims, verdict, said):
    effects = [replace(FRICTION, claim=each) for each in claims]
    judged = without_claims(ReasonedVerdict(Verdict.FOUND, "they remove 99%"), effects)
    assert (judged.verdict, judged.reason) == (verdict, f"they remove 99%{said}")
    other = ReasonedVerdict(Verdict.PARTIAL, "they remove 80%")
    assert without_claims(other, effects) is other
