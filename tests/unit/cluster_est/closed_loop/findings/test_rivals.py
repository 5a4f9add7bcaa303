"""Rivals of an effect, compared in the final model: outputs that are sums of known terms."""

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import (
    made_candidate,
    made_fitter,
    made_problem,
    made_result,
    made_round,
    made_screening,
    made_selection,
)
from support.problems.answering import AnsweringExecutor, answer_with

from cluster_est import Effect
from cluster_est.closed_loop.findings.alternatives import (
    LARGEST_DIFFERENCE,
    may_agree,
    refit_rivals,
    same_law_sentence,
)
from cluster_est.closed_loop.findings.claim_evidence import elsewhere
from cluster_est.closed_loop.findings.competing_models import (
    leading_models,
    with_probabilities,
    written_otherwise,
)
from cluster_est.closed_loop.findings.description import describe_effects
from cluster_est.closed_loop.findings.effects import AlternativeEffect
from cluster_est.closed_loop.fitter import FitStart, Fitter
from cluster_est.closed_loop.selection.refits import FIRST, best_first, full_refit
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.running.runner import Runner
from workers.effects.forms import FORMS
from workers.effects.site import parse_site

SAMPLES, NOISE = 200, 0.1
TIMES = np.linspace(0.0, 1.0, SAMPLES)
TERMS = {
    "power": lambda k, n, ref: k * TIMES**n,
    "square": lambda k: k * TIMES**2,
    "ripple": lambda k: k * np.sin(20.0 * TIMES),
    "bump": lambda k: k * (np.exp(TIMES) - 1.0),
}
"""What each effect adds to the output, by its name."""


class SumOfTerms(AnsweringExecutor):
    """The output is k * t plus the terms of all effects; some sets of effects fail."""

    def __init__(self, measured, fails=()):
        super().__init__()
        self.measured, self.fails = measured, fails

    def _answer(self, task):
        values = list(task.values)
        output = values.pop(0) * TIMES
        for effect in task.effects:
            count = len(FORMS["derivative", effect.form].coefficients)
            output = output + TERMS[effect.name](*values[:count])
            del values[:count]
        failed = {effect.name for effect in task.effects} in self.fails
        residuals = np.full(SAMPLES, np.nan) if failed else (output - self.measured) / NOISE
        return answer_with(task, residuals, [SAMPLES])


def effect_at_v(name, form, *variables):
    made = FORMS["derivative", form]
    count = len(made.coefficients)
    return replace(
        made_candidate(name), effect=Effect(name, "der(v)", form, variables or ("v",)), form=made,
        grid=((1.0,) * count,), lowest=(0.01,) * count, highest=(99.0,) * count,
    )  # fmt: skip


POWER, SQUARE = effect_at_v("power", "power"), effect_at_v("square", "square")
RIPPLE, BUMP = effect_at_v("ripple", "linear"), effect_at_v("bump", "linear")


def searched(measured, rivals, *, fails=(), both=True):
    """A search that found `power`, not `rivals`, and then `ripple` if `both`."""
    noise = NOISE * np.random.default_rng(3).standard_normal(SAMPLES)
    problem = made_problem(SAMPLES, sigma=NOISE)
    fitter = replace(made_fitter(problem), runner=Runner(SumOfTerms(measured + noise, fails)))
    begun = FitStart(problem, {"k": 1.0})
    own = begun.plus(POWER, [1.0, 1.5, 1.0])
    starts = [begun, own, own.plus(RIPPLE, [0.5]), *(begun.plus(each, [1.0]) for each in rivals)]
    fits = fitter.fit(LoopStage.REFITS, starts, full_refit(fitter))
    base, first, second, *others = fits
    current = second if both else first
    last = made_round(None, made_screening(np.zeros((SAMPLES, 1)), base.residuals, [], []))
    known = [best_first(fitter.records, [fit])[0] for fit in (first, *others)]
    found = made_selection(base, current, last)
    rivals = {"power": (known[0], known[1:])}
    return fitter, replace(found, rivals=rivals)


def described(fitter, found):
    """The effect `power`, as it is described."""
    return describe_effects(fitter, found, made_result(fitter.problem, []))[0]


QUADRATIC = 2.0 * TIMES + 3.0 * TIMES**2 + 0.5 * np.sin(20.0 * TIMES)


