from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_fit,
    made_fitter,
    made_problem,
    made_result,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est import LoopSettings
from cluster_est.closed_loop.account import account
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.effects import ErrorChange, Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict, confirmed, judge
from cluster_est.closed_loop.last_fits import LastAnswer, LastFits
from cluster_est.closed_loop.selection.rounds import (
    ComparedStructure,
    RejectionReason,
    SelectionResult,
)
from cluster_est.closed_loop.workbench import LoopScope
from cluster_est.methods.method import Ending
from cluster_est.problem.display import in_sentences
from cluster_est.statistics.whiteness import SmoothnessTest
from workers.effects.forms import FORMS

PROBLEM = made_problem(100, 100, 100, 100)
FLOOR = 400.0
QUIET, STRUCTURED = SmoothnessTest(0.5, 1.0), SmoothnessTest(1e-9, 6.0)


@dataclass(frozen=True)
class Case:
    """Sums of squares over those of the noise, and what was seen last.

    `left_out` takes the place of `now` in predictions, `worse` is how many of the four experiments
    are predicted worse than without the effects.
    """

    base: float
    now: float
    why: RejectionReason
    structure: SmoothnessTest = QUIET
    families: tuple[str, ...] = ("friction",)
    left_out: float = np.nan
    white: SmoothnessTest | None = None
    worse: int = 0
    p_white: float = 0.3

    def search(self):
        after = self.now if np.isnan(self.left_out) else self.left_out
        squares = np.full(4, after * FLOOR / 4)
        squares[: self.worse] = 1.1 * self.base * FLOOR / 4
        if self.worse:
            squares[self.worse :] -= (squares.sum() - after * FLOOR) / (4 - self.worse)
        added = [made_candidate(f"effect{i}", each) for i, each in enumerate(self.families)]
        base = fit_with_squares(PROBLEM, self.base * FLOOR)
        current = fit_with_squares(PROBLEM, self.now * FLOOR, added)
        screening = made_screening(
            current.jacobian, current.residuals, [], [],
            structure=self.structure, structure_white=self.white, p_white=self.p_white,
        )  # fmt: skip
        return made_selection(base, current, made_round(self.why, screening), squares=squares)


