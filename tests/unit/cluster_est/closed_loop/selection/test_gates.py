"""What structures must come down to, to be of any use."""

from __future__ import annotations

import numpy as np
import pytest
from support.loop_objects import (
    fit_with_squares,
    made_bench,
    made_candidate,
    made_fit,
    made_problem,
    made_screening,
)

from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import (
    best_that_passes,
    coloured_noise_explains,
    failed_gate,
    useful_sse,
)
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.visited_models import VisitedModels
from cluster_est.closed_loop.selection.rounds import RejectionReason, RoundStart

FLOOR = 40.0
VISITED = VisitedModels(1.0)


def begun(problem, base, model):
    fits = [fit_with_squares(problem, squares) for squares in (base, model)]
    screening = made_screening(fits[0].jacobian, fits[0].residuals, [], [])
    return RoundStart(*fits, LeaveOneOutPrediction(np.ones(1)), screening, VISITED, FLOOR)


def test_a_structure_that_may_grow_further_is_of_use_whatever_it_leaves():
    problem = made_problem(40, sigma=0.5)
    assert useful_sse(made_bench(problem), begun(problem, 4040.0, 2000.0), 2) == np.inf


@pytest.mark.parametrize(
    ("model", "most"),
    [
        (2040.0, 4040.0 - 0.75 * 4000.0),  # what a claim needs
        (540.0, 540.0 - 0.2 * 500.0),  # what an effect must close
        (100.0, 1.5**2 * FLOOR),  # what may be noise for its size
    ],
)
def test_the_last_effect_must_lead_to_a_claim(model, most):
    problem = made_problem(40, sigma=0.5)
    found = useful_sse(made_bench(problem), begun(problem, 4040.0, model), 3)
    assert found == pytest.approx(most)


def test_without_a_declared_sigma_more_may_be_noise():
    problem = made_problem(40)
    found = useful_sse(made_bench(problem), begun(problem, 4040.0, 1040.0), 3)
    assert found == pytest.approx(5.0**2 * FLOOR)


def test_a_round_in_which_nothing_was_worth_a_refit_says_so():
    problem = made_problem(40)
    end = best_that_passes(made_bench(problem), begun(problem, 90.0, 80.0), [])
    assert end.won is None
    assert end.seen.why is RejectionReason.LITTLE_PROMISED


def slow_noise(count: int, seed: int) -> np.ndarray:
    """White noise of a sensor, and a process's of half its size that lasts 60 samples."""
    generator = np.random.default_rng(seed)
    slow = np.zeros(count)
    for t in range(1, count):
        slow[t] = (1.0 - 1.0 / 60.0) * slow[t - 1] + generator.normal()
    return generator.normal(size=count) + 0.5 * slow / slow.std()


def waves(count):
    return [np.sin(np.linspace(0.0, turns, count)) for turns in np.linspace(3.0, 60.0, 150)]


WAVES = waves(1200)


def begun_and_grown(noise, shape, size, floor):
    """Before and after this one of 150 effects, with such noise beside what it has made."""
    problem = made_problem(len(noise))
    before = noise + size * shape
    after = before - shape * (shape @ before) / (shape @ shape)
    bench = made_bench(problem)
    fits = [made_fit(problem, before), made_fit(problem, after, [made_candidate("friction")])]
    columns = [wave[:, None] for wave in waves(len(noise))]
    named = [made_candidate(f"wave {i}") for i in range(len(WAVES))]
    screening = made_screening(fits[0].jacobian, before, columns, named)
    assert screening.count == len(WAVES)
    start = RoundStart(
        *fits[:1] * 2, LeaveOneOutPrediction(np.full(1, 2.0)), screening, VISITED, floor
    )
    grown = RefittedCandidate(fits[1], fits[1].criterion(bench.records), full=True)
    assert grown.criterion < fits[0].criterion(bench.records)  # for white noise it is better
    return bench, start, grown


def explained(noise, shape, size):
    """Whether such noise explains as much as the effect does."""
    return coloured_noise_explains(*begun_and_grown(noise, shape, size, float(len(noise))))


@pytest.mark.parametrize("seed", range(10))
def test_slow_noise_explains_what_some_slow_function_follows_by_chance(seed):
    noise = slow_noise(1200, seed)
    best = max(WAVES, key=lambda wave: abs(wave @ noise) / np.sqrt(wave @ wave))
    assert explained(noise, best, 0.0)


@pytest.mark.parametrize("seed", range(10))
def test_slow_noise_does_not_explain_an_effect_that_is_there(seed):
    shape = np.sin(np.linspace(0.0, 20.0, 1200))
    assert not explained(slow_noise(1200, seed), shape, 3.0)
    assert not explained(np.random.default_rng(seed).normal(size=1200), shape, 0.5)


@pytest.mark.parametrize("count", [100, 1200])
@pytest.mark.parametrize("seed", range(5))
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
    best = max(WAVES, key=lambda wave: abs(wave @ noise) / np.sqrt(wave @ wave))
    bench, start, grown = begun_and_grown(noise, best, 0.0, 1200.0)
    coloured = coloured_noise_explains(bench, start, grown)
    assert coloured
    after = LeaveOneOutPrediction(np.full(1, 1.0))
    failed = failed_gate(bench, start, grown.fitted, after, 10.0, 1.0, coloured=coloured)
    assert failed is why
