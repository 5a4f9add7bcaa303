import numpy as np
import pytest
from scipy.signal import lfilter
from support.truth.stacked_noise import stack

from cluster_est.statistics.noise.estimate import estimate_noise, quantisation_step
from cluster_est.statistics.noise.growing_noise import noise_growth
from cluster_est.statistics.noise.outliers import isolated_outliers
from workers.messages import FloatArray

N = 2500
LENGTH = 2000
STEPS = np.arange(LENGTH)
SIZE = 100.0 * np.abs(np.sin(2.0 * np.pi * np.arange(N) / 300.0))


def test_noise_under_a_smooth_trend() -> None:
    generator = np.random.default_rng(1)
    records = stack(2000, 1000, 12, 5, outputs=2)
    sigmas = np.array([0.3, 4.0])
    residuals = np.zeros(records.size)
    for item in records.items:
        t = item.times
        trend = 50.0 * t**3 + 20.0 * np.sin(9.0 * t) * (len(t) > 100) + 7.0
        noise = sigmas[item.output] * generator.standard_normal(len(t))
        residuals[item.rows] = trend + noise
    assert estimate_noise(residuals, records) == pytest.approx(sigmas, rel=0.08)


def test_jumps_are_ignored_and_units_do_not_matter() -> None:
    generator = np.random.default_rng(2)
    records = stack(3000)
    residuals = generator.standard_normal(3000)
    residuals[1000:] += 200.0
    (sigma,) = estimate_noise(residuals, records)
    assert sigma == pytest.approx(1.0, rel=0.08)
    assert estimate_noise(-1e-9 * residuals, records) == pytest.approx(1e-9 * sigma, rel=1e-12)


def test_short_records_count_only_where_there_is_no_other() -> None:
    generator = np.random.default_rng(3)
    long = generator.standard_normal(50)
    short = np.array([5.0, -5.0, 5.0])
    alone = estimate_noise(long, stack(50))
    assert estimate_noise(np.r_[long, short], stack(50, 3)).tolist() == alone.tolist()
    assert estimate_noise(np.r_[short, 3.0 * short], stack(3, 3)) == pytest.approx(np.sqrt(125.0))


def test_coarse_quantisation_gives_the_rms_of_the_differences() -> None:
    # one sample in 40 differs by a step of 1: mean square of the noise 1/40, median 0
    residuals = np.tile(np.r_[1.0, np.zeros(39)], 50)
    (sigma,) = estimate_noise(residuals, stack(2000))
    assert sigma == pytest.approx(np.sqrt(1.0 / 40.0), rel=0.02)
    assert estimate_noise(np.zeros(100), stack(100)).tolist() == [0.0]


def wave(n: int, period: float = 200.0) -> FloatArray:
    return 100.0 * np.sin(2.0 * np.pi * np.arange(n) / period)