CLEAN, LITTLE = RejectionReason.NOT_SIGNIFICANT, RejectionReason.LITTLE_EXPLAINED
NOISE, NOWHERE = RejectionReason.COLOURED_NOISE, RejectionReason.NO_CANDIDATE
CASES = {
    "nothing is missing": (
        Case(1.0, 1.0, CLEAN, families=()), Verdict.NONE, "no candidate effect"),
    "structure, but no candidate": (
        Case(1.5, 1.5, CLEAN, STRUCTURED, ()), Verdict.UNEXPLAINED, "smooth structure"),
    "autocorrelation, and nothing else": (
        Case(1.5, 1.5, CLEAN, STRUCTURED, (), white=QUIET), Verdict.COLOURED,
        "no candidate effect"),
    "coloured noise, of which a candidate carries a part": (
        Case(1.5, 1.5, LITTLE, STRUCTURED, (), white=QUIET, p_white=1e-9), Verdict.COLOURED,
        "the best candidate was not accepted"),
    "structure below five percent": (
        Case(1.03, 1.03, CLEAN, STRUCTURED, ()), Verdict.NONE, "no candidate effect"),
    "more than the noise, but no structure": (
        Case(1.5, 1.5, CLEAN, families=()), Verdict.NONE, "no candidate effect"),
    "structure that is significant but faint": (
        Case(1.5, 1.5, CLEAN, SmoothnessTest(0.0025, 6.0), ()), Verdict.NONE, "no candidate"),
    "coloured noise": (
        Case(1.5, 1.5, NOISE, STRUCTURED, (), white=QUIET), Verdict.COLOURED,
        "once the autocorrelation of the residual is taken into account"),
    "autocorrelated, but too large for the noise of a sensor": (
        Case(9.0, 9.0, NOISE, STRUCTURED, (), white=QUIET), Verdict.UNEXPLAINED,
        "it is autocorrelated, and once the autocorrelation"),
    "coloured noise that is not even smooth": (
        Case(1.5, 1.5, NOISE, families=()), Verdict.NONE,
        "once the autocorrelation of the residual is taken into account"),
    "a candidate was not accepted": (
        Case(1.01, 1.01, LITTLE, families=()), Verdict.NONE, LITTLE),
    "nothing explains it": (
        Case(4.0, 4.0, LITTLE, STRUCTURED, ()), Verdict.UNEXPLAINED, LITTLE),
    "there was nowhere to look": (
        Case(4.0, 4.0, NOWHERE, STRUCTURED, ()), Verdict.UNEXPLAINED, "no effect could be tried"),
    "there was nowhere to look, and nothing to see": (
        Case(1.0, 1.0, NOWHERE, families=()), Verdict.NONE, "no effect could be tried"),
    "all is explained": (Case(9.0, 1.0, CLEAN), Verdict.FOUND, "the effect removes 100%"),
    "all is explained by two": (
        Case(9.0, 1.0, CLEAN, families=("friction", "friction")), Verdict.FOUND,
        "the effects remove 100%"),
    "nearly all is explained": (
        Case(101.0, 1.5, LITTLE, STRUCTURED), Verdict.FOUND, "the effect removes 99.5%"),
    "just less than nearly all": (
        Case(101.0, 4.0, LITTLE, STRUCTURED), Verdict.PARTIAL, "the effect removes 97%"),
    "most is explained": (
        Case(9.0, 2.8, LITTLE, STRUCTURED), Verdict.PARTIAL, "still has structure"),
    "just more than most": (
        Case(11.0, 3.4, LITTLE, STRUCTURED), Verdict.PARTIAL, "the effect removes 76%"),
    "just less than most": (
        Case(11.0, 3.6, LITTLE, STRUCTURED), Verdict.UNEXPLAINED, "only 74%"),
    "most, but not in prediction": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, left_out=5.0), Verdict.UNEXPLAINED,
        "only 50% of the squared error above the noise in cross-validation, that is, in training "
        "data that were left out of the fit, and 75% in the fit"),
    "all, but what was left out is predicted worse": (
        Case(9.0, 1.0, CLEAN, left_out=13.0), Verdict.UNEXPLAINED,
        "the best effect predicts data that were left out of the fit (cross-validation) worse"),
    "some, but what was left out is predicted worse": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, left_out=13.0), Verdict.UNEXPLAINED,
        "the best effect predicts data that were left out of the fit (cross-validation) worse"),
    "the search ended with as many effects as it may add": (
        Case(9.0, 6.0, RejectionReason.LIMIT_OF_EFFECTS, STRUCTURED), Verdict.UNEXPLAINED,
        "no combination of up to 3 effects in the library explains the remaining error: the best "
        "effect would remove only 38% of the squared error above the noise (more than 75% is "
        "needed); to try more effects, "
        "set closed_loop.max_effects = 4 or more"),
    "a free curve explains it": (
        Case(9.0, 1.0, CLEAN, families=("friction", "table")), Verdict.FOUND, "with a free curve"),
    "a free filter explains it": (
        Case(9.0, 1.0, CLEAN, families=("hidden dynamics",)), Verdict.FOUND,
        "with hidden dynamics that no form in the library describes"),
    "a free filter leaves too much": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, ("hidden dynamics",)), Verdict.UNEXPLAINED, "only 75%"),
    "a free curve explains most": (
        Case(41.0, 4.0, LITTLE, STRUCTURED, ("table",)), Verdict.PARTIAL, "still has structure"),
    "a free curve leaves too much": (
        Case(9.0, 3.0, LITTLE, STRUCTURED, ("table",)), Verdict.UNEXPLAINED, "only 75%"),
    "too little is explained": (
        Case(9.0, 6.0, LITTLE, STRUCTURED), Verdict.UNEXPLAINED, "only 38%"),
    "the rest is coloured": (
        Case(9.0, 1.4, NOISE, STRUCTURED, white=QUIET), Verdict.FOUND,
        "autocorrelated sensor noise"),
    "the rest is too large for noise of any colour": (
        Case(900.0, 27.0, NOISE, STRUCTURED), Verdict.PARTIAL, "still has structure"),
    "the rest is coloured, and one of four is predicted worse": (
        Case(9.0, 2.2, NOISE, STRUCTURED, white=QUIET, worse=1), Verdict.FOUND,
        "autocorrelated sensor noise"),
    "the rest is coloured, but half is predicted worse": (
        Case(9.0, 2.2, NOISE, STRUCTURED, white=QUIET, worse=2), Verdict.PARTIAL,
        "still has structure"),
    "the rest of a free curve is coloured": (
        Case(9.0, 1.4, NOISE, STRUCTURED, ("table",), white=QUIET), Verdict.PARTIAL,
        "still has structure"),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_verdicts(name):
    case, expected, said = CASES[name]
    judgement = judge(made_fitter(PROBLEM), case.search())
    assert judgement.verdict is expected
    assert said.removeprefix("it ") in judgement.reason


