"""What autocorrelated noise explains is no effect; what is there is one, whatever the noise."""

import numpy as np
import pytest
from scipy.signal import lfilter
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_fit,
    made_problem,
    made_refit,
    made_screening,
    made_start,
)

from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import coloured_noise_explains, failed_gate
from cluster_est.closed_loop.selection.rounds import RejectionReason
from cluster_est.closed_loop.selection.single_effect import coloured_criterion


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
    bench = made_bench(problem)
    before = noise + size * shape
    after = before - shape * (shape @ before) / (shape @ shape)
    base = made_fit(problem, before)
    grown = made_fit(problem, after, [made_candidate("friction")])
    columns = [wave[:, None] for wave in waves(len(noise))]
    named = [made_candidate(f"wave {i}") for i in range(len(columns))]
    screening = made_screening(base.jacobian, before, columns, named)
    assert screening.count == len(columns)
    start = made_start(base, screening, predicted=2.0, floor=float(len(noise)))
    refit = made_refit(grown, grown.criterion(bench.records))
    assert refit.criterion < base.criterion(bench.records)  # for white noise it is better
    return bench, start, refit


def explained(noise, shape, size):
    """Whether such noise explains as much as the effect does."""
    return coloured_noise_explains(*begun_and_grown(noise, shape, size))


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
    bench, start, grown = begun_and_grown(noise, best_wave(noise), 0.0)
    assert coloured_noise_explains(bench, start, grown)
    after = LeaveOneOutPrediction(np.full(1, 1.0))
    assert failed_gate(bench, start, grown.fitted, after, 10.0, 1.0, coloured=True) is why


@pytest.mark.parametrize(("after", "refused"), [(700.0, True), (500.0, False)])
def test_an_effect_must_explain_more_than_the_numerical_error_could(after, refused):
    """Of squares 100, known up to a factor of 2, it could account for a fall of 400."""
    problem = made_problem(40)
    bench, base = made_bench(problem), fit_with_squares(problem, 1000.0)
    screening = made_screening(base.jacobian, base.residuals, [], [])
    begun = made_start(base, screening, predicted=1000.0, floor=1000.0, numerical=400.0)
    grown = fit_with_squares(problem, after)
    predicted = LeaveOneOutPrediction(np.array([after]))
    why = failed_gate(bench, begun, grown, predicted, 10.0, 1.0, coloured=False)
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
    records = made_bench(problem).records
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