def move_in_the_middle(at_rest: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Noise of 1 in the fifth of a record that moves, and little of it elsewhere."""
    generator = np.random.default_rng(seed)
    signal = np.zeros(N)
    signal[1000:1500] = wave(500)
    size = np.full(N, at_rest)
    size[1000:1500] = 1.0
    noise = size * generator.standard_normal(N)
    return noise, signal + noise


@pytest.mark.parametrize("n", [500, pytest.param(2000, marks=pytest.mark.slow)])
def test_white_noise_of_a_signal_that_moves_is_unbiased(n: int) -> None:
    generator = np.random.default_rng(n)
    found = []
    for _ in range(300):
        noise = generator.standard_normal(n)
        found.append(estimate_noise(noise, stack(n), wave(n) + noise)[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.03)


def test_knowing_the_signal_changes_nothing_where_the_noise_is_the_same() -> None:
    generator = np.random.default_rng(4)
    for _ in range(30):
        noise = generator.standard_normal(N)
        rested = np.where(np.arange(N) < 500, wave(N), 0.0) + noise
        alone = estimate_noise(noise, stack(N)).tolist()
        assert estimate_noise(noise, stack(N), rested).tolist() == alone


@pytest.mark.parametrize("at_rest", [0.0, pytest.param(1e-5, marks=pytest.mark.slow), 0.3])
def test_noise_is_that_of_the_motion(at_rest: float) -> None:
    found = []
    for seed in range(40):
        noise, measured = move_in_the_middle(at_rest, seed)
        found.append(estimate_noise(noise, stack(N), measured)[0])
        assert estimate_noise(noise, stack(N))[0] < 0.6  # which does not know the motion
    assert np.mean(found) == pytest.approx(1.0, abs=0.12)


def test_structure_in_motion_is_no_noise() -> None:
    # 20 samples a period: the fourth difference keeps 1.6 of 100, the eighth next to nothing
    found = []
    for seed in range(20):
        noise, measured = move_in_the_middle(1.0, seed)
        structure = np.where(np.abs(measured) > 5.0, wave(N, 20.0), 0.0)
        found.append(estimate_noise(noise + structure, stack(N), measured + structure)[0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(
    ("step", "moving"),
    [
        (1.0, True),
        (2.0, False),
        pytest.param(1.0, False, marks=pytest.mark.slow),
        pytest.param(2.0, True, marks=pytest.mark.slow),
    ],
)
def test_a_quantised_signal(step: float, moving: bool) -> None:
    generator = np.random.default_rng(5)
    found = []
    for _ in range(40):
        true = wave(N) if moving else np.full(N, generator.uniform(0.0, step))
        measured = step * np.round((true + generator.standard_normal(N)) / step)
        found.append(estimate_noise(measured - true, stack(N), measured)[0])
    assert np.mean(found) == pytest.approx(np.sqrt(1.0 + step**2 / 12.0), rel=0.04)


def test_an_encoder_at_rest_has_the_noise_of_its_step() -> None:
    true = np.where(np.abs(np.arange(N) - 1250) < 250, wave(N), 0.0) + 1e-4 * wave(N, 900.0)
    measured = 0.5 * np.round(true / 0.5)
    assert estimate_noise(measured - true, stack(N))[0] < 1e-3
    found = estimate_noise(measured - true, stack(N), measured)
    assert found[0] > 0.999 * 0.5 / np.sqrt(12.0)


def test_the_step_of_a_signal() -> None:
    generator = np.random.default_rng(6)
    counts = generator.integers(-40, 40, 300)
    assert quantisation_step(0.1 * counts + 7.03) == pytest.approx(0.1, rel=1e-9)
    assert quantisation_step(np.round(generator.standard_normal(50), 1)) == pytest.approx(0.1)
    assert quantisation_step(np.where(counts > 0, 2.0, 1.5)) == 0.5
    for silent in (np.zeros(0), np.ones(30), generator.standard_normal(3)):
        assert quantisation_step(silent) == 0.0
    for _ in range(200):
        assert quantisation_step(generator.standard_normal(40)) == 0.0
    # clipped, or at rest: values repeat, but they have no step in common
    assert quantisation_step(np.maximum(generator.standard_normal(300), 0.5)) == 0.0
    assert quantisation_step(np.where(np.arange(300) < 250, 0.0, wave(300) / 3.0)) == 0.0


def test_growing_noise_of_two_levels() -> None:
    generator = np.random.default_rng(1)
    # a third of |sin| is below 0.5, a third above 0.87
    grown = noise_growth(np.where(SIZE > 60.0, 3.0, 1.0) * generator.standard_normal(N), SIZE)
    assert grown.p < 1e-6
    assert grown.quiet == pytest.approx(1.0, rel=0.25)
    assert grown.loud == pytest.approx(3.0, rel=0.25)


def test_two_parts_of_growing_noise_even_where_the_signal_swings_through_zero() -> None:
    generator = np.random.default_rng(4)
    swing = 100.0 * np.sin(2.0 * np.pi * np.arange(N) / 40.0)
    for constant, part in ((2.0, 0.05), (5.0, 0.2)):
        noise = np.hypot(constant, part * swing) * generator.standard_normal(N)
        grown = noise_growth(noise, swing + noise)
        assert grown.constant == pytest.approx(constant, rel=0.2)
        assert grown.part == pytest.approx(part, rel=0.1)
    alone = noise_growth(0.05 * SIZE * generator.standard_normal(N), SIZE)
    assert alone.part == pytest.approx(0.05, rel=0.1)
    assert 0.0 < alone.constant < 0.3


def test_p_values_are_even_where_noise_does_not_grow_even_under_a_misfit_that_grows() -> None:
    generator = np.random.default_rng(2)
    misfit = 1e-2 * SIZE**2
    found = [noise_growth(generator.standard_normal(N) + misfit, SIZE).p for _ in range(300)]
    assert min(found) > 1e-4
    assert np.mean(np.array(found) < 0.1) == pytest.approx(0.1, abs=0.06)
    assert np.median(found) == pytest.approx(0.5, abs=0.12)


def test_without_two_levels_no_noise_grows() -> None:
    generator = np.random.default_rng(3)
    for n in (0, 6, 40):
        assert noise_growth(generator.standard_normal(n), np.arange(float(n))).p == 1.0
    assert noise_growth(generator.standard_normal(500), np.ones(500)).p == 1.0
    assert noise_growth(np.zeros(500), np.arange(500.0)).p == 1.0


def white(seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(LENGTH)


def planted(seed: int, share: float) -> tuple[FloatArray, FloatArray]:
    """Which samples are off, and by how much: 8 to 20."""
    generator = np.random.default_rng([seed, 1])
    off = generator.choice([-1.0, 1.0], LENGTH) * generator.uniform(8.0, 20.0, LENGTH)
    where = generator.uniform(size=LENGTH) < share
    where[:2] = where[-2:] = False
    return where, np.where(where, off, 0.0)


@pytest.mark.parametrize("period", [0, 50, 500])
def test_outliers_are_found_on_any_smooth_course(period: int) -> None:
    course = 100.0 * np.sin(2.0 * np.pi * STEPS / period) if period else np.zeros(LENGTH)
    true = found = wrong = 0
    for seed in range(20):
        where, off = planted(seed, 0.01)
        mask = isolated_outliers(course + white(seed) + off, 1.0).mask
        true += int(where.sum())
        found += int((mask & where).sum())
        wrong += int((mask & ~where).sum())
    assert true > 350
    assert found > 0.85 * true
    assert wrong < 0.02 * true


def test_how_far_the_farthest_outlier_is() -> None:
    signal = white(3)
    signal[700] += 15.0
    signal[1200] -= 30.0
    found = isolated_outliers(2.0 * signal, 2.0)
    assert np.flatnonzero(found.mask).tolist() == [700, 1200]
    assert found.largest == pytest.approx(30.0, abs=4.0)


def test_white_and_coloured_noise_has_no_outliers() -> None:
    for seed in range(100):
        assert not isolated_outliers(white(seed), 1.0).mask.any()
        coloured = lfilter([1.0], [1.0, -0.9], white(seed))
        assert not isolated_outliers(coloured, 0.5).mask.any()


def peaks(decay: float, height: float = 30.0) -> FloatArray:
    """Events every hundred samples that decay."""
    return lfilter([1.0], [1.0, -decay], np.where(STEPS % 100 == 50, height, 0.0))


@pytest.mark.parametrize(
    "structure",
    [
        np.where(STEPS % 100 < 50, 0.0, 100.0),  # jumps
        np.abs(STEPS % 100 - 50.0) * 20.0,  # kinks: impacts, seen in a position
        np.where(STEPS % 10 < 5, 0.0, 100.0),  # a fast square wave
        100.0 * np.sin(2.0 * np.pi * STEPS / 7.0),
        peaks(0.72),  # a stick-slip, seen in a force
        peaks(0.37),
        np.where(STEPS % 100 < 2, 30.0, 0.0),  # two samples wide
        np.cumsum(np.where(STEPS % 100 < 2, np.where(STEPS % 2, -60.0, 100.0), 0.0)),
    ],
)
def test_a_mechanism_is_no_outlier(structure: FloatArray) -> None:
    masked = [isolated_outliers(structure + white(seed), 1.0).mask.sum() for seed in range(10)]
    assert sum(masked) <= 1


def test_louder_noise_here_and_there_is_no_outlier() -> None:
    louder = 1.0 + 4.0 * np.sin(2.0 * np.pi * STEPS / 500.0) ** 2
    assert sum(isolated_outliers(louder * white(s), 1.0).mask.sum() for s in range(20)) <= 2


def test_short_and_silent_records_have_no_outliers() -> None:
    spike = np.r_[np.zeros(5), 100.0, np.zeros(4)]
    assert not isolated_outliers(spike, 1.0).mask.any()
    assert not isolated_outliers(np.zeros(0), 1.0).mask.any()
    longer = np.r_[spike, np.zeros(10)]
    assert np.flatnonzero(isolated_outliers(longer, 1.0).mask).tolist() == [5]
    for unknown in (0.0, np.nan):
        assert not isolated_outliers(longer, unknown).mask.any()


def test_an_outlier_that_is_proven_elsewhere_needs_less() -> None:
    signal = 0.5 * white(9)
    signal[900] += 5.6
    assert not isolated_outliers(signal, 1.0).mask.any()
    assert np.flatnonzero(isolated_outliers(signal, 1.0, proven=True).mask).tolist() == [900]