@pytest.mark.parametrize(
    ("verdict", "so_far"),
    [
        (Verdict.FOUND, Verdict.PARTIAL),
        (Verdict.PARTIAL, Verdict.PARTIAL),
        (Verdict.UNEXPLAINED, Verdict.UNEXPLAINED),
        (Verdict.COLOURED, Verdict.COLOURED),
    ],
)
def test_a_search_that_still_runs_claims_no_more_than_one_that_ended(verdict, so_far):
    assert ReasonedVerdict(verdict, "").so_far.verdict is so_far


def test_a_verdict_is_written_in_sentences():
    said = confirmed(FOUND, FOLLOWED, LoopSettings()).reason
    assert said.endswith("on held-out data. The effects close 99%")
    assert in_sentences(["", "one", "", "two"]) == "one. Two"
    assert in_sentences([""]) == ""


def test_what_is_closed_is_the_lesser_of_training_and_prediction():
    search = Case(9.0, 2.0, LITTLE, STRUCTURED, left_out=2.6).search()
    judgement = judge(made_fitter(PROBLEM), search)
    assert judgement.closed == pytest.approx(6.4 / 8.0)
    assert "80%" in judgement.reason


def test_a_prediction_near_the_noise_is_measured_by_a_part_of_the_noise():
    """The gap in prediction is 0.01 of the noise, and counts as 0.02 of it."""
    base, current = (fit_with_squares(PROBLEM, f * FLOOR) for f in (9.0, 1.0))
    current = fit_with_squares(PROBLEM, FLOOR, [made_candidate("effect")])
    screening = made_screening(current.jacobian, current.residuals, [], [], structure=STRUCTURED)
    search = made_selection(
        base, current, made_round(LITTLE, screening),
        squares_before=np.full(4, 1.01 * FLOOR / 4), squares=np.full(4, FLOOR / 4),
    )  # fmt: skip
    assert judge(made_fitter(PROBLEM), search).closed == pytest.approx(0.5)


def test_only_a_known_sigma_sets_the_noise_of_a_sensor_apart_from_a_slow_effect():
    search = CASES["coloured noise"][0].search()
    said = "a slow effect of this size cannot be distinguished from autocorrelated noise"
    assert said in judge(made_fitter(PROBLEM), search).reason
    declared = replace(made_fitter(PROBLEM), sigma_declared=True)
    assert said not in judge(declared, search).reason


