"""What a closed loop says of a case is compared with the truth, and with nothing but the truth."""

from dataclasses import replace
from functools import cache
from math import comb, nan

import numpy as np
import pytest
from bench_closed_loop import divide, parse, settings_of
from closed_loop_benchmark import figures
from closed_loop_benchmark.coverage import coverage
from closed_loop_benchmark.data import Data, make
from closed_loop_benchmark.effect import Name
from closed_loop_benchmark.effects import SINGLE
from closed_loop_benchmark.likely import has_probabilities, holds_truth
from closed_loop_benchmark.naming import compare, normal
from closed_loop_benchmark.oracle import ask, translate, true_values, with_effects
from closed_loop_benchmark.page import page
from closed_loop_benchmark.problem import make_problem
from closed_loop_benchmark.scenarios import all_scenarios, subset
from closed_loop_benchmark.scoring import Score, blank, label_in_words, score
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.table import one_line
from support.thinning import thinned

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import ErrorChange, NamedEffect, Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from workers.errors import EffectError
from workers.messages import Effect

CASES = {case.name: case for case in all_scenarios()}
UNSEEN = {("battery", "R0_of_charge"), ("thermal_two_node", "convection")}
"""Parameters that depend on a state, which a co-simulation FMU keeps to itself."""
LOAD = "mass_spring_damper/single/load x0.25"
METHOD = ce.LeastSquares(differences="forward", ftol=1e-8)


@cache
def data_of(name: str) -> Data:
    return make(CASES[name])


@cache
def fitted(name: str, effect: Effect | None = None) -> ce.Result:
    """Fit a case, with one effect whose only coefficient is k."""
    problem = make_problem(data_of(name))
    if effect is not None:
        problem = with_effects(problem, [(effect, {"k": 0.1})])
    return ce.fit(problem, METHOD)


def said(name: str, *effects: Effect) -> LoopResult:
    """Return what a loop would say that names these effects, at most one."""
    before, after = fitted(name), fitted(name, *effects)
    errors = tuple(
        ErrorChange(
            experiment=a.experiment,
            role=a.role,
            output=a.output,
            unit=a.unit,
            samples=a.samples,
            rmse_before=b.rmse_after,
            rmse_after=a.rmse_after,
            normalised_before=b.normalised_after,
            normalised_after=a.normalised_after,
        )
        for b, a in zip(before.errors, after.errors, strict=True)
    )
    named = tuple(NamedEffect(e, "", "", ()) for e in effects)
    verdict = Verdict.FOUND if effects else Verdict.NONE
    return LoopResult(
        verdict, "", named, before, after, errors, (), (), {}, (), (), 100.0, 100, 100, 0, 1.0
    )


def judged(name: str, *effects: Effect, only: Name | None = None) -> Score:
    """Score what is said; `only` leaves a true effect but one name."""
    data = data_of(name)
    if only is not None:
        data = replace(data, scenario=replace(data.scenario, accepted=((only,),)))
    return score(data, said(name, *effects), ask(data, make_problem(data)))


@pytest.mark.parametrize(
    "system", thinned([(name,) for name in SYSTEMS], lambda name: SYSTEMS[name].interface)
)
def test_a_problem_has_the_truth_in_its_bounds_only_and_every_form_is_known(system: str) -> None:
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
        whole = with_effects(problem, [translate(effect, 0)])
        if (system, effect.label) in UNSEEN:
            with pytest.raises(EffectError):
                whole.describe()
        else:
            whole.describe()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "mass_spring_damper/single/sensor_lag x0.25",
        "quarter_car/single/bump_stop x0.25",
        "room/single/sun x0.25",
        "battery/pair/hysteresis+voltage_bias x1.0",
        "cascaded_tanks/single/overflow x0.25",
    ],
)
def test_oracle_reaches_the_noise(name: str) -> None:
    oracle = ask(data_of(name), make_problem(data_of(name)))
    assert oracle.fit is not None
    assert oracle.truth.sse - 60.0 < oracle.fit.sse < oracle.truth.sse + 10.0
    assert oracle.fit.test == pytest.approx(oracle.truth.test, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["outside", "disturbance"])
def test_no_oracle_outside_of_the_library(kind: str) -> None:
    name = next(case.name for case in all_scenarios() if case.kind == kind)
    oracle = ask(data_of(name), make_problem(data_of(name)))
    assert oracle.fit is None
    assert oracle.reason
    assert oracle.best == oracle.truth


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
def test_one_effect_has_one_normal_name(
    ours: tuple[str, str, tuple[str, ...]], theirs: tuple[str, str, tuple[str, ...]]
) -> None:
    assert normal(*ours) == normal(*theirs)


def test_different_effects_have_different_names() -> None:
    names = [("linear", "der(v)", ("x",)), ("linear", "der(v)", ("v",)), ("gap", "pair a,b", ())]
    assert len({normal(*name) for name in names}) == 3


def test_labels_of_candidates_are_written_as_names() -> None:
    labels = ("coulomb at der(v)", "coulomb(w) at der(v)", "gap(x - y) at pair a, b")
    expected = ["coulomb at der(v)", "coulomb(w) at der(v)", "gap(x-y) at pair a,b"]
    assert [label_in_words(label) for label in labels] == expected


def test_comparison_of_names() -> None:
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


def test_a_right_name_scores() -> None:
    found = judged(LOAD, Effect("load", "der(v)", "constant"))
    assert found.exact == found.alias == found.site == [True]
    assert found.numerical
    assert found.detected
    assert found.superfluous == 0
    assert found.likelihood_ratio > 40.0
    assert found.after == pytest.approx(found.oracle, rel=1e-3)
    assert found.parameters_after < found.parameters_before
    assert Score.from_json(found.to_json()) == found


