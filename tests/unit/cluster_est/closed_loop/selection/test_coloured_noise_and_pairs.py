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
    made_ranking,
    made_refit,
    made_screening,
    made_start,
)

from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.argument_functions import coloured_criterion
from cluster_est.closed_loop.selection.gates import Attempt, coloured_noise_explains, first_refusal
from cluster_est.closed_loop.selection.refits import PAIRS_REFITTED as FITTED
from cluster_est.closed_loop.selection.refits import best_pairs
from cluster_est.closed_loop.selection.rounds import RejectionReason


def slow_noise(count: int, seed: int) -> np.ndarray:
    """White noise of a sensor, and a process's of half its size that lasts 60 samples."""
    generator = np.random.default_rng(seed)
    slow = np.zeros(count)
    for t in range(1, count):
        slow[t] = (1.0 - 1.0 / 60.0) * slow[t - 1] + generator.normal()
    return generator.normal(size=count) + 0.5 * slow / slow.std()


def waves(count):
    return [np.sin(np.linspace(0.0, turns, count)) for turns in np.linspace(3.0, 60.0, 150)]


def best_wave(noise):
    return max(waves(len(noise)), key=lambda wave: abs(wave @ noise) / np.sqrt(wave @ wave))


def begun_and_grown(noise, shape, size):
    """Before and after this one of 150 effects, with such noise beside what it has made."""
    problem = made_problem(len(noise))
    fitter = made_fitter(problem)
    before = noise + size * shape
    after = before - shape * (shape @ before) / (shape @ shape)
    base = made_fit(problem, before)
    grown = made_fit(problem, after, [made_candidate("friction")])
    columns = [wave[:, None] for wave in waves(len(noise))]
    named = [made_candidate(f"wave {i}") for i in range(len(columns))]
    screening = made_screening(base.jacobian, before, columns, named)
    assert screening.count == len(columns)
    start = made_start(base, screening, predicted=2.0, floor=float(len(noise)))
    refit = made_refit(grown, grown.criterion(fitter.records))
    assert refit.criterion < base.criterion(fitter.records)  # for white noise it is better
    return fitter, start, refit


def refusal(fitter, begun, contender, after, *, coloured):
    """Why a proposal of a large gain, which closes all, is refused; None if it is not."""
    gate = first_refusal(fitter, Attempt(begun, contender, after, 10.0, 1.0, coloured))
    return gate and gate.reason


def explained(noise, shape, size):
    """Whether such noise explains as much as the effect does."""
    fitter, start, refit = begun_and_grown(noise, shape, size)
    return coloured_noise_explains(fitter.records, start, refit)