@pytest.mark.parametrize(("level", "white"), [(0.3, 0.25), (3.0, 2.5)])
def test_where_a_declared_sigma_is_wrong_coloured_noise_is_measured_by_its_white_part(level, white):
    """Both are in units of that sigma: what is left is 1.2 times its own white part."""
    search = Case(level**2, level**2, NOISE, STRUCTURED, (), white=QUIET).search()
    declared = replace(made_fitter(PROBLEM), sigma_declared=True)
    judgement = judge(declared, replace(search, noise=np.array([white])))
    assert judgement.verdict is Verdict.COLOURED
    assert (
        "(1.2 times the white-noise component; unless you declare a sigma that" in judgement.reason
    )


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (
            1.0,
            "the remaining error is smoother than sensor noise, but no larger than the declared "
            "sigma ",
        ),
        (3.0, "the model lacks something (the remaining error is 3 times the declared sigma)"),
    ],
)
def test_noise_that_was_filtered_is_not_said_to_be_something_that_is_missing(size, said):
    """Four records of a slow wave whose root mean square is `size` sigma."""
    search = Case(size**2, size**2, LITTLE, STRUCTURED, ()).search()
    wave = size * np.sqrt(2.0) * np.sin(2.0 * np.pi * np.arange(400) / 50.0)
    fit = replace(search.current, residuals=wave)
    smooth = replace(search, base=fit, current=fit, noise=np.array([0.01]))
    judgement = judge(replace(made_fitter(PROBLEM), sigma_declared=True), smooth)
    assert judgement.verdict is Verdict.UNEXPLAINED
    assert judgement.reason.startswith(said)


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_the_gap_that_is_closed_is_the_same_in_any_unit(unit):
    """Without a declared sigma residuals are in the unit of the output, be it that of amperes."""
    search = Case(11.0, 3.4, LITTLE, STRUCTURED).search()
    base, current = (
        replace(fit, residuals=unit * fit.residuals) for fit in (search.base, search.current)
    )
    before, after = (
        replace(each, squares=unit**2 * each.squares)
        for each in (search.base_prediction, search.prediction)
    )
    scaled = SelectionResult(
        base, current, before, after, {}, search.steps, (), np.array([unit]), LoopSettings()
    )
    judgement = judge(made_fitter(PROBLEM), scaled)
    assert judgement.verdict is Verdict.PARTIAL
    assert "removes 76% of the squared error" in judgement.reason


@pytest.mark.parametrize("narrowed", [{"forms": ("coulomb",)}, {"sites": ("der(v)",)}])
def test_a_narrowed_search_does_not_speak_for_the_whole_library(narrowed):
    search = Case(9.0, 6.0, LITTLE, STRUCTURED).search()
    search = replace(search, settings=LoopSettings(**narrowed))
    reason = judge(made_fitter(PROBLEM), search).reason
    assert (
        "no effect among the forms and sites that closed_loop allows explains the remaining error"
        in reason
    )


def changes(train: tuple[float, float], test: tuple[float, float] | None = None, output="y"):
    """Errors over the noise, before and after."""
    roles = {"train": train} | ({"test": test} if test is not None else {})
    return [change(role, *errors, output=output, name=role) for role, errors in roles.items()]


def change(role: str, before: float, after: float, *, output: str = "y", name: str = "lost"):
    return ErrorChange(name, role, output, "m", 100, before, after, before, after)


NAN = np.nan
FOUND = ReasonedVerdict(Verdict.FOUND, "the effects close 99%", 0.99, 0.75)
FOLLOWED = changes((9.0, 1.1), (9.0, 1.2))
HELD_OUT = {
    "both are followed": (
        FOLLOWED, Verdict.FOUND, "1.10 times the noise on training data and 1.20"),
    "nothing was held out": (
        changes((9.0, 1.1)), Verdict.FOUND, "the remaining error is 1.10 times the noise"),
    "more than noise is left in training": (
        changes((90.0, 1.6), (90.0, 1.2)), Verdict.PARTIAL, "1.60 times the noise on training"),
    "more is left of what was held out": (
        changes((90.0, 1.1), (300.0, 111.0)), Verdict.PARTIAL, "and 111 times on held-out data"),
    "little is closed of what was held out": (
        changes((90.0, 1.1), (300.0, 250.0)), Verdict.UNEXPLAINED,
        "would remove only 31% of the squared error above the noise"),
    "what was held out gets worse": (
        changes((90.0, 1.1), (3.0, 3.1)), Verdict.UNEXPLAINED, "would grow from 3 to 3.1"),
    "there was little to gain where it was held out": (
        changes((9.0, 1.1), (1.1, 1.0)), Verdict.FOUND, "and 1.00 times on held-out data"),
    "the output with the largest error decides": (
        changes((9.0, 1.0), (9.0, 1.0), "a") + changes((9.0, 1.0), (9.0, 1.9), "b"),
        Verdict.PARTIAL, "exceeds the limit of 1.5 times for"),
    "an experiment could not be simulated before": (
        [*FOLLOWED, change("test", NAN, 1.0)], Verdict.FOUND, "1.10 times the noise on training"),
    "an experiment cannot be simulated any more": (
        [*FOLLOWED, change("test", 9.0, NAN)], Verdict.UNEXPLAINED,
        "experiment 'lost' can no longer be simulated"),
    "the only held-out experiment cannot be simulated any more": (
        [*changes((9.0, 1.1)), change("test", 9.0, NAN)], Verdict.UNEXPLAINED, "'lost' can no"),
    "a held-out experiment was never simulated": (
        [*FOLLOWED, change("test", NAN, NAN)], Verdict.PARTIAL,
        "Held-out experiment 'lost' could not be simulated, so it is not known"),
    "a training experiment was never simulated": (
        [*changes((9.0, 1.1)), change("train", NAN, NAN)], Verdict.PARTIAL,
        "Training experiment 'lost' could not be simulated"),
    "how much is too much is said of the size": (
        [*changes((90.0, 1.6), (90.0, 1.2)), change("test", NAN, NAN)], Verdict.PARTIAL,
        "1.20 times on held-out data, which exceeds the limit of 1.5"),
    "the noise is not known": (
        [ErrorChange("train", "train", "y", "m", 100, 9.0, 1.0, NAN, NAN)], Verdict.PARTIAL,
        "the error of y was not compared with the noise"),
    "what is followed exactly needs no noise": (
        [ErrorChange("train", "train", "y", "m", 100, 0.0, 0.0, NAN, NAN),
         *changes((9.0, 1.0), (9.0, 1.0), "b")], Verdict.FOUND, "1.00 times the noise"),
}  # fmt: skip


