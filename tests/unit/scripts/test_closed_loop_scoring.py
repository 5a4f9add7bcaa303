from dataclasses import replace
from functools import cache
from math import comb, nan
from pathlib import Path

import pytest
from bench_closed_loop import Variant, Way, known_without
from closed_loop_benchmark import figures
from closed_loop_benchmark.data import Data, Sampling, make, make_problem
from closed_loop_benchmark.effect import SINGLE, Name
from closed_loop_benchmark.figures import has_probabilities, holds_truth
from closed_loop_benchmark.naming import compare, normal
from closed_loop_benchmark.oracle import ask, translate, true_values, with_effects
from closed_loop_benchmark.parts import is_right, mcnemar, paired, parts_page
from closed_loop_benchmark.scenarios import all_scenarios
from closed_loop_benchmark.scoring import Score, blank, coverage, score
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.tables import compare_runs, holds, page
from support.thinning import thinned

import cluster_est as ce
from cluster_est.closed_loop.findings.claims import ClaimEvidence, claim
from cluster_est.closed_loop.findings.effects import ErrorChange, NamedEffect, Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.problem.thinning import ThinningSettings
from workers.messages import Effect

CASES = {case.name: case for case in all_scenarios()}
LOAD = "mass_spring_damper/single/load x0.25"


@cache
def data_of(name: str) -> Data:
    return make(CASES[name])


@cache
def fitted(effect: Effect | None = None) -> ce.Result:
    """Fit the case of a load, with one effect whose only coefficient is k."""
    problem = make_problem(data_of(LOAD))
    if effect is not None:
        problem = with_effects(problem, [(effect, {"k": 0.1})])
    return ce.fit(problem, ce.LeastSquares(differences="forward", ftol=1e-8))


def said(*effects: Effect) -> LoopResult:
    """Return what a loop would say that names these effects, at most one."""
    before, after = fitted(), fitted(*effects)
    errors = tuple(
        ErrorChange.between(b, a, (b.normalised_after, a.normalised_after))
        for b, a in zip(before.errors, after.errors, strict=True)
    )
    named = tuple(NamedEffect(e, "", "", ()) for e in effects)
    verdict = Verdict.FOUND if effects else Verdict.NONE
    return LoopResult(
        verdict, "", named, before, after, errors, (), (), {}, (), (), 100.0, 100, 100, 0, 1.0
    )


def judged(*effects: Effect, only: Name | None = None) -> Score:
    """Score what is said; `only` leaves a true effect but one name."""
    data = data_of(LOAD)
    if only is not None:
        data = replace(data, scenario=replace(data.scenario, accepted=((only,),)))
    return score(data, said(*effects), ask(data, make_problem(data)))


@pytest.mark.parametrize(
    "system", thinned([(name,) for name in SYSTEMS], lambda name: SYSTEMS[name].interface)
)
def test_a_problem_has_the_truth_in_its_bounds_only_and_every_form_is_known(system):
    data = data_of(next(name for name in CASES if name.startswith(f"{system}/clean")))
    problem = make_problem(data)
    problem.describe()
    true = true_values(data)
    for parameter in problem.parameters:
        values = [v for label, v in true.items() if label.partition("[")[0] == parameter.name]
        assert values
        assert all(parameter.lower < value < parameter.upper for value in values)
        assert parameter.start not in values
    known = {name for run in problem.experiments for name, _ in run.values}
    assert known.isdisjoint(data.system.unknown_starts)
    for effect in SINGLE.get(system, ()):
        with_effects(problem, [translate(effect, 0)]).describe()


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (("coulomb", "der(v)", ("v",)), ("coulomb", "der(v)", ())),
        (("product", "der(h2)", ("u", "h1")), ("product", "der(h2)", ("h1*u",))),
        (("gap", "pair a,b", ("x - y",)), ("gap", "pair a,b", ("x-y",))),
        (("gap", "pair b, a", ("y - x",)), ("gap", "pair a,b", ("x-y",))),
        (("gap", "der(v)", ("x",)), ("end_stop", "der(v)", ("x",))),
        (("signed_root", "der(h)", ("h",)), ("leak", "der(h)", ("h",))),
        (("clip_above", "output y", ()), ("saturation", "output y", ())),
    ],
)
def test_one_effect_has_one_normal_name(ours, theirs):
    assert normal(*ours) == normal(*theirs)