def test_a_rival_is_compared_in_the_final_model():
    """Without the ripple, the exponent imitates a part of it, so that the laws differ."""
    fitter, found = searched(QUADRATIC, [SQUARE])
    (then,) = found.rivals["power"][1]
    before = then.fitted.residuals - found.rivals["power"][0].fitted.residuals
    assert 0.3 < np.abs(before).max() < LARGEST_DIFFERENCE
    again = refit_rivals(fitter, found)
    (alternative,) = described(fitter, again).alternatives
    (rival,) = again.rivals["power"][1]
    assert rival.fitted.structure == {"square", "ripple"}
    gap = np.abs(rival.fitted.residuals - found.current.residuals).max()
    assert alternative.difference == pytest.approx(gap)
    criteria = [fit.criterion(fitter.records) for fit in (rival.fitted, found.current)]
    assert alternative.criterion == pytest.approx(criteria[0] - criteria[1])
    assert alternative.criterion == pytest.approx(-np.log(SAMPLES), abs=2.0)
    assert alternative.unknowns == -1
    estimates = rival.fitted.estimates
    assert estimates["square.k"] == pytest.approx(3.0, rel=0.1)
    assert estimates["ripple.k"] == pytest.approx(0.5, rel=0.1)


def test_a_rival_that_was_not_compared_there_has_no_numbers():
    fitter, found = searched(QUADRATIC, [SQUARE])
    effect = described(fitter, found)
    (alternative,) = effect.alternatives
    assert (alternative.words, alternative.site) == ("a term quadratic in v", "der(v)")
    assert np.isnan([alternative.criterion, alternative.difference]).all()
    assert (alternative.experiment, alternative.parameters) == ("", "")
    assert elsewhere(replace(effect, effect=replace(effect.effect, site="der(x)"))) == [alternative]


def test_nothing_is_simulated_for_rivals_that_were_compared_in_the_final_model():
    fitter, found = searched(QUADRATIC, [SQUARE], both=False)
    before = fitter.runner.simulations
    again = refit_rivals(fitter, found)
    assert fitter.runner.simulations == before
    assert again == found
    (alternative,) = described(fitter, again).alternatives
    assert alternative.difference > 0.0


@pytest.mark.parametrize("promising", [True, False])
def test_a_refit_that_stopped_early_is_continued_if_it_may_become_a_rival(promising):
    """Its linear model reaches the found one, or does not, as its directions are useless."""
    fitter, found = searched(QUADRATIC, [SQUARE], both=False)
    won, (rival,) = found.rivals["power"]
    begun = FitStart(fitter.problem, {"k": 5.0}).plus(SQUARE, [9.0])
    (early,) = fitter.fit(LoopStage.REFITS, [begun], replace(FIRST, max_iterations=0))
    early = early if promising else replace(early, jacobian=0.0 * early.jacobian)
    assert early.criterion(fitter.records) > won.criterion + 900.0
    stopped = best_first(fitter.records, [early], full=False)
    step = replace(found.steps[0], contenders=(won, *stopped))
    found = replace(found, steps=(step,), rivals={"power": (won, [])})
    before = fitter.runner.simulations
    again = refit_rivals(fitter, found)
    assert (fitter.runner.simulations > before) is promising
    made = again.rivals["power"][1]
    assert len(made) == promising
    for each in made:
        assert each.criterion == pytest.approx(rival.criterion, abs=0.1)
        assert each.full


def test_a_rival_that_fails_with_the_later_effects_is_dropped():
    fitter, found = searched(QUADRATIC, [SQUARE], fails=[{"square", "ripple"}])
    again = refit_rivals(fitter, found)
    assert again.rivals["power"][1] == []
    assert described(fitter, again).alternatives == ()


def test_the_declared_parameters_start_where_the_rival_moved_them(monkeypatch):
    fitter, found = searched(QUADRATIC, [SQUARE])
    won, (rival,) = found.rivals["power"]
    begun = []
    monkeypatch.setattr(
        Fitter, "fit", lambda *given: begun.extend(given[2]) or [None for _ in given[2]]
    )
    refit_rivals(fitter, found)
    (start,) = begun
    parts = (found.current, rival.fitted, won.fitted)
    now, moved, before = (fit.estimates["k"] for fit in parts)
    assert now != before != moved
    assert start.values["k"] == pytest.approx(now + moved - before)
    assert start.values["ripple.k"] == found.current.estimates["ripple.k"]
    starts = {parameter.name: parameter.start for parameter in start.problem.parameters}
    assert starts["square.k"] == rival.fitted.estimates["square.k"]


