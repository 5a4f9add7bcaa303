from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from support.loop_objects import (
    made_candidate,
    made_fit,
    made_fitter,
    made_problem,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est.closed_loop.account import last_noise
from cluster_est.closed_loop.findings.unexplained import unexplained_residuals
from cluster_est.closed_loop.output_noise import (
    believed_noise,
    is_noise_of_sensors,
    residual_noise,
    rounding_notes,
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
    fitter, fitted = made_fitter(problem), made_fit(problem, residual)
    noise = estimate_noise(residual, fitter.records)
    return residual_noise(fitter, fitted, noise), noise


def of_sensors(residual: np.ndarray, declared: float | None) -> bool:
    """Of a residual in units, where a sigma is declared or not."""
    sigma = 1.0 if declared is None else declared
    outputs, _ = looked_at(made_problem(*LENGTHS, sigma=sigma), residual / sigma)
    return is_noise_of_sensors(outputs, near=1.5, largest=5.0, whitened=False)


@pytest.mark.parametrize(
    ("step", "noise", "said"), [(0.05, 0.0163, True), (0.05, 0.06, False), (0.0, 0.0163, False)]
)
def test_a_noise_that_is_mostly_rounding_is_named(step, noise, said):
    problem = made_problem(600)
    (run,) = problem.experiments
    values = 3.0 * np.sin(7.0 * run.outputs[0].times)
    values = step * np.rint(values / step) if step else values
    output = replace(run.outputs[0], values=values)
    problem = replace(problem, experiments=(replace(run, outputs=(output,)),))
    notes = rounding_notes(made_fitter(problem), {"y0": noise})
    assert len(notes) == said
    assert not said or notes[0].startswith(
        "the values of output y0 are multiples of 0.05: rounding alone causes an error of 0.0144"
    )


def test_the_noise_that_is_shown_with_effects_is_what_they_leave():
    problem = made_problem(600)
    random = np.random.default_rng(5)
    noise = 0.14 * random.standard_normal(600)
    added = [made_candidate("a")]
    base = made_fit(problem, 2.0 * noise)
    current = made_fit(problem, noise, added)
    last = made_round(None, made_screening(base.jacobian, base.residuals, [], []))
    found = made_selection(base, current, last, noise=[0.28])
    assert last_noise(made_fitter(problem), found, keep=False) == pytest.approx(0.28)
    assert last_noise(made_fitter(problem), found, keep=True) == pytest.approx(0.14, rel=0.1)


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


@pytest.mark.parametrize("size", [0.7, 1.0, 1.2])
def test_an_offset_on_top_of_white_noise_of_the_declared_sigma_is_not_within_it(size):
    """It lasts for ever: its own memory would leave too few degrees of freedom to reject it."""
    residual = np.random.default_rng(3).standard_normal(800) + size
    ((output,), _) = looked_at(made_problem(800, sigma=TRUE), residual)
    assert output.believed
    assert not output.within


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("correlation", [0.3, 0.6, 0.9])
def test_coloured_noise_of_the_declared_sigma_is_within_it(correlation, seed):
    (output,), _ = looked_at(made_problem(*LENGTHS, sigma=TRUE), coloured(correlation, seed))
    assert output.within


@pytest.mark.parametrize("declared", [TRUE, 1.0])
def test_a_residual_without_noise_is_none_of_a_sensor(declared):
    problem = made_problem(60, sigma=declared)
    fitter, fitted = made_fitter(problem), made_fit(problem, np.full(60, 5.0))
    outputs = residual_noise(fitter, fitted, np.zeros(1))
    assert [o.output for o in outputs] == ["y0"]
    assert not is_noise_of_sensors(outputs, near=1.5, largest=5.0, whitened=True)


def test_an_output_that_is_followed_exactly_has_nothing_to_compare():
    problem = made_problem(60, sigma=TRUE)
    fitter = made_fitter(problem)
    assert residual_noise(fitter, made_fit(problem, np.zeros(60)), np.zeros(1)) == ()


@pytest.mark.parametrize(
    ("declared", "said"),
    [
        (TRUE, ""),
        (TRUE / 10.0, "too small; multiply it by 10 (key sigma in the experiments) and run again"),
        (
            TRUE * 10.0,
            "probably 9.9 times too large; correct it, because otherwise errors over sigma have no "
            "meaning",
        ),
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
    found = believed_noise(made_fitter(problem), outputs, noise)[0]
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
        ((TRUE, TRUE, TRUE / 10.0, TRUE), "correct it in 'run 2'"),
        (
            (TRUE / 9.0, TRUE / 9.0, TRUE / 10.0, TRUE / 9.0),
            "y0: the noise is about 9.3 times the declared sigma",
        ),
        ((TRUE, 1.1 * TRUE, 1.2 * TRUE, TRUE), ""),
    ],
)
def test_the_experiment_whose_sigma_is_wrong_is_named(sigmas, named):
    residual = TRUE * coloured(0.0, 2) / np.repeat(sigmas, LENGTHS)
    said = suspected_sigma(looked_at(with_sigmas(made_problem(*LENGTHS), *sigmas), residual)[0])
    assert named in said
    assert bool(said) is bool(named)


def test_the_noise_is_no_larger_than_what_a_fit_leaves():
    """Found with the declared model, whose residual was rougher by the effect that it lacked."""
    problem = made_problem(*LENGTHS, sigma=0.5)
    left = 5.0 * coloured(0.0, 2)
    (output,) = residual_noise(made_fitter(problem), made_fit(problem, left), np.array([9.4]))
    assert output.white == pytest.approx(output.level) == pytest.approx(np.sqrt(np.mean(left**2)))


@pytest.mark.parametrize(("length", "sure"), [(9, False), (60, True)])
def test_records_too_short_to_tell_their_noise_do_not_make_sigma_the_error(length, sure):
    """A straight line is left, ten times as large as sigma: no noise, but nine samples hide that.

    With more of them it is noise of that size.
    """
    line = np.linspace(-1.0, 1.0, length) if not sure else np.resize([1.0, -1.0], length)
    residual = np.tile(10.0 * line / np.sqrt(np.mean(line**2)), 4)
    said = suspected_sigma(looked_at(made_problem(*(length,) * 4, sigma=0.5), residual)[0])
    assert ("is probably" in said) is sure
    assert ("y0 is 10 times the declared sigma; all records have fewer" in said) is not sure


def test_a_sigma_that_may_not_have_been_given_is_said_to_be_one():
    """Of two outputs one has a sigma; the other's is 1, as where none is given."""
    problem = made_problem(60, outputs=2)
    (run,) = problem.experiments
    first, second = run.outputs
    outputs = (replace(first, sigma=0.5), second)
    problem = replace(problem, experiments=(replace(run, outputs=outputs),))
    found, _ = looked_at(problem, 0.01 * np.random.default_rng(1).standard_normal(120))
    assert (
        "y0 and y1 (sigma is 1, the default): error is 0.0083 to 0.0086 x sigma"
        in suspected_sigma(found)
    )


def test_scaling_changes_nothing():
    residual = disturbed(2.0, 4)
    problems = (made_problem(*LENGTHS, sigma=sigma) for sigma in (1.7, 1.7e-6))
    one, other = (looked_at(problem, residual)[0][0] for problem in problems)
    assert one.level == pytest.approx(other.level)
    assert one.white == pytest.approx(other.white)
    assert one.first_order is other.first_order


UNEQUAL = (1001, 801)
SIGMA = 0.2


def left_of(problem, residuals, noise):
    fitted = made_fit(problem, residuals)
    return unexplained_residuals(made_fitter(problem), fitted, np.array(noise))


def described(signal):
    """A signal over time (each record lasts 1 s), in white noise, described."""
    problem = made_problem(*UNEQUAL, sigma=SIGMA)
    random = np.random.default_rng(3)
    parts = [signal(np.linspace(0.0, 1.0, n)) + random.standard_normal(n) for n in UNEQUAL]
    (found,) = left_of(problem, np.concatenate(parts), [1.0])
    return found


def test_size_and_period_of_a_wave():
    found = described(lambda t: 5.0 * np.sin(2.0 * np.pi * 8.0 * t))
    assert found.over_noise == pytest.approx(5.0 / np.sqrt(2.0), rel=0.05)
    assert found.size == pytest.approx(SIGMA * 5.0 / np.sqrt(2.0), rel=0.05)
    assert found.period == pytest.approx(1.0 / 8.0, rel=0.1)
    assert "rms, mostly with a period of 0.1" in found.sentence


def test_a_broad_spectrum_has_no_period():
    random = np.random.default_rng(5)
    found = described(
        lambda t: np.interp(t, np.linspace(0.0, 1.0, 41), 6.0 * random.normal(size=41))
    )
    assert np.isnan(found.period)
    assert 0.03 < found.shortest_period < 0.2
    assert "with 90% of the power of this change at periods above" in found.sentence


def test_noise_alone_is_not_described():
    random = np.random.default_rng(3)
    problem = made_problem(*UNEQUAL, sigma=SIGMA)
    assert not left_of(problem, random.standard_normal(sum(UNEQUAL)), [1.1])


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
    problem = with_sigmas(made_problem(400, 400), 0.5, 2.0)
    wave = 8.0 * np.sin(2.0 * np.pi * 10.0 * np.linspace(0.0, 1.0, 400))
    (found,) = left_of(problem, np.concatenate([wave / 0.5, wave / 2.0]), [1.0])
    assert found.size == pytest.approx(8.0 / np.sqrt(2.0), rel=0.02)
    pooled = np.sqrt((0.5**2 + 2.0**2) / 2.0)
    noise = made_fitter(problem).noise_in_units(np.array([1.0]))
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
