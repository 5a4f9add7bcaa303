"""What nothing explains is described by its size and its spectrum."""

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_bench, made_fit, made_problem

from cluster_est.closed_loop.findings.residual.disturbance import unexplained_residuals

LENGTHS = (1001, 801)
SIGMA = 0.2


def described(signal, noise_of: float = 1.0):
    """A signal over time (each record lasts 1 s), in white noise, described."""
    problem = made_problem(*LENGTHS, sigma=SIGMA)
    random = np.random.default_rng(3)
    parts = [signal(np.linspace(0.0, 1.0, n)) + random.standard_normal(n) for n in LENGTHS]
    fitted = made_fit(problem, np.concatenate(parts))
    (found,) = unexplained_residuals(made_bench(problem), fitted, np.array([noise_of]))
    return found


def test_size_and_period_of_a_wave():
    found = described(lambda t: 5.0 * np.sin(2.0 * np.pi * 8.0 * t))
    assert found.over_noise == pytest.approx(5.0 / np.sqrt(2.0), rel=0.05)
    assert found.size == pytest.approx(SIGMA * 5.0 / np.sqrt(2.0), rel=0.05)
    assert found.period == pytest.approx(1.0 / 8.0, rel=0.1)
    assert "most of it with a period of" in found.sentence


def test_a_broad_spectrum_has_no_period():
    random = np.random.default_rng(5)
    found = described(
        lambda t: np.interp(t, np.linspace(0.0, 1.0, 41), 6.0 * random.normal(size=41))
    )
    assert np.isnan(found.period)
    assert 0.03 < found.shortest_period < 0.2
    assert "nine tenths of it with periods above" in found.sentence


def left_of(problem, residuals, noise):
    fitted = made_fit(problem, residuals)
    return unexplained_residuals(made_bench(problem), fitted, np.array(noise))


def test_noise_alone_is_not_described():
    random = np.random.default_rng(3)
    problem = made_problem(*LENGTHS, sigma=SIGMA)
    assert not left_of(problem, random.standard_normal(sum(LENGTHS)), [1.1])


def test_what_has_no_noise_comes_first_and_is_not_put_over_it():
    problem = made_problem(40, outputs=2, sigma=SIGMA)
    residuals = np.full(80, 2.0)
    first, second = left_of(problem, residuals, [1.0, 0.0])
    assert (first.output, second.output) == ("y1", "y0")
    assert first.size == pytest.approx(2.0 * SIGMA)
    assert "nan" not in first.sentence
    assert "times the noise" not in first.sentence


def test_a_size_is_in_the_unit_of_the_output_though_experiments_differ_in_sigma():
    """A wave of the same size in both, seen with a sigma of 0.5 and of 2."""
    runs = made_problem(400, 400).experiments
    runs = tuple(
        replace(run, outputs=tuple(replace(o, sigma=sigma) for o in run.outputs))
        for run, sigma in zip(runs, (0.5, 2.0), strict=True)
    )
    problem = replace(made_problem(400, 400), experiments=runs)
    wave = 8.0 * np.sin(2.0 * np.pi * 10.0 * np.linspace(0.0, 1.0, 400))
    (found,) = left_of(problem, np.concatenate([wave / 0.5, wave / 2.0]), [1.0])
    assert found.size == pytest.approx(8.0 / np.sqrt(2.0), rel=0.02)
    pooled = np.sqrt((0.5**2 + 2.0**2) / 2.0)
    noise = made_bench(problem).noise_in_units(np.array([1.0]))
    assert noise == {"y0": pytest.approx(pooled)}


def with_times(problem, *times):
    """The same experiments, each measured at these times."""
    runs = tuple(
        replace(
            run,
            stop=float(own[-1]),
            outputs=tuple(replace(o, times=own, values=np.zeros(len(own))) for o in run.outputs),
        )
        for run, own in zip(problem.experiments, times, strict=True)
    )
    return replace(problem, experiments=runs)


def test_a_record_of_bursts_has_no_spectrum():
    """Even steps of a millisecond would be 86 million."""
    bursts = np.concatenate([3600.0 * k + 0.001 * np.arange(20) for k in range(24)])
    problem = with_times(made_problem(480), bursts)
    (found,) = left_of(problem, np.full(480, 3.0), [1.0])
    assert np.isnan(found.shortest_period)
    assert np.isnan(found.period)


def test_a_record_that_is_sampled_far_more_slowly_than_another_is_left_out():
    fast, slow = np.linspace(0.0, 1.0, 1001), np.linspace(0.0, 1000.0, 1001)
    problem = with_times(made_problem(1001, 1000), fast, slow[:1000])
    wave = 5.0 * np.sin(2.0 * np.pi * 8.0 * fast)
    (found,) = left_of(problem, np.concatenate([wave, np.zeros(1000)]), [1.0])
    assert found.period == pytest.approx(1.0 / 8.0, rel=0.1)
