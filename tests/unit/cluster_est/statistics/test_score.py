import numpy as np
import pytest
from scipy.special import erfcx, gamma
from scipy.stats import beta, chi2, kstest

from cluster_est.statistics.projection import OrthogonalProjection
from cluster_est.statistics.score import ScoreTests, family_wise, log_survival, score
from workers.messages import FloatArray

N = 300
PARAMETERS = 5


def sensitivities(generator: np.random.Generator) -> FloatArray:
    return generator.standard_normal((N, PARAMETERS)).cumsum(axis=0)


def smooth_candidates(generator: np.random.Generator, count: int) -> list[FloatArray]:
    """Random walks, of which every third has two columns; neighbours are strongly correlated."""
    walks = generator.standard_normal((N, count + 1)).cumsum(axis=0)
    walks[:, 1:] += 2.0 * walks[:, :-1]
    return [walks[:, k : k + 1 + (k % 3 == 0)] for k in range(count)]


def test_statistics_of_noise_are_chi_squared() -> None:
    generator = np.random.default_rng(10)
    projection = OrthogonalProjection(sensitivities(generator))
    columns = [generator.standard_normal((N, d)) for d in (1, 3)]
    drawn = [score(projection, generator.standard_normal(N), columns) for _ in range(400)]
    statistics = np.array([scores.statistics for scores in drawn])
    for k, df in enumerate((1, 3)):
        assert kstest(statistics[:, k], chi2(df).cdf).pvalue > 0.01
        # R2 of a normal residual has a beta distribution, exactly
        explained = np.array([scores.explained[k] for scores in drawn])
        exact = beta(df / 2.0, (N - PARAMETERS - df) / 2.0)
        assert kstest(explained, exact.cdf).pvalue > 0.01


def test_explained_is_what_a_joint_linear_fit_gains() -> None:
    generator = np.random.default_rng(11)
    matrix = sensitivities(generator)
    residuals = generator.standard_normal(N).cumsum()
    columns = smooth_candidates(generator, 7)
    scores = score(OrthogonalProjection(matrix), residuals, columns)

    def squares(regressors: FloatArray) -> float:
        fit = np.linalg.lstsq(regressors, residuals, rcond=None)[0]
        return float(((residuals - regressors @ fit) ** 2).sum())

    before = squares(matrix)
    for k, column in enumerate(columns):
        gain = 1.0 - squares(np.column_stack([matrix, column])) / before
        assert scores.explained[k] == pytest.approx(gain, rel=1e-8)
    assert scores.df.tolist() == [column.shape[1] for column in columns]
    assert scores.variance == pytest.approx(before / (N - PARAMETERS))


def assert_same(left: ScoreTests, right: ScoreTests) -> None:
    for name in ("statistics", "ratio", "log_p", "explained"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), rtol=1e-7)
    assert left.df.tolist() == right.df.tolist()


def test_scales_and_order_do_not_matter() -> None:
    generator = np.random.default_rng(13)
    projection = OrthogonalProjection(sensitivities(generator))
    residuals = generator.standard_normal(N).cumsum()
    columns = smooth_candidates(generator, 12)
    scores = score(projection, residuals, columns)
    assert_same(scores, score(projection, -1e7 * residuals, columns))
    assert_same(scores, score(projection, residuals, [1e-9 * column for column in columns]))
    order = generator.permutation(12)
    moved = score(projection, residuals, [columns[k] for k in order])
    back = np.argsort(order)
    np.testing.assert_allclose(moved.statistics[back], scores.statistics, rtol=1e-7)
    # more candidates leave each one's own test as it is
    np.testing.assert_allclose(
        score(projection, residuals, columns[:4]).log_p, scores.log_p[:4], rtol=1e-7
    )