def test_comparison_of_names():
    accepted = (Name("quadratic", "der(v)", "v"), Name("magnitude", "parameter c", "v"))
    own, other = (normal(n.form, n.site, (n.variable,)) for n in accepted)
    wrong = normal("cubic", "der(v)", ("v",))
    exact, alias, missed = (compare(accepted, [n], []) for n in (own, other, wrong))
    assert (exact.exact, exact.alias, exact.site) == (True, True, True)
    assert (alias.exact, alias.alias, alias.site, alias.any_site) == (False, True, False, True)
    assert (missed.alias, missed.site) == (False, True)
    near = [compare(accepted, [wrong], [(own, worse)]) for worse in (1.0, 5.0, 20.0)]
    assert [m.tied for m in near] == [True, False, False]
    assert [m.plausible for m in near] == [True, True, False]


def test_a_right_name_scores():
    found = judged(Effect("load", "der(v)", "constant"))
    assert found.exact == found.alias == found.site == [True]
    assert found.numerical
    assert found.detected
    assert found.superfluous == 0
    assert found.likelihood_ratio > 40.0
    assert found.after == pytest.approx(found.oracle, rel=1e-3)
    assert found.parameters_after < found.parameters_before
    assert Score.from_json(found.to_json()).to_json() == found.to_json()


EVIDENCE = ClaimEvidence(
    effects=1, shared=False, left=1.0, closed=1.0, rival=99.0, chosen=1.0, at_end=False, free=False
)  # fmt: skip


def test_claims_and_leads_are_marked_as_right_in_place_and_kind():
    load, other = (Effect("e", "der(v)", form) for form in ("constant", "quadratic"))
    elsewhere = Effect("e", "output y", "gain")
    lead = NamedEffect(elsewhere, "", "", (), claim=claim(EVIDENCE))
    found = {}
    for effect in (load, other):
        named = NamedEffect(effect, "", "", (), claim=claim(EVIDENCE))
        result = replace(said(effect), effects=(named,), rejected=(lead,))
        data = data_of(LOAD)
        first, second = score(data, result, ask(data, make_problem(data))).claims
        found[effect.form] = [
            (row["claimed"], row["right"], row["place"]) for row in (first, second)
        ]
        assert (first["left"], first["effects"]) == (1.0, 1)
    assert found["constant"][0] == (True, True, True)
    assert found["quadratic"] == [(True, False, True), (False, False, False)]
    assert judged(load).claims == []  # of which nobody asked how sure they are


def test_another_name_of_the_same_model_is_found_out_by_its_numbers():
    bias = Effect("bias", "input F", "bias")
    assert judged(bias).alias == [True]
    found = judged(bias, only=Name("constant", "der(v)"))
    assert (found.alias, found.site, found.numerical) == ([False], [False], True)
    assert figures.strictly_right(found)
    assert not figures.strictly_right(replace(found, coefficients=2))
    assert not figures.strictly_right(replace(found, distance=0.09, distance_without=0.1))


def test_a_wrong_name_and_silence_do_not_score():
    found = judged(Effect("wrong", "der(v)", "quadratic"))
    assert (found.alias, found.site, found.numerical) == ([False], [True], False)
    assert found.distance > 0.1
    silent = judged()
    assert (silent.alias, silent.detected) == ([False], False)
    assert silent.after == silent.before


def test_a_page_counts_what_is_right():
    right = judged(Effect("load", "der(v)", "constant"))
    wrong = replace(right, exact=[False], alias=[False], numerical=False, simulations=300.0)
    failed = blank(data_of(LOAD), "Traceback:\nValueError: why")
    text = page([right, wrong, replace(failed, name="failed")])
    assert "| one effect: detected | >= 98 % | 2/2 (100.0 %) |" in text
    assert "| right: any of these | >= 92 % | 1/2 (50.0 %) |" in text
    assert "| failed | ValueError: why |" in text


def test_two_runs_are_compared_case_by_case_in_what_both_have():
    right = judged(Effect("load", "der(v)", "constant"))
    silent = replace(right, true=[], named=[], verdict="none", alias=None)
    wrong = [
        replace(right, alias=[False], numerical=False),
        replace(right, after=right.before + 0.5),
        replace(right, error="Traceback"),
        replace(silent, named=["drag"], verdict="found"),
    ]
    good = [right, replace(wrong[0], numerical=True), silent, replace(wrong[0], kind="outside")]
    assert [*map(holds, good), *map(holds, wrong)] == [True] * 4 + [False] * 4
    text, lost = compare_runs({"a": right, "b": silent}, {"a": wrong[0], "b": silent, "c": right})
    assert lost == 1
    assert [line[:4] for line in text.splitlines()[:2]] == ["was ", "is  "]
    assert text.endswith("2 cases in both: right 2 -> 1, no longer right 1, now right 0")
    assert compare_runs({"a": wrong[0]}, {"a": right})[0].startswith("now right: a\n")