@pytest.mark.parametrize("seed", range(5))
def test_slow_noise_explains_what_some_slow_function_follows_by_chance(seed):
    noise = slow_noise(1200, seed)
    assert explained(noise, best_wave(noise), 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_slow_noise_does_not_explain_an_effect_that_is_there(seed):
    shape = np.sin(np.linspace(0.0, 20.0, 1200))
    assert not explained(slow_noise(1200, seed), shape, 3.0)
    assert not explained(np.random.default_rng(seed).normal(size=1200), shape, 0.5)


@pytest.mark.parametrize("count", [100, 1200])
@pytest.mark.parametrize("seed", range(3))
def test_white_noise_does_not_explain_an_offset(count, seed):
    """The slowest of all effects, of the size of the noise."""
    noise = np.random.default_rng(seed).normal(size=count)
    assert not explained(noise, np.ones(count), 1.0)


def test_a_residual_without_noise_is_no_noise():
    """An autoregression of high order of what is so smooth is singular."""
    times = np.linspace(-5.0, 5.0, 1000)
    pulse = np.exp(-(times**2))
    rest = 1e-13 * np.random.default_rng(0).normal(size=1000)
    assert not explained(rest, pulse, 1.0)
    assert not explained(1e-3 * pulse, np.exp(-((times - 1.0) ** 2)), 1.0)


@pytest.mark.parametrize(("size", "why"), [(1.0, RejectionReason.COLOURED_GAIN), (100.0, None)])
def test_only_what_may_be_noise_is_refused_for_it(size, why):
    """What is far above the noise of a sensor is something else, of which an effect is a part."""
    noise = size * slow_noise(1200, 1)
    fitter, start, grown = begun_and_grown(noise, best_wave(noise), 0.0)
    assert coloured_noise_explains(fitter.records, start, grown)
    after = LeaveOneOutPrediction(np.full(1, 1.0))
    assert refusal(fitter, start, grown, after, coloured=True) is why


@pytest.mark.parametrize(("after", "refused"), [(700.0, True), (500.0, False)])
def test_an_effect_must_explain_more_than_the_numerical_error_could(after, refused):
    """Of squares 100, known up to a factor of 2, it could account for a fall of 400."""
    problem = made_problem(40)
    fitter, base = made_fitter(problem), fit_with_squares(problem, 1000.0)
    screening = made_screening(base.jacobian, base.residuals, [], [])
    begun = made_start(base, screening, predicted=1000.0, floor=1000.0, numerical=400.0)
    grown = fit_with_squares(problem, after)
    predicted = LeaveOneOutPrediction(np.array([after]))
    contender = made_refit(grown, grown.criterion(fitter.records))
    why = refusal(fitter, begun, contender, predicted, coloured=False)
    assert why is (RejectionReason.NUMERICAL_ERROR if refused else None)


@pytest.mark.parametrize(
    ("pole", "signal", "seen_by"),
    [
        pytest.param(0.0, 0.0, (0.0, 0.0), id="white noise is worth nothing to either"),
        pytest.param(0.95, 0.0, (0.9, 0.0), id="coloured noise looks like an effect to the plain"),
        pytest.param(0.5, 2.0, (1.0, 1.0), id="what is there is seen by both"),
    ],
)
def test_a_criterion_for_coloured_noise_is_not_taken_in_by_it(pole, signal, seen_by):
    """Of both criteria, in 40 draws, where eight cosines are fitted and paid for."""
    problem = made_problem(400)
    records = made_fitter(problem).records
    cosines = np.cos(np.pi * np.outer(np.linspace(0.0, 1.0, 400), np.arange(1, 9)))
    gains = []
    for seed in range(40):
        drawn = np.random.default_rng(seed).normal(size=600)
        values = lfilter([1.0], [1.0, -pole], drawn)[200:]
        values += signal * np.std(values) * cosines[:, 2]
        rest = values - cosines @ np.linalg.lstsq(cosines, values)[0]
        fits = [made_fit(problem, residuals) for residuals in (values, rest)]
        plain = [fit.criterion(records) for fit in fits]
        coloured = [coloured_criterion(fit, records, 2) for fit in fits]
        gains.append([before - after - 8 * np.log(400) for before, after in (plain, coloured)])
    shares = np.mean(np.array(gains) > 0.0, axis=0)
    assert shares == pytest.approx(seen_by, abs=0.1 if seen_by[0] == 0.9 else 0.0)
    assert shares[1] == seen_by[1]


GENERATOR = np.random.default_rng(5)
N, COUNT = 400, 60
MATRIX = GENERATOR.standard_normal((N, 3))
COLUMNS = [GENERATOR.standard_normal((N, 1)) for _ in range(COUNT)]


def elsewhere(name, family="friction"):
    """An effect of this name, with an argument of its own: no two are at one place."""
    made = made_candidate(name, family)
    return replace(made, effect=replace(made.effect, variables=(name,)))


def screened(residuals, columns, candidates=None):
    made = candidates or [elsewhere(f"e{i}") for i in range(len(columns))]
    return made_ranking(MATRIX, residuals, columns, made)


def left(residuals, *columns):
    """Sum of squares after least squares on the parameters and these columns."""
    joined = np.column_stack([MATRIX, *columns])
    fit = np.linalg.lstsq(joined, residuals, rcond=None)[0]
    return float(np.sum((residuals - joined @ fit) ** 2))


def planted():
    """Two alike columns of opposite sign: neither says much alone."""
    columns = list(COLUMNS)
    columns[40] = columns[17] + 0.3 * columns[40]
    residuals = columns[17][:, 0] - columns[40][:, 0] + MATRIX @ [2.0, -1.0, 0.5]
    return residuals + 0.05 * GENERATOR.standard_normal(N), columns


def test_a_planted_pair_comes_first():
    assert set(best_pairs(screened(*planted()))[0]) == {17, 40}


def test_pairs_are_ranked_as_by_least_squares():
    residuals = GENERATOR.standard_normal(N)
    found = best_pairs(screened(residuals, COLUMNS[:12]))
    every = {(i, j): left(residuals, COLUMNS[i], COLUMNS[j]) for i in range(12) for j in range(i)}
    assert len(found) == FITTED
    expected = sorted(every, key=every.get)[:FITTED]
    assert [frozenset(pair) for pair in found] == [frozenset(pair) for pair in expected]


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_scales_do_not_matter(scale):
    residuals, columns = planted()
    found = best_pairs(screened(scale * residuals, [scale**0.5 * c for c in columns]))
    assert set(found[0]) == {17, 40}


def spoiled(columns, case):
    """The planted pair, made one that is none; what is alike is so by its columns."""
    trials = [elsewhere(f"e{i}") for i in range(COUNT)]
    if case == "points of one grid":
        trials[40] = elsewhere("e17")
    elif case == "a free curve":
        trials[40] = elsewhere("e40", "table")
    else:
        columns[40] = columns[17] + 0.01 * COLUMNS[40]
    return trials


@pytest.mark.parametrize("case", ["points of one grid", "a free curve", "alike"])
def test_no_pair_are(case):
    residuals, columns = planted()
    found = best_pairs(screened(residuals, columns, spoiled(columns, case)))
    assert len(found) == FITTED
    assert {17, 40} not in [set(p) for p in found]


def test_one_pair_stands_for_all_at_the_same_two_places():
    """Forms of one argument at one site are alike, and must not crowd out what is elsewhere."""
    residuals = GENERATOR.standard_normal(N)
    trials = [made_candidate(f"e{i}") for i in range(10)] + [elsewhere("far"), elsewhere("off")]
    found = best_pairs(screened(residuals, COLUMNS[:12], trials))
    places = [tuple(sorted(max(i, 9) for i in pair)) for pair in found]
    assert sorted(places) == [(9, 9), (9, 10), (9, 11), (10, 11)]
    best = min(range(10), key=lambda i: left(residuals, COLUMNS[i], COLUMNS[10]))
    assert {best, 10} in [set(pair) for pair in found]


def test_one_candidate_is_no_pair():
    assert best_pairs(screened(GENERATOR.standard_normal(N), COLUMNS[:1])) == []
