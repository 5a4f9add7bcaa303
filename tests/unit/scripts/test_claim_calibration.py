from dataclasses import asdict, replace

import numpy as np
import pytest
from closed_loop_benchmark.claim_calibration import (
    KnownClaim,
    area_under_curve,
    calibrated,
    calibration_report,
    claims_of,
    fitted,
    left_out,
)
from closed_loop_benchmark.scoring import Score

from cluster_est.closed_loop.findings.claims import REST, ClaimEvidence

EVIDENCE = ClaimEvidence(
    effects=1, shared=False, left=1.0, closed=1.0, rival=99.0, chosen=1.0, at_end=False, free=False
)  # fmt: skip
SYSTEMS = ("room", "pendulum", "battery")


def made_claims(count: int = 240) -> list[KnownClaim]:
    """Claims that are right with a probability that falls with what is left."""
    random = np.random.default_rng(4)
    made = []
    for number in range(count):
        beyond = 10.0 ** random.uniform(-3.0, 0.0)
        left = float(np.sqrt(1.0 + beyond))
        right = bool(random.random() < 1.0 / (1.0 + np.exp(1.5 - 5.0 * REST / (REST + beyond))))
        evidence = replace(EVIDENCE, left=left, effects=int(random.integers(1, 4)))
        system = SYSTEMS[number % len(SYSTEMS)]
        made.append(KnownClaim(f"case {number}", system, True, "e", True, right, right, evidence))
    return made


def record(system: str, *rows: dict[str, object]) -> Score:
    return Score(f"{system}/one", system, "single", "tune", 1.0, 0.0, ["e"], claims=list(rows))


def row(effect: str = "e", **known: object) -> dict[str, object]:
    marks = {"effect": effect, "claimed": True, "right": True, "place": True}
    return {**asdict(EVIDENCE), **marks, **known}


def test_what_two_loops_say_alike_of_a_case_counts_once():
    twice = [record("room", row(), row("f")), record("room", row()), record("pendulum", row())]
    assert [(each.system, each.effect) for each in claims_of(twice)] == [
        ("room", "e"), ("room", "f"), ("pendulum", "e"),
    ]  # fmt: skip
    assert len(claims_of([record("room", row()), record("room", row(left=1.3))])) == 2
    assert claims_of([replace(record("room"), claims=None)]) == []


def test_a_regression_finds_the_odds_it_was_made_with():
    random = np.random.default_rng(0)
    x = random.normal(size=(20_000, 2))
    right = random.random(20_000) < 1.0 / (1.0 + np.exp(-(0.5 + 2.0 * x[:, 0])))
    intercept, weights = fitted(x, right)
    assert intercept == pytest.approx(0.5, abs=0.06)
    assert weights == pytest.approx([2.0, 0.0], abs=0.06)


def test_no_weight_is_negative_and_none_is_infinite():
    x = np.array([[0.0], [0.0], [1.0], [1.0]])
    right = np.array([True, True, False, False])
    assert fitted(x, right)[1] == pytest.approx([0.0])
    assert 0.0 < fitted(x, ~right)[1][0] < 10.0


def test_a_systems_own_claims_do_not_say_how_sure_they_are():
    claims = made_claims()
    other = [
        replace(each, right=not each.right) if each.system == "room" else each for each in claims
    ]
    own = np.array([each.system == "room" for each in claims])
    one, two = left_out(claims)[0], left_out(other)[0]
    np.testing.assert_array_equal(one[own], two[own])
    assert not np.allclose(one[~own], two[~own])


def test_the_area_under_the_curve_is_how_often_right_claims_are_surer():
    right = np.array([False, True, False, True])
    assert area_under_curve(np.array([0.1, 0.4, 0.2, 0.9]), right) == 1.0
    assert area_under_curve(np.array([0.5, 0.5, 0.5, 0.5]), right) == 0.5
    assert area_under_curve(np.array([0.1, 0.2, 0.3, 0.4]), right) == 0.75


def test_the_calibration_has_bins_of_laws_that_rise_and_counts_curves_and_leads_apart():
    free = replace(EVIDENCE, free=True)
    more = [
        KnownClaim("c", "room", True, "curve", True, False, True, free),
        KnownClaim("d", "room", True, "lead", False, False, True, EVIDENCE),
        KnownClaim("d", "room", True, "lead", False, True, True, EVIDENCE),
    ]
    found = calibrated([*made_claims(), *more])
    assert sum(bin_.of for bin_ in found.alike) == 240
    shares = [bin_.right / bin_.of for bin_ in found.alike]
    assert shares == sorted(shares)
    assert shares[-1] > shares[0]
    assert [bin_.least for bin_ in found.alike] == sorted(bin_.least for bin_ in found.alike)
    assert found.clean > 0.5
    assert (found.curves.right, found.curves.of) == (1, 1)
    assert (found.leads.right, found.lead_places.right, found.leads.of) == (1, 2, 2)
    assert "1 free curves, 2 leads" in found.origin


def scores(said: str) -> tuple[float, float]:
    words = said.splitlines()[1].replace(",", "").replace(";", "").split()
    one, other, *_ = (float(word) for word in words if word[0].isdigit())
    return one, other


def test_the_report_says_whether_what_was_said_holds():
    said = calibration_report(made_claims())
    brier, base = scores(said)
    assert brier < base
    assert "outside" not in said
    assert "never tuned on" not in said
    assert "CALIBRATION = ClaimCalibration(" in said
    held_back = [replace(each, tuned=each.system != "room") for each in made_claims()]
    (line,) = (row for row in calibration_report(held_back).splitlines() if "never tuned" in row)
    assert " of 80 " in line