def test_what_is_confounded_with_parameters_is_set_aside() -> None:
    generator = np.random.default_rng(14)
    matrix = sensitivities(generator)
    projection = OrthogonalProjection(matrix)
    confounded = matrix @ np.ones((PARAMETERS, 1))
    other = projection.remove(generator.standard_normal((N, 1)))
    other *= np.linalg.norm(confounded) / np.linalg.norm(other)
    # hardly outside the parameters, and orthogonal to `other`
    third = OrthogonalProjection(np.hstack([matrix, other])).remove(
        generator.standard_normal((N, 1))
    )
    hidden = confounded + 0.001 * np.linalg.norm(confounded) / np.linalg.norm(third) * third
    columns = [
        confounded,
        confounded + 0.003 * other,
        confounded + 0.01 * other,
        np.zeros((N, 1)),
        np.hstack([confounded, other]),
        np.hstack([other, 2.0 * other, np.zeros((N, 1))]),
        np.hstack([confounded, confounded]),
        np.hstack([hidden + other, hidden - other]),
    ]
    scores = score(projection, generator.standard_normal(N), columns)
    assert scores.df.tolist() == [0, 0, 1, 0, 1, 1, 0, 1]
    assert scores.p_values[[0, 1, 3, 6]].tolist() == [1.0] * 4
    assert scores.ratio[1:3] == pytest.approx([0.003, 0.01], rel=1e-3)
    np.testing.assert_allclose(scores.statistics[[4, 5, 7]], scores.statistics[2], rtol=1e-6)


@pytest.mark.parametrize("df", [1, 2, 3, 8, 25])
def test_log_survival_agrees_with_scipy_and_with_the_finite_sum(df: int) -> None:
    near = np.linspace(0.0, 900.0, 50)
    expected = np.log(chi2.sf(near, df))
    np.testing.assert_allclose(log_survival(near, np.array(df)), expected, rtol=1e-10, atol=1e-14)
    # Q(a + 1, x) = Q(a, x) + x^a e^-x / Gamma(a + 1), from Q(1/2, x) = erfc(sqrt(x)) or Q(0, x) = 0
    far = np.array([1000.0, 1300.0, 1500.0, 4000.0, 1e6])
    half = far / 2.0
    first = df % 2 / 2.0
    scaled = erfcx(np.sqrt(half)) if df % 2 else np.zeros(5)
    for a in np.arange(first, df / 2.0):
        scaled = scaled + half**a / gamma(a + 1.0)
    np.testing.assert_allclose(
        log_survival(far, np.array(df)), np.log(scaled) - half, rtol=0.0, atol=1e-9
    )


def test_family_wise_p_is_uniform_under_the_null() -> None:
    generator = np.random.default_rng(16)
    projection = OrthogonalProjection(sensitivities(generator))
    columns = smooth_candidates(generator, 60)
    p = np.array(
        [
            family_wise(score(projection, generator.standard_normal(N), columns), generator, 400)
            for _ in range(200)
        ]
    )
    assert kstest(p, "uniform").pvalue > 0.01
    assert 0.02 <= float((p < 0.05).mean()) <= 0.09


def test_equal_candidates_count_once_and_different_ones_each() -> None:
    generator = np.random.default_rng(17)
    projection = OrthogonalProjection(np.zeros((2000, 0)))
    residuals = generator.standard_normal(2000)
    basis = np.linalg.qr(generator.standard_normal((2000, 20)))[0]
    different = score(projection, residuals, [basis[:, k : k + 1] for k in range(20)])
    # of independent candidates that of the best of them, by Sidak's 1 - (1 - p)^m
    expected = 1.0 - (1.0 - float(different.p_values.min())) ** 20
    assert family_wise(different, generator, 20000) == pytest.approx(expected, abs=0.02)
    same = score(projection, residuals, [basis[:, :1]] * 20)
    alone = float(same.p_values[0])
    assert family_wise(same, generator, 20000) == pytest.approx(alone, abs=0.02)
    # of two that are nearly the same there is hardly more to choose from than of one
    near = basis[:, :1] + 1e-6 * basis[:, 1:2]
    both = score(projection, residuals, [basis[:, :1], near])
    assert family_wise(both, generator, 20000) == pytest.approx(alone, abs=0.02)