def test_parts_that_were_left_out_are_compared_on_the_cases_that_came_to_an_end():
    right = replace(judged(Effect("load", "der(v)", "constant")), active=["restarts"])
    wrong = replace(right, alias=[False], numerical=False, after=1.5 * right.after, simulations=1.0)
    runs = {
        "as it is": {"a": replace(right, simulations=4.0), "b": replace(wrong, simulations=9.0)},
        "restarts": {"a": wrong, "b": right, "c": right},
        "merge+drop": {"a": replace(right, error="Traceback"), "b": wrong},
    }
    _, _, restarts, merge = paired(runs).splitlines()
    assert restarts.startswith(
        "| restarts | 2 | 2 | 1 | 1 | 1 (single 1) | 1 (single 1) | 1 | 1, 1 | 1.083 | 1.500 | x "
    )
    assert merge == "| merge+drop | 1 | 0 | 0 | 0 | 0 | 0 | 1 | 1, 1 | 1.000 | 1.000 | x 0.111 |"
    listed = parts_page(runs).splitlines()
    assert sum(line.startswith(("| restarts", "| merge+drop")) for line in listed) == 2 + 2


def test_parts_that_the_search_no_longer_has_are_listed_as_deleted():
    one = {"a": judged()}
    runs = {"as it is": one, "restarts": one, "drop": one, "drop+waves": one}
    kept, _, deleted = parts_page(runs).partition("## Parts that were deleted")
    assert "| drop | " in kept
    assert "| drop+waves | " in kept
    assert "| restarts | " in deleted
    assert "| restarts | " not in kept


def test_what_is_said_without_a_part_that_changed_nothing_is_known():
    whole = replace(judged(), active=["add"], spans=[("restarts", 10.0, 30.0)], simulations=100.0)
    way = Way(ce.LoopSettings(), Sampling(), ThinningSettings())
    restarts, both = (Variant(x, way, Path(x)) for x in ("restarts", "restarts+add"))
    known = known_without(whole, restarts)
    assert known is not None
    assert (known.named, known.simulations, known.active) == (whole.named, 80.0, None)
    assert known_without(whole, both) is None
    assert known_without(replace(whole, active=None), restarts) is None


@pytest.mark.parametrize(("lost", "won", "p"), [(0, 0, 1.0), (5, 0, 2 / 32), (4, 1, 12 / 32)])
def test_lost_and_won_cases_are_compared_by_the_exact_test_of_mcnemar(lost, won, p):
    assert mcnemar(lost, won) == pytest.approx(p)


def test_what_is_right_where_no_name_is():
    known = judged(Effect("load", "der(v)", "constant"))
    outside = replace(known, kind="outside", oracle=known.after / 1.4)
    silent = replace(known, true=[], named=[])
    assert is_right(outside)
    assert not is_right(replace(outside, oracle=known.after / 1.6))
    assert is_right(silent)
    assert not is_right(replace(silent, named=["drag"]))
    assert not is_right(replace(outside, before=0.9 * known.after))


def test_bound_of_a_probability():
    assert figures.upper_bound(0, 136) == pytest.approx(1.0 - 0.05 ** (1 / 136))
    bound = figures.upper_bound(2, 50)
    tail = sum(comb(50, k) * bound**k * (1.0 - bound) ** (50 - k) for k in range(3))
    assert tail == pytest.approx(0.05)
    assert figures.upper_bound(0, 0) == 1.0


@pytest.mark.parametrize(
    ("likely", "holds"),
    [
        ([["constant at der(v)"], ["cubic at der(v)"]], True),
        ([["bias at input F"]], True),  # an algebraic alias
        ([["cubic at der(v)"], []], False),
        ([["constant at der(v)", "cubic at der(v)"]], False),
    ],
)
def test_the_likely_sets_hold_the_truth_by_any_of_its_names(likely, holds):
    seen = replace(blank(data_of(LOAD)), has_oracle=True, likely=likely)
    assert has_probabilities(seen)
    assert holds_truth(seen) is holds


@pytest.mark.parametrize(
    ("effect", "low", "high", "expected"),
    [
        (Effect("e", "der(v)", "constant"), -1.0, 1.0, (1, 1)),
        (Effect("e", "der(v)", "constant"), 1.0, 2.0, (0, 1)),
        (Effect("e", "der(v)", "constant"), nan, nan, (0, 0)),  # it is held
        (Effect("e", "input F", "bias"), -1.0, 1.0, (0, 0)),  # the same model under another name
    ],
)
def test_intervals_of_effects_with_the_right_name_are_compared_with_the_truth(
    effect, low, high, expected
):
    data, found = data_of(LOAD), said(effect)
    (estimate,) = [e for e in found.after.estimates if e.label == "e.k"]
    true = data.scenario.effects[0].numbers[0]
    around = replace(estimate, value=true, lower95=true + low, upper95=true + high)
    (named,) = found.effects
    found = replace(found, effects=(replace(named, coefficients=(around,)),))
    assert coverage(data, found) == expected