@pytest.mark.parametrize("name", HELD_OUT)
def test_held_out_data_can_only_take_away(name):
    errors, expected, said = HELD_OUT[name]
    judged = confirmed(FOUND, errors, LoopSettings())
    assert judged.verdict is expected
    assert said in judged.reason


def test_innovations_are_not_compared_by_their_size_alone():
    """Their likelihoods have been, each model under noise of its own."""
    filtered = replace(FOUND, filtered=True)
    judged = confirmed(filtered, changes((1.2, 1.0), (1.037, 1.041)), LoopSettings())
    assert judged.verdict is Verdict.FOUND
    assert "1.04 times on held-out data" in judged.reason
    assert "the spread that noise alone explains" in judged.reason


def test_what_counts_as_near_the_noise_is_a_setting():
    errors = changes((9.0, 1.8), (9.0, 1.9))
    assert confirmed(FOUND, errors, LoopSettings(near_noise=2.0)).verdict is Verdict.FOUND
    assert confirmed(FOUND, errors, LoopSettings()).verdict is Verdict.PARTIAL


@pytest.mark.parametrize(
    ("held_out", "independent", "expected"),
    [
        (1.1, 1.0, Verdict.FOUND),
        (1.4, 1.0, Verdict.PARTIAL),
        (1.4, 0.1, Verdict.FOUND),
    ],
)
def test_what_is_held_out_is_followed_as_well_as_what_was_fitted(held_out, independent, expected):
    """Of 100 samples, or of ten that are independent; both errors are near the noise."""
    judged = replace(FOUND, independent=independent)
    found = confirmed(judged, changes((9.0, 1.0), (9.0, held_out)), LoopSettings())
    assert found.verdict is expected
    assert ("significantly more" in found.reason) is (expected is Verdict.PARTIAL)


def test_a_sigma_that_is_too_large_does_not_make_an_error_small():
    """What is left is 0.4 times the declared sigma, whose noise is a tenth of it."""
    judged = replace(FOUND, declared=True, noise={"y": 0.1})
    small = changes((9.0, 0.4), (9.0, 0.4))
    assert confirmed(replace(judged, noise={}), small, LoopSettings()).verdict is Verdict.FOUND
    found = confirmed(judged, small, LoopSettings())
    assert found.verdict is Verdict.PARTIAL
    assert "the remaining error is 4.00 times the noise" in found.reason


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ((1.2, 1.3), "the remaining error of the worst output, z, is 1.20 times the noise on "
         "training data and 1.30 times on held-out data"),
        ((1.2, 0.5), "the remaining error of the worst output is 1.20 times the noise on training "
         "data (z) and 1.10 times on held-out data (y)"),
    ],
)  # fmt: skip
def test_the_output_with_the_largest_error_is_named(other, said):
    errors = (
        *changes((9.0, 1.0), (9.0, 1.1)),
        *changes((9.0, other[0]), (9.0, other[1]), output="z"),
    )
    assert confirmed(FOUND, errors, LoopSettings()).reason.startswith(said)