def test_strong_evidence_needs_no_draws() -> None:
    generator = np.random.default_rng(20)
    projection = OrthogonalProjection(np.zeros((N, 0)))
    columns = smooth_candidates(generator, 5)
    scores = score(projection, columns[2][:, 0] + 1e-3 * generator.standard_normal(N), columns)
    before = generator.bit_generator.state
    assert family_wise(scores, generator) == 5 * scores.p_values.min() < 1e-20
    assert generator.bit_generator.state == before


def test_few_degrees_of_freedom_are_exact() -> None:
    # the candidates span all that the projection leaves: T is at most the degrees of freedom
    generator = np.random.default_rng(18)
    projection = OrthogonalProjection(generator.standard_normal((8, 3)))
    columns = [generator.standard_normal((8, 1)) for _ in range(6)]
    p = [
        family_wise(score(projection, generator.standard_normal(8), columns), generator, 300)
        for _ in range(200)
    ]
    assert kstest(p, "uniform").pvalue > 0.01


def test_nothing_to_test() -> None:
    generator = np.random.default_rng(19)
    matrix = sensitivities(generator)
    projection = OrthogonalProjection(matrix)
    residuals = generator.standard_normal(N)
    assert family_wise(score(projection, residuals, []), generator) == 1.0
    assert family_wise(score(projection, residuals, [matrix[:, :1]]), generator) == 1.0
    columns = smooth_candidates(generator, 3)
    for vanished in (np.zeros(N), matrix @ np.ones(PARAMETERS)):
        scores = score(projection, vanished, columns)
        assert scores.statistics.tolist() == [0.0] * 3
        assert family_wise(scores, generator) == 1.0


@pytest.mark.parametrize("far", [1e200, np.inf, np.nan])
def test_a_direction_that_runs_away_counts_for_nothing(far: float) -> None:
    generator = np.random.default_rng(12)
    matrix, residuals = sensitivities(generator), generator.standard_normal(N)
    column = generator.standard_normal((N, 1))
    wild = column.copy()
    wild[-1] = far
    scores = score(OrthogonalProjection(matrix), residuals, [column, wild])
    assert scores.df.tolist() == [1, 0]
    assert scores.ratio[1] == 0.0


@pytest.mark.parametrize("scale", [np.ones(4), np.array([1e-12, 1.0, -1e9, 3.0])])
def test_a_projection_leaves_the_residual_of_least_squares(scale: FloatArray) -> None:
    """Also where a column is the sum of others, or nothing at all."""
    generator = np.random.default_rng(4)
    matrix, signals = (generator.standard_normal((60, n)) for n in (4, 7))
    expected = signals - matrix @ np.linalg.lstsq(matrix, signals, rcond=None)[0]
    scaled = matrix * scale
    for columns in (scaled, np.column_stack([scaled, scaled @ (1.0 / scale), np.zeros(60)])):
        projection = OrthogonalProjection(columns)
        assert (projection.rank, projection.degrees) == (4, 56)
        np.testing.assert_allclose(projection.remove(signals), expected, atol=1e-12)
        np.testing.assert_allclose(projection.remove(signals[:, 2]), expected[:, 2], atol=1e-12)
    nothing = OrthogonalProjection(np.zeros((60, 2)))
    assert (nothing.rank, nothing.degrees) == (0, 60)
    assert nothing.remove(signals).tolist() == signals.tolist()


def test_tests_of_two_parts_are_those_of_the_whole():
    random = np.random.default_rng(4)
    projection = OrthogonalProjection(random.normal(size=(60, 2)))
    residuals = random.normal(size=60)
    columns = [random.normal(size=(60, width)) for width in (1, 3, 1, 2)]
    whole = score(projection, residuals, columns)
    joined = score(projection, residuals, columns[:2]).with_more(
        score(projection, residuals, columns[2:])
    )
    for name in ("statistics", "df", "ratio", "log_p", "explained", "offsets", "coordinates"):
        np.testing.assert_allclose(getattr(joined, name), getattr(whole, name), rtol=1e-9)
    part = joined.first(2)
    assert part.bases.shape == (60, 4)
    np.testing.assert_array_equal(part.statistics, joined.statistics[:2])