def test_another_name_of_the_same_model_is_found_out_by_its_numbers() -> None:
    bias = Effect("bias", "input F", "bias")
    assert judged(LOAD, bias).alias == [True]
    found = judged(LOAD, bias, only=Name("constant", "der(v)"))
    assert (found.alias, found.site, found.numerical) == ([False], [False], True)
    assert figures.strictly_right(found)
    assert not figures.strictly_right(replace(found, coefficients=2))
    assert not figures.strictly_right(replace(found, distance=0.09, distance_without=0.1))


def test_a_wrong_name_does_not_score() -> None:
    found = judged(LOAD, Effect("wrong", "der(v)", "quadratic"))
    assert (found.alias, found.site, found.numerical) == ([False], [True], False)
    assert found.distance > 0.1


def test_silence_is_a_miss() -> None:
    found = judged(LOAD)
    assert not found.detected
    assert found.alias == [False]
    assert found.after == found.before


def test_page_counts() -> None:
    right = judged(LOAD, Effect("load", "der(v)", "constant"))
    wrong = replace(right, name="again", exact=[False], alias=[False], numerical=False)
    failed = blank(data_of(LOAD), "Traceback:\nValueError: why")
    text = page([right, wrong, replace(failed, name="failed")], {})
    assert "| one effect: detected | >= 98 % | 2/2 (100.0 %) |" in text
    assert "| right: any of these | >= 92 % | 1/2 (50.0 %) |" in text
    assert "| failed | ValueError: why |" in text
    assert all("constant at der(v)" in line for line in (text, one_line(right)))


def test_variants_are_compared_on_what_all_of_them_ran() -> None:
    right = judged(LOAD, Effect("load", "der(v)", "constant"))
    wrong = replace(right, exact=[False], alias=[False], numerical=False, simulations=300.0)
    failed = blank(data_of(LOAD), "why")
    runs = {
        "as it is": {"a": right, "b": right, "c": right},
        "beam 1": {"a": wrong, "b": right, "c": failed},
    }
    text = page([right], runs)
    first, second = (line for line in text.splitlines() if line.startswith(("| as it", "| beam")))
    assert first.startswith("| as it is | 2 | 2/2 (100.0 %) | - |")
    assert second.startswith("| beam 1 | 2 | 1/2 (50.0 %) | - |")
    assert second.endswith("| 0/2 (0.0 %) | 200 | 290 |")


def test_parts_of_the_search_are_switched_off(monkeypatch) -> None:
    def settings(*arguments: str):
        monkeypatch.setattr("sys.argv", ["bench", *arguments])
        return settings_of(parse())

    assert settings() == ce.LoopSettings()
    assert settings("--no-curves").thresholds.refinement.curves == 0
    assert settings("--places", "always").thresholds.places.most_candidates == 0
    assert settings("--places", "never").thresholds.places.most_candidates > 10**6
    assert settings("--beam", "8").beam == 8


def test_page_of_nothing() -> None:
    assert page([], {}).startswith("# ")
    assert one_line(blank(data_of(LOAD), "why")).endswith("why")


def test_bound_of_a_probability() -> None:
    assert figures.upper_bound(0, 136) == pytest.approx(1.0 - 0.05 ** (1 / 136))
    bound = figures.upper_bound(2, 50)
    tail = sum(comb(50, k) * bound**k * (1.0 - bound) ** (50 - k) for k in range(3))
    assert tail == pytest.approx(0.05)
    assert figures.upper_bound(0, 0) == 1.0


def test_medians_leave_out_what_is_unknown() -> None:
    assert figures.median([1.0, nan, 3.0], ".1f") == "2.0"
    assert figures.median([]) == "-"


@pytest.mark.parametrize("processes", [1, 2, 30])
def test_cases_are_divided_by_system(processes: int) -> None:
    cases = all_scenarios()
    portions = divide(cases, processes)
    assert sorted(c.name for p in portions for c in p) == sorted(c.name for c in cases)
    assert all(len({case.system for case in portion}) == 1 for portion in portions)
    assert len(portions) >= min(processes, len(SYSTEMS))
    assert [len(p) for p in portions] == sorted(map(len, portions), reverse=True)


def test_subset_has_effects_and_none() -> None:
    cases = subset()
    assert len(cases) == 8
    assert {case.split for case in cases} == {"tune"}
    assert np.unique([case.kind for case in cases]).tolist() == ["clean", "single"]


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
    ("effect", "wrong", "expected"),
    [
        (Effect("e", "der(v)", "constant"), 0.0, (1, 1)),
        (Effect("e", "der(v)", "constant"), 5.0, (0, 1)),  # standard errors away
        (Effect("e", "input F", "bias"), 0.0, (0, 0)),  # the same model under another name
    ],
)
def test_intervals_of_effects_with_the_right_name_are_compared_with_the_truth(
    effect, wrong, expected
):
    data, found = data_of(LOAD), said(LOAD, effect)
    (estimate,) = [e for e in found.after.estimates if e.label == "e.k"]
    true = data.scenario.effects[0].numbers[0]
    moved = true + wrong * estimate.std_error
    around = replace(
        estimate,
        value=moved,
        lower95=moved - 1.96 * estimate.std_error,
        upper95=moved + 1.96 * estimate.std_error,
    )
    (named,) = found.effects
    found = replace(found, effects=(replace(named, coefficients=(around,)),))
    assert coverage(data, found) == expected
    held = replace(around, lower95=nan, upper95=nan)
    found = replace(found, effects=(replace(named, coefficients=(held,)),))
    assert coverage(data, found) == (0, 0)