def test_errors_over_a_declared_sigma_are_said_to_be_that():
    judged = confirmed(replace(FOUND, declared=True), changes((9.0, 1.1)), LoopSettings())
    assert "1.10 times the declared sigma" in judged.reason


def test_a_verdict_without_effects_stays_as_it_is():
    none = ReasonedVerdict(Verdict.NONE, "no candidate effect")
    assert confirmed(none, changes((9.0, 9.0), (9.0, 9.0)), LoopSettings()) is none


def test_a_gap_on_held_out_data_is_that_to_the_noise_as_it_is():
    """A sigma that is ten times too small makes noise of what was explained completely."""
    judged, errors = replace(FOUND, floor=10.0, declared=True), changes((30.0, 10.0), (15.7, 10.2))
    found = confirmed(judged, errors, LoopSettings())
    assert found.verdict is Verdict.PARTIAL
    assert "10 times the declared sigma on training data and 10.2 times on held-out" in found.reason
    assert confirmed(FOUND, errors, LoopSettings()).verdict is Verdict.UNEXPLAINED


@pytest.mark.parametrize(("excess", "expected"), [(0.5, Verdict.COLOURED), (0.04, Verdict.NONE)])
def test_what_is_left_of_one_output_does_not_drown_in_the_noise_of_many(excess, expected):
    """Of twelve outputs, one has the excess; over all of them it is a twelfth of that."""
    problem = made_problem(100, outputs=12)
    residuals = np.ones(1200)
    residuals[300:400] = np.sqrt(1.0 + excess)
    fit = made_fit(problem, residuals)
    screening = made_screening(
        np.zeros((1200, 1)), residuals, [], [], structure=STRUCTURED, p_white=1e-9
    )
    search = made_selection(fit, fit, made_round(CLEAN, screening), squares=np.full(1, 1200.0))
    judgement = judge(made_fitter(problem), replace(search, noise=np.ones(12)))
    assert judgement.verdict is expected


DONE = made_result(PROBLEM, ())


def accounted(verdict, before=DONE, after=DONE, squares=80.0, errors=(), added=(), first=""):
    """The result of a search that has ended with this verdict, and with these fits."""
    base = fit_with_squares(PROBLEM, 9.0 * squares if added else squares)
    last = made_round(None, made_screening(base.jacobian, base.residuals, [], []))
    now = fit_with_squares(PROBLEM, squares, [made_candidate(name) for name in added])
    answer = LastAnswer(
        replace(
            made_selection(base, now if added else base, last),
            path=(structure("a", 1.0, accepted=True), structure("b", 1.0)),
        ),
        ReasonedVerdict(verdict, "", first=first),
        LastFits(before, after, tuple(errors)),
    )
    return account(made_fitter(PROBLEM), answer, LoopScope(inputs=(("F", "F jumps"),)))


def notes(*given, **known):
    return accounted(*given, **known).notes


def ended(ending: Ending):
    return replace(DONE, solution=replace(DONE.solution, ending=ending))


def test_fits_that_converge_need_no_word():
    assert not any("converge" in note for note in notes(Verdict.NONE, ended(Ending.PERFECT)))


@pytest.mark.parametrize("ending", [Ending.MAX_ITERATIONS, Ending.STALLED, Ending.START_FAILED])
def test_a_last_fit_that_did_not_converge_is_said_to_be_that(ending):
    (note,) = (n for n in notes(Verdict.NONE, ended(ending)) if "converge" in n)
    assert note.startswith("the last fit of the declared model did not converge (")
    assert "method.options" not in note  # nothing that a user of a closed loop can set


@pytest.mark.parametrize("verdict", [Verdict.NONE, Verdict.COLOURED, Verdict.UNEXPLAINED])
@pytest.mark.parametrize("squares", [80.0, 800.0])
def test_intervals_that_do_not_allow_for_what_is_left_are_said_to_be_too_narrow(verdict, squares):
    """Only if more than noise is left: a fit may reach the noise and have another fault."""
    narrow = any("so they are too narrow" in note for note in notes(verdict, squares=squares))
    assert narrow is (verdict is Verdict.UNEXPLAINED and squares > 400.0)