def test_a_rival_that_is_better_with_the_later_effects_is_said_to_be():
    """No power of t is the exponential function; a ripple hides this at first."""
    measured = 6.0 * (np.exp(TIMES) - 1.0) + 0.7 * np.sin(20.0 * TIMES) + 2.0 * TIMES
    fitter, found = searched(measured, [BUMP])
    found = refit_rivals(fitter, found)
    (alternative,) = described(fitter, found).alternatives
    assert alternative.criterion < -2.0
    assert alternative.better
    assert [each.effects for each in found.path] == [
        (found.rivals["power"][1][0].fitted.added[0].label, BUMP.label)
    ]
    assert not found.path[0].accepted


def test_a_law_written_in_another_way_is_one_law():
    fitter, found = searched(QUADRATIC, [SQUARE])
    found = refit_rivals(fitter, found)
    (rival,) = found.rivals["power"][1]
    same = replace(rival.fitted, residuals=found.current.residuals + 0.02)
    rivals = {"power": (found.rivals["power"][0], [replace(rival, fitted=same)])}
    found = replace(found, rivals=rivals)
    effect = described(fitter, found)
    (alternative,) = effect.alternatives
    assert alternative.same_law
    said = "On these data, the same law can also be written as a term quadratic in v at der(v)"
    assert f"{said} (der(v) += k * v^2; 1 unknown less)." in effect.sentence
    assert [fit.structure for fit in leading_models(fitter, found, 9)] == [
        {"power", "ripple"}, set(),
    ]  # fmt: skip
    sets = written_otherwise(fitter, found)
    assert sets == {frozenset(c.label for c in same.added)}


def test_one_law_counts_once_in_the_probabilities():
    fitter, found = searched(QUADRATIC, [SQUARE])
    rows = refit_rivals(fitter, found).path
    own = replace(rows[0], effects=("power at der(v)",), accepted=True)
    other = replace(rows[0], effects=("square at der(v)",))
    first, second, _ = with_probabilities([own, other], 0.0)
    assert (first.probability, second.probability) == pytest.approx((0.5, 0.5))
    first, second, _ = with_probabilities([own, other], 0.0, {frozenset(other.effects)})
    assert first.probability == pytest.approx(1.0)
    assert np.isnan(second.probability)


def at(site, form, *variables):
    place = parse_site(site, "")
    made = FORMS[place.kind, form]
    return replace(
        made_candidate("e"), effect=Effect("e", site, form, variables), form=made, site=place
    )


@pytest.mark.parametrize(
    ("one", "other", "agree"),
    [
        (at("parameter R", "linear", "q"), at("der(q)", "quadratic"), True),  # its own state
        (at("input F", "saturation"), at("der(v)", "hinge", "F"), True),
        (at("der(v)", "linear", "x"), at("der(v)", "linear", "v"), False),
        (at("der(T)", "linear", "a"), at("der(T)", "linear", "b"), False),
        (at("output y", "lag"), at("output y", "mode"), False),  # faster signals differ
        (at("output y", "delay"), at("output y", "gain"), False),
    ],
)
def test_only_functions_of_the_same_arguments_are_one_law(one, other, agree):
    assert may_agree(one, other) is agree
    assert may_agree(other, one) is agree


def way(site, words, **more):
    return AlternativeEffect(
        site, "linear", "", (), "", **{"criterion": 0.0, "same_law": True, "words": words} | more
    )


def test_terms_of_a_balance_are_named_first():
    ways = [
        way("parameter R", "a variation linear in q", parameters="p = 2 instead of 3 Pa"),
        way("der(q)", "quadratic drag", criterion=3.0),
        way("der(q)", "a curve", same_law=False),
    ]
    said = same_law_sentence(ways)
    assert said == (
        "On these data, the same law can also be written as quadratic drag at der(q) or as a "
        "variation linear in q at parameter R (with p = 2 instead of 3 Pa)."
    )
    assert same_law_sentence(ways[2:]) == ""
    many = [way("der(q)", f"law {number}") for number in range(5)]
    assert same_law_sentence(many).endswith("or as law 2 at der(q) or in 2 other ways.")
