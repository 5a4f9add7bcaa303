"""The noise of sensors is told from disturbances, and from a sigma that is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from support.loop_objects import made_bench, made_fit, made_problem

from cluster_est.closed_loop.findings.residual.noise_of_sensors import (
    believed_noise,
    is_noise_of_sensors,
    residual_noise,
    suspected_sigma,
)
from cluster_est.statistics.noise.estimate import estimate_noise

LENGTHS = (600, 600, 600, 600)
TRUE = 0.2


def coloured(correlation: float, seed: int) -> np.ndarray:
    """First-order noise of standard deviation 1, a record after the other."""
    random = np.random.default_rng(seed)
    parts = []
    for length in LENGTHS:
        white = random.standard_normal(length + 300) * np.sqrt(1.0 - correlation**2)
        parts.append(lfilter([1.0], [1.0, -correlation], white)[300:])
    return np.concatenate(parts)


def disturbed(size: float, seed: int) -> np.ndarray:
    """White noise of standard deviation 1, and a smooth random force through a slow system."""
    random = np.random.default_rng(seed)
    parts = []
    for length in LENGTHS:
        slow = lfilter([1.0], [1.0, -1.94, 0.944], random.standard_normal(length + 500))[500:]
        parts.append(size * slow / slow.std() + random.standard_normal(length))
    return np.concatenate(parts)


def looked_at(problem, residual: np.ndarray):
    """What the outputs of a residual over sigma show, and the noise that is estimated for them."""
    bench, fitted = made_bench(problem), made_fit(problem, residual)
    noise = estimate_noise(residual, bench.records)
    return residual_noise(bench, fitted, noise), noise


def of_sensors(residual: np.ndarray, declared: float | None) -> bool:
    """Of a residual in units, where a sigma is declared or not."""
    sigma = 1.0 if declared is None else declared
    outputs, _ = looked_at(made_problem(*LENGTHS, sigma=sigma), residual / sigma)
    return is_noise_of_sensors(outputs, near=1.5, largest=5.0, whitened=False)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("correlation", [0.0, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("declared", [TRUE, None])
def test_coloured_noise_is_that_of_sensors(correlation, seed, declared):
    assert of_sensors(TRUE * coloured(correlation, seed), declared)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("size", [0.7, 3.0, 15.0])
@pytest.mark.parametrize("declared", [TRUE, None])
def test_a_disturbance_is_not(size, seed, declared):
    assert not of_sensors(TRUE * disturbed(size, seed), declared)


def test_an_offset_is_not():
    assert not of_sensors(np.full(sum(LENGTHS), 2.0) + 0.5 * coloured(0.0, 1), None)


def test_coloured_noise_above_a_declared_sigma_is_not():
    assert not of_sensors(2.0 * TRUE * coloured(0.8, 1), TRUE)


@pytest.mark.parametrize("amplitude", [3.0, 10.0, 30.0])
def test_a_slow_wave_in_a_short_record_is_not_within_its_sigma(amplitude):
    """Its mean square has a large error, because it is that of a wave."""
    wave = amplitude * np.sin(2.0 * np.pi * np.arange(40) / 20.0)
    residual = wave + np.random.default_rng(0).standard_normal(40)
    ((output,), _) = looked_at(made_problem(40, sigma=TRUE), residual)
    assert output.believed
    assert not output.within


@pytest.mark.parametrize("declared", [TRUE, 1.0])
def test_a_residual_without_noise_is_none_of_a_sensor(declared):
    problem = made_problem(60, sigma=declared)
    bench, fitted = made_bench(problem), made_fit(problem, np.full(60, 5.0))
    outputs = residual_noise(bench, fitted, np.zeros(1))
    assert [o.output for o in outputs] == ["y0"]
    assert not is_noise_of_sensors(outputs, near=1.5, largest=5.0, whitened=True)


def test_an_output_that_is_followed_exactly_has_nothing_to_compare():
    problem = made_problem(60, sigma=TRUE)
    bench = made_bench(problem)
    assert residual_noise(bench, made_fit(problem, np.zeros(60)), np.zeros(1)) == ()


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        (TRUE, ""),
        (TRUE / 10.0, "the noise alone, from one sample to the next, is 10 times as large"),
        (TRUE * 10.0, "all that is left is 0.1 times as large"),
        (None, ""),
    ],
)
def test_a_wrong_sigma_is_named_and_not_believed(declared, said):
    sigma = 1.0 if declared is None else declared
    problem = made_problem(*LENGTHS, sigma=sigma)
    outputs, noise = looked_at(problem, TRUE * coloured(0.0, 2) / sigma)
    sentence = suspected_sigma(outputs)
    assert sentence.endswith(said)
    assert bool(sentence) is bool(said)
    found = believed_noise(made_bench(problem), outputs, noise)[0]
    assert sigma * found == pytest.approx(TRUE, rel=0.1)


def with_sigmas(problem, *sigmas: float):
    """The same experiments, each with a sigma of its own."""
    runs = tuple(
        replace(run, outputs=tuple(replace(o, sigma=sigma) for o in run.outputs))
        for run, sigma in zip(problem.experiments, sigmas, strict=True)
    )
    return replace(problem, experiments=runs)


@pytest.mark.parametrize(
    ("sigmas", "named"),
    [
        ((TRUE, TRUE, TRUE / 10.0, TRUE), "declared sigma of y0 in 'run 2' is likely the error"),
        (
            (TRUE / 9.0, TRUE / 9.0, TRUE / 10.0, TRUE / 9.0),
            "declared sigma of y0 is likely the error",
        ),
        ((TRUE, 1.1 * TRUE, 1.2 * TRUE, TRUE), ""),
    ],
)
def test_the_experiment_whose_sigma_is_wrong_is_named(sigmas, named):
    residual = TRUE * coloured(0.0, 2) / np.repeat(sigmas, LENGTHS)
    said = suspected_sigma(looked_at(with_sigmas(made_problem(*LENGTHS), *sigmas), residual)[0])
    assert named in said
    assert bool(said) is bool(named)


@pytest.mark.parametrize(("length", "sure"), [(9, False), (60, True)])
def test_records_too_short_to_tell_their_noise_do_not_make_sigma_the_error(length, sure):
    """A straight line is left, ten times as large as sigma: no noise, but nine samples hide that.

    With more of them it is noise of that size.
    """
    line = np.linspace(-1.0, 1.0, length) if not sure else np.resize([1.0, -1.0], length)
    residual = np.tile(10.0 * line / np.sqrt(np.mean(line**2)), 4)
    said = suspected_sigma(looked_at(made_problem(*(length,) * 4, sigma=0.5), residual)[0])
    assert ("is likely the error" in said) is sure
    assert ("y0 is 10 times the declared sigma, and with records of fewer" in said) is not sure


def test_a_sigma_that_may_not_have_been_given_is_said_to_be_one():
    """Of two outputs one has a sigma; the other's is 1, as where none is given."""
    problem = made_problem(60, outputs=2)
    (run,) = problem.experiments
    first, second = run.outputs
    outputs = (replace(first, sigma=0.5), second)
    problem = replace(problem, experiments=(replace(run, outputs=outputs),))
    found, _ = looked_at(problem, 0.01 * np.random.default_rng(1).standard_normal(120))
    assert "sigma of y0 and y1 (1, as where none is given) is likely" in suspected_sigma(found)


def test_scaling_changes_nothing():
    residual = disturbed(2.0, 4)
    problems = (made_problem(*LENGTHS, sigma=sigma) for sigma in (1.7, 1.7e-6))
    one, other = (looked_at(problem, residual)[0][0] for problem in problems)
    assert one.level == pytest.approx(other.level)
    assert one.white == pytest.approx(other.white)
    assert one.first_order is other.first_order