@pytest.fixture
def unsimulated(monkeypatch):
    """Leave out what `account` would simulate."""
    nothing = {"effect_curves": (), "resampled_choices": None, "competing_models": ()}
    for name, found in nothing.items():
        monkeypatch.setattr(
            f"cluster_est.closed_loop.account.{name}", lambda *_, found=found: found
        )


def own_memory():
    """The forms that remember: a delay has a memory, a lag has a state of its own."""
    return [FORMS["output", "delay"], FORMS["output", "lag"]]


@pytest.mark.parametrize(
    ("verdict", "squares", "said"),
    [
        (Verdict.NONE, 400.0, False),
        (Verdict.NONE, 900.0, True),
        (Verdict.UNEXPLAINED, 400.0, True),
        (Verdict.PARTIAL, 400.0, True),
    ],
)
def test_a_jump_of_an_input_is_noted_only_if_something_is_left(verdict, squares, said):
    assert ("F jumps" in notes(verdict, squares=squares)) is said


def test_a_jump_of_an_input_is_noted_if_an_effect_remembers_the_past(monkeypatch, unsimulated):
    def found():
        return notes(Verdict.FOUND, squares=400.0, errors=changes((3.0, 1.0)), added=["a"])

    assert "F jumps" not in found()
    for form in own_memory():
        with monkeypatch.context() as patched:
            late = replace(made_candidate("a"), form=form)
            patched.setattr(f"{__name__}.made_candidate", lambda _, late=late: late)
            assert "F jumps" in found()


def test_leads_alone_are_found_in_part_and_sets_have_no_probabilities(unsimulated):
    """Three effects at one place leave 1.3 times the noise: most such effects are wrong."""
    sure = accounted(Verdict.FOUND, errors=changes((3.0, 1.0)), added=["a"])
    assert (sure.verdict, bool(sure.likely)) == (Verdict.FOUND, True)
    leads = accounted(Verdict.FOUND, errors=changes((3.0, 1.3)), added=["a", "b", "c"])
    assert (leads.verdict, leads.likely) == (Verdict.PARTIAL, ())
    assert not any(effect.claimed for effect in leads.effects)
    assert "none of them is more likely right than wrong. Probability that" in leads.message


def test_what_the_reason_asks_for_first_stays():
    assert accounted(Verdict.UNEXPLAINED, first="correct the records").first == (
        "correct the records"
    )


def structure(name: str, times: float, *, accepted: bool = False) -> ComparedStructure:
    return ComparedStructure(1, (f"{name} at der(v)",), -10.0, 0.5, True, accepted, times)


def test_nothing_is_said_where_what_was_added_is_cheap():
    others = [structure("b", 31.4), structure("c", np.nan)]
    assert expensive_structures([structure("a", 5.0, accepted=True), *others]) == ()


def test_added_effects_that_are_expensive_are_named():
    others = [structure("b", 31.4), structure("c", 7.0)]
    (said,) = expensive_structures([structure("a", 9.0, accepted=True), *others])
    assert said.startswith("with a at der(v), a simulation takes 9 times as many solver steps")


@pytest.mark.parametrize(("held_out", "verdict"), [(1.1, Verdict.NONE), (2.2, Verdict.UNEXPLAINED)])
def test_nothing_is_missing_only_if_the_held_out_data_agree(held_out, verdict):
    nothing = ReasonedVerdict(Verdict.NONE, "no candidate effect improves the fit significantly")
    judged = confirmed(nothing, changes((1.0, 1.0), (held_out, held_out)), LoopSettings())
    assert judged.verdict is verdict
    said = f"1.00 times the noise on training data and {held_out:.2f} times on held-out data"
    if verdict is Verdict.UNEXPLAINED:
        assert said in judged.reason
        assert "In the training experiments, no candidate effect" in judged.reason


def test_few_held_out_samples_may_be_far_off_by_chance():
    nothing = ReasonedVerdict(Verdict.NONE, "no candidate effect improves the fit significantly")
    errors = [replace(each, samples=3) for each in changes((1.0, 1.0), (2.2, 2.2))]
    assert confirmed(nothing, errors, LoopSettings()).verdict is Verdict.NONE
