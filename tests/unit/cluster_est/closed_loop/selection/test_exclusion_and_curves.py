"""Earlier effects that are left out of what was refused, and curves that do not do everything."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from support.loop_objects import (
    fit_with_squares,
    made_candidate,
    made_fit,
    made_fitter,
    made_problem,
    made_refit,
    made_screening,
    made_start,
)

from cluster_est import LoopSettings
from cluster_est.closed_loop.fitter import FitStart, FittedModel
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.selection import argument_functions, gates
from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import reason_to_stop
from cluster_est.closed_loop.selection.moves import MOVES, exclude
from cluster_est.closed_loop.selection.rounds import (
    AcceptedStructure,
    RejectionReason,
    RoundEnd,
    SelectionRound,
)
from cluster_est.closed_loop.settings import LoopPart
from cluster_est.problem.search_space import make_space
from workers.effects.site import EffectSite

PROBLEM = made_problem(100)
WRONG, RIGHT = made_candidate("wrong"), made_candidate("right")
NOTHING, ONE, BOTH = 10_000.0, 6_000.0, 200.0
"""Squares of the declared model, with the wrong effect alone, and with both."""


class KnownFits:
    """A fitter that knows the squares of each structure, and which ones were asked for."""

    def __init__(self, squares):
        self.squares, self.asked = squares, []
        self.records = made_fitter(PROBLEM).records
        self.size = 100

    def fit(self, stage, starts, method):
        del stage, method
        names = [tuple(c.effect.name for c in start.added) for start in starts]
        self.asked += names
        return [
            fit_with_squares(PROBLEM, self.squares[own], start.added)
            for own, start in zip(names, starts, strict=True)
        ]


def begun_at(model, p=0.001):
    base = fit_with_squares(PROBLEM, NOTHING)
    column = [np.ones((100, 1))]
    screening = made_screening(base.jacobian, base.residuals, column, [RIGHT], p=p, p_white=p)
    begun = made_start(base, screening, predicted=NOTHING, floor=100.0)
    return replace(begun, model=model)


def refused(begun, fitter, squares, part=LoopPart.LEAST_GAIN):
    """The end of a round whose best proposal, both effects, did not pass a gate."""
    fitted = fit_with_squares(PROBLEM, squares, (WRONG, RIGHT))
    contender = made_refit(fitted, fitted.criterion(fitter.records))
    seen = SelectionRound(begun.screening, (contender,), RejectionReason.LITTLE_EXPLAINED)
    return RoundEnd(seen, compared=(contender,), stopped={fitted.structure: part})


def test_what_a_gate_refused_is_proposed_without_the_effect_that_was_there_before():
    fitter = KnownFits({("right",): 150.0})
    begun = begun_at(fit_with_squares(PROBLEM, ONE, (WRONG,)))
    (proposal,) = exclude(fitter, begun, refused(begun, fitter, BOTH))
    assert proposal.fitted.structure == {"right"}
    assert proposal.full


def slow_and_sharp(generator):
    """Slow noise of the sensor with a slow drift in it, and a wave that no slow noise follows."""
    noise = lfilter([1.0], [1.0, -0.97], generator.standard_normal(400))
    drift = np.vander(np.linspace(-1.0, 1.0, 400), 2)
    left = noise - drift @ np.linalg.lstsq(drift, noise, rcond=None)[0]
    return noise, left, 2.0 * np.std(left) * (-1.0) ** (np.arange(400) // 7)


@pytest.mark.parametrize("kept", [(), (made_candidate("kept"),)])
@pytest.mark.parametrize("follows_noise", [True, False])
def test_a_set_without_an_accepted_effect_passes_the_gates_of_what_it_extends(
    monkeypatch, kept, follows_noise
):
    """The accepted effect is worse than the declared model in the coloured measure, not in itself.

    The proposal takes a drift out of the noise, which slow noise does too, or removes a sharp wave.
    """
    problem = made_problem(400)
    noise, left, sharp = slow_and_sharp(np.random.default_rng(5))
    extended = made_fit(problem, noise if follows_noise else noise + sharp, kept)
    accepted = made_fit(problem, left + 0.15 * sharp, (WRONG, *kept))
    proposed = made_fit(problem, left, (*kept, RIGHT))
    assert proposed.sse < accepted.sse < extended.sse
    fitter = KnownFits({})
    fitter.records, fitter.size = made_fitter(problem).records, 400
    asked = []
    fitter.fit = lambda stage, starts, method: asked.extend(starts) or [extended]
    monkeypatch.setattr(gates, "may_go_on", lambda *_: True)
    monkeypatch.setattr(
        gates, "predict", lambda _, fitted: LeaveOneOutPrediction(np.array([fitted.sse]))
    )
    base = extended if not kept else made_fit(problem, 2.0 * noise + sharp)
    columns = list(np.random.default_rng(6).standard_normal((50, 400, 1)))
    others = [made_candidate(f"other {number}") for number in range(50)]
    screening = made_screening(base.jacobian, base.residuals, columns, others)
    begun = made_start(base, screening, predicted=base.sse, floor=0.9 * proposed.sse)
    begun = replace(begun, model=accepted, prediction=gates.predict(fitter, accepted))
    contender = made_refit(proposed, proposed.criterion(fitter.records))
    end = gates.choose(fitter, begun, [contender])
    assert (end.won is None) is follows_noise
    assert end.seen.why is (RejectionReason.COLOURED_GAIN if follows_noise else None)
    assert set(end.stopped.values()) == ({LoopPart.COLOURED_GAIN} if follows_noise else set())
    assert [start.added for start in asked] == ([kept] if kept else [])


def test_what_explains_too_little_without_it_is_not_proposed():
    fitter = KnownFits({("right",): 9_000.0})
    begun = begun_at(fit_with_squares(PROBLEM, ONE, (WRONG,)))
    assert exclude(fitter, begun, refused(begun, fitter, BOTH)) == []


@pytest.mark.parametrize(
    ("squares", "part"), [(5_000.0, LoopPart.LEAST_GAIN), (BOTH, LoopPart.WAVES)]
)
def test_nothing_is_simulated_for_what_could_be_no_claim_or_is_a_wave(squares, part):
    fitter = KnownFits({})
    begun = begun_at(fit_with_squares(PROBLEM, ONE, (WRONG,)))
    assert exclude(fitter, begun, refused(begun, fitter, squares, part)) == []
    assert fitter.asked == []


@pytest.mark.parametrize(
    ("declared", "squares", "p_white", "reason"),
    [
        (True, 110.0, 0.5, RejectionReason.COLOURED_NOISE),
        (True, 110.0, 0.001, None),
        (True, 120.0, 0.5, None),
        (False, 110.0, 0.5, None),
    ],
    ids=[
        "coloured noise of the sigma",
        "not coloured noise",
        "larger than the sigma",
        "unknown sigma",
    ],
)
def test_only_coloured_noise_of_a_declared_sigma_ends_a_search(declared, squares, p_white, reason):
    begun = begun_at(fit_with_squares(PROBLEM, squares))
    screening = replace(begun.screening, p_white=p_white)
    begun = replace(begun, screening=screening, sigma_declared=declared)
    assert reason_to_stop(begun) is reason


@pytest.mark.parametrize(
    ("squares", "reason"), [(4_000.0, None), (1_000.0, RejectionReason.FREE_CURVE)]
)
def test_something_may_be_added_to_a_curve_that_leaves_more_than_its_own_error(squares, reason):
    """It closes 61 % of the gap, or 91 %."""
    curve = made_candidate("curve", "table")
    begun = begun_at(fit_with_squares(PROBLEM, squares, (curve,)))
    assert reason_to_stop(begun) is reason


@pytest.mark.parametrize(
    ("squares", "without", "tried"),
    [
        (4_000.0, (), True),
        (110.0, (), False),
        (4_000.0, (LoopPart.FREE_CURVE, LoopPart.FREE_DYNAMICS), False),
    ],
)
def test_a_curve_takes_the_place_of_all_only_where_they_leave_more_than_noise(
    monkeypatch, squares, without, tried
):
    """They close 61 % of the gap, or leave noise; finer curves follow all coarse ones."""
    made = {
        name: made_refit(fit_with_squares(PROBLEM, NOTHING, (made_candidate(name, "table"),)), 1e9)
        for name in ("curve", "finer", "switched")
    }
    refined = []
    monkeypatch.setattr(argument_functions, "coarse_curves", lambda *_: [made["curve"]])
    monkeypatch.setattr(argument_functions, "switched_curves", lambda *_: [made["switched"]])
    monkeypatch.setattr(argument_functions, "refit_named", lambda *_: [])
    monkeypatch.setattr(argument_functions, "with_filters", lambda _, begun: begun)
    monkeypatch.setattr(argument_functions, "refit_filters", lambda *_: [])
    monkeypatch.setattr(
        argument_functions,
        "finer_curves",
        lambda *given: refined.extend(given[2]) or [made["finer"]],
    )
    begun = begun_at(fit_with_squares(PROBLEM, NOTHING))
    begun = replace(begun, settings=LoopSettings(without=without))
    found = fit_with_squares(PROBLEM, squares, (WRONG, RIGHT))
    now = AcceptedStructure(found, begun.prediction)
    assert argument_functions.curve_instead(KnownFits({}), begun, now) is None  # it fits worse
    names = [curve.candidate.effect.name for curve in refined]
    assert names == (["curve", "switched"] if tried else [])


@pytest.mark.parametrize(
    ("without", "chosen", "refused"),
    [((), "right", {"wrong"}), ((LoopPart.NEXT_BEST,), None, {"wrong"})],
)
def test_where_the_best_predicts_badly_the_next_best_is_asked(
    monkeypatch, without, chosen, refused
):
    """A flexible law follows what it was fitted to better than the right one does."""
    predicted = {"wrong": 2.0 * NOTHING, "right": BOTH}
    monkeypatch.setattr(gates, "FILTERS", ())
    monkeypatch.setattr(gates, "may_go_on", lambda *_: True)
    monkeypatch.setattr(gates, "coloured_noise_explains", lambda *_: False)
    monkeypatch.setattr(
        gates,
        "predict",
        lambda _, fitted: LeaveOneOutPrediction(np.array([predicted[fitted.added[0].effect.name]])),
    )
    begun = begun_at(fit_with_squares(PROBLEM, NOTHING))
    begun = replace(begun, settings=LoopSettings(without=without))
    fitter = KnownFits({})
    contenders = []
    for candidate, squares in ((WRONG, 0.9 * BOTH), (RIGHT, BOTH)):
        fitted = fit_with_squares(PROBLEM, squares, (candidate,))
        contenders.append(made_refit(fitted, fitted.criterion(fitter.records)))
    end = gates.choose(fitter, begun, contenders)
    assert (end.won and end.won.candidate.effect.name) == chosen
    assert set().union(*end.stopped) == refused
    assert (end.seen.why is None) == (chosen is not None)


@pytest.mark.parametrize(
    ("explained", "family", "coloured"),
    [
        (("wrong", "right"), "friction", True),
        (("wrong",), "friction", False),
        ((), "friction", False),
        (("wrong",), "load", True),
    ],
)
def test_coloured_noise_is_said_to_do_it_only_if_it_does_as_much_as_every_refused_mechanism(
    monkeypatch, explained, family, coloured
):
    """The best says nothing of the others; a drift in time follows whatever disturbs."""
    monkeypatch.setattr(gates, "FILTERS", ())
    monkeypatch.setattr(gates, "may_go_on", lambda *_: True)
    monkeypatch.setattr(
        gates,
        "coloured_noise_explains",
        lambda _, begun, contender: contender.candidate.effect.name in explained,
    )
    worse = LeaveOneOutPrediction(np.array([2.0 * NOTHING]))
    monkeypatch.setattr(gates, "predict", lambda *_: worse)
    fitter = KnownFits({})
    contenders = []
    for candidate, squares in ((WRONG, ONE), (made_candidate("right", family), 1.1 * ONE)):
        fitted = fit_with_squares(PROBLEM, squares, (candidate,))
        contenders.append(made_refit(fitted, fitted.criterion(fitter.records)))
    end = gates.choose(fitter, begun_at(fit_with_squares(PROBLEM, NOTHING)), contenders)
    assert end.won is None
    assert end.seen.coloured is coloured


@pytest.mark.parametrize(("of_pair", "wins"), [(0.5, "pair"), (1.5, "single")])
def test_two_effects_take_the_place_of_one_only_if_they_predict_better(of_pair, wins):
    """The more effects, the better the fit: the pair has the better criterion in any case."""
    begun = begun_at(fit_with_squares(PROBLEM, NOTHING))
    parts = np.array([3.0, 2.0, 4.0])

    def ended(name, squares, predicted):
        fitted = fit_with_squares(PROBLEM, squares, (made_candidate(name),))
        won = made_refit(fitted, fitted.criterion(KnownFits({}).records))
        seen = SelectionRound(begun.screening, (), None)
        return RoundEnd(seen, won, LeaveOneOutPrediction(predicted))

    (add_two,) = (move for move in MOVES if move.part is LoopPart.ADD_TWO)
    one, two = ended("single", ONE, parts), ended("pair", BOTH, of_pair * parts)
    assert add_two.preferred(begun, one, two).won.candidate.effect.name == wins


@pytest.mark.parametrize("first", [72.1, 7e4])
def test_no_quarter_of_a_record_decides_alone(first):
    """The first is extrapolated, and has 95 % of the squares or more; the others are far better."""
    before = LeaveOneOutPrediction(np.array([61.9, 4.9, 3.4, 4.3]) ** 2, quarters=True)
    after = LeaveOneOutPrediction(np.array([first, 1.2, 1.1, 1.4]) ** 2, quarters=True)
    assert after.total > before.total
    assert after.is_better_than(before)
    assert not before.is_better_than(after)
    records = [replace(each, quarters=False) for each in (before, after)]
    assert not records[1].is_better_than(records[0])


@pytest.mark.parametrize("quarters", [True, False])
def test_the_share_that_is_closed_has_no_unit(quarters):
    random = np.random.default_rng(3)
    for unit in (1e-9, 1.0, 1e9):
        before, after = (
            LeaveOneOutPrediction(unit * random.uniform(1.0, 2.0, 4), quarters) for _ in range(2)
        )
        share = after.closes(before, 0.4 * unit)
        scaled = [replace(each, squares=each.squares / unit) for each in (before, after)]
        assert share == pytest.approx(scaled[1].closes(scaled[0], 0.4))
        assert before.closes(before) == 0.0
        nothing = replace(before, squares=np.full(4, 0.1 * unit))
        assert nothing.closes(before, 0.4 * unit) == pytest.approx(1.0)


def stopped_at(squares, *effects, most=3, without=()):
    """Why a search stops at a structure that leaves these squares of 10,000, 100 of them noise."""
    begun = begun_at(fit_with_squares(PROBLEM, squares, effects))
    settings = LoopSettings(max_effects=most, without=without)
    return reason_to_stop(replace(begun, settings=settings))


@pytest.mark.parametrize(
    ("squares", "effects", "most", "stops"),
    [
        (7_600.0, (WRONG,), 3, True),  # a quarter of 9,900 is 2,475
        (7_500.0, (WRONG,), 3, False),
        (7_600.0, (WRONG,), 4, False),
        (5_100.0, (WRONG, RIGHT), 3, True),
        (5_000.0, (WRONG, RIGHT), 3, False),
        (NOTHING, (), 3, False),
    ],
)
def test_a_search_ends_if_its_best_effects_explain_less_than_their_share(
    squares, effects, most, stops
):
    out = RejectionReason.OUT_OF_REACH
    assert stopped_at(squares, *effects, most=most) is (out if stops else None)
    assert stopped_at(squares, *effects, most=most, without=(LoopPart.OUT_OF_REACH,)) is None


def test_a_sibling_starts_where_the_linear_model_expects_all_unknowns(monkeypatch):
    """The data are those of k = 1.5 and a sibling of 0.9; the best effect imitates it."""
    generator = np.random.default_rng(4)
    slope, right = generator.standard_normal((2, 100))
    wrong = right + 0.2 * slope + 0.1 * generator.standard_normal(100)
    width, k, strength = 0.5, 1.0, 0.8
    start = FitStart(PROBLEM, {}).plus(WRONG, (strength, width))
    space = make_space(start.problem, PROBLEM.indices("train"), starts=start.values)
    x = np.array([{"k": k, "wrong.k": strength}.get(u.label, width) for u in space.unknowns])
    residuals = slope * (k - 1.5) + wrong * strength - right * 0.9
    columns = {"k": slope, "wrong.k": wrong}
    jacobian = np.column_stack([columns.get(u.label, np.zeros(100)) for u in space.unknowns])
    best = made_refit(FittedModel(space, x, residuals, jacobian, (WRONG,)), 0.0)
    trial = CandidatePoint(RIGHT, (1.0, width))
    known = [wrong[:, None], right[:, None]]
    monkeypatch.setattr(argument_functions, "candidate_columns", lambda *_: known)
    monkeypatch.setattr(argument_functions, "_before", lambda *_: [])
    (found,) = argument_functions.starts_in_its_place(
        made_fitter(PROBLEM), fit_with_squares(PROBLEM, NOTHING), best, [trial], 1
    )
    assert found.values["k"] == pytest.approx(1.5)
    starts = {parameter.name: parameter.start for parameter in found.problem.parameters}
    assert starts["right.k"] == pytest.approx(0.9)


def with_variables(name, *variables):
    candidate = made_candidate(name)
    return replace(candidate, effect=replace(candidate.effect, variables=variables))


def test_the_same_form_with_another_argument_is_a_sibling():
    best = made_refit(fit_with_squares(PROBLEM, ONE, (with_variables("best", "v"),)), 0.0)
    other = with_variables("other", "w")
    elsewhere = replace(other, site=EffectSite("derivative", "w"))
    assert argument_functions._is_rival(other, best, ())
    assert not argument_functions._is_rival(elsewhere, best, ())
    assert not argument_functions._is_rival(other, best, ("other",))
