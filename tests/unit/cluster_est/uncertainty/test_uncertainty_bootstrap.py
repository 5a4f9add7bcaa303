from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student
from support.problems.curves import CurveExecutor, Curves

from cluster_est import Budget, LeastSquares, Parameter
from cluster_est.errors import ProblemError
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import UncertaintySettings, assess, bootstrap, check_bootstrap
from cluster_est.uncertainty.bootstrap import percentile_interval
from cluster_est.uncertainty.spaces import resampled, with_start

TIMES = np.arange(1.0, 6.0)
METHOD = LeastSquares()
SETTINGS = UncertaintySettings(bootstrap=80)


def level(times, values, experiment):
    return np.full(len(times), values[0])


def line(times, values, experiment):
    """A slope, and the sum of all levels."""
    return values[0] * times + sum(values[1:])


def levels(count=12, seed=3):
    """The mean of all; an experiment's values differ by little, experiments by much."""
    generator = np.random.default_rng(seed)
    centres = 5.0 + generator.normal(size=count)
    measured = [c + 0.01 * generator.normal(size=len(TIMES)) for c in centres]
    return Curves(level, (Parameter("level", 1.0, (-100.0, 100.0)),), TIMES, measured)


def lines(slopes):
    """A slope of all, and a level of each experiment."""
    measured = [slope * TIMES + 10.0 * e for e, slope in enumerate(slopes)]
    parameters = (
        Parameter("slope", 1.0, (0.1, 10.0), scale="log"),
        Parameter("level", 1.0, per="experiment"),
    )
    return Curves(line, parameters, TIMES, measured)


def run(curves, settings=SETTINGS, seed=0, method=METHOD, runner=None):
    own, space, solution = curves.solve()
    generator = np.random.default_rng(seed)
    return bootstrap(runner or own, space, solution, method, settings, generator)


def drawn_means(curves, draws):
    """The mean of what was measured in the experiments of each draw."""
    means = {f"e{e}": each.mean() for e, each in enumerate(curves.measured)}
    return np.array([np.mean([means[name] for name in draw.experiments]) for draw in draws])


@pytest.fixture(scope="module")
def found():
    return run(levels())


class TestIntervals:
    def test_draws_are_the_means_of_the_drawn_experiments(self, found):
        assert len(found.draws) == 80
        assert {len(draw.experiments) for draw in found.draws} == {12}
        estimates = [draw.estimates[0] for draw in found.draws]
        np.testing.assert_allclose(estimates, drawn_means(levels(), found.draws), rtol=1e-7)
        assert any(len(set(draw.experiments)) < 12 for draw in found.draws)
        assert found.sentences == ()

    def test_their_scatter_is_that_of_the_mean_over_experiments(self, found):
        """Of draws: the standard deviation over n of the experiments' means, divided by sqrt(n).

        White noise in each experiment would scatter by far less.
        """
        (interval,) = found.intervals
        means = [each.mean() for each in levels().measured]
        assert interval.std_error == pytest.approx(np.std(means) / np.sqrt(12), rel=0.2)
        assert interval.value == pytest.approx(np.mean(means))
        assert (interval.used, interval.label) == (80, "level")
        (narrow,) = assess(*levels().solve()[1:]).intervals
        assert interval.std_error > 2.0 * narrow.error_white
        assert narrow.std_error == narrow.error_experiments
        assert interval.std_error == pytest.approx(narrow.std_error, rel=0.2)

    def test_kinds_of_interval(self, found):
        (interval,) = found.intervals
        draws = np.array([draw.estimates[0] for draw in found.draws])
        low, high = np.percentile(draws, [2.5, 97.5])
        percentiles = interval.percentile_lower, interval.percentile_upper
        assert percentiles == pytest.approx((low, high))
        assert interval.basic_lower == pytest.approx(2 * interval.value - high)
        assert interval.basic_upper == pytest.approx(2 * interval.value - low)
        assert interval.lower < low < high < interval.upper

    @pytest.mark.parametrize("count", [5, 8, 20])
    @pytest.mark.parametrize("confidence", [0.9, 0.95])
    def test_the_wider_interval_is_that_of_students_t(self, count, confidence):
        """Of the mean of normal values: t s / sqrt(n), where draws scatter by less than s."""
        spread = np.sqrt((count - 1) / count) / np.sqrt(count)
        draws = spread * np.random.default_rng(0).normal(size=400_000)
        wide = percentile_interval("a", 0.0, draws, count, confidence)
        expected = student.ppf(0.5 + confidence / 2, count - 1) / np.sqrt(count)
        assert (wide.lower, wide.upper) == pytest.approx((-expected, expected), rel=0.02)

    def test_the_seed_alone_decides_and_not_how_many_run_at_once(self, found):
        assert run(levels(), SETTINGS.changed(at_once=1)) == found
        other = run(levels(), SETTINGS.changed(bootstrap=20), seed=1)
        assert other.draws != found.draws[:20]


class TestUnknowns:
    def test_only_shared_ones_have_intervals(self):
        generator = np.random.default_rng(0)
        measured = [2.0 * TIMES + 1.0 + 0.1 * generator.normal(size=5) for _ in range(6)]
        parameters = (
            Parameter("slope", 1.0),
            Parameter("level", 1.0, per="group:g"),
            Parameter("own", 0.0, fixed=True),
        )
        curves = Curves(line, parameters, TIMES, measured, groups=("a", "a", "b", "b", "b", "c"))
        result = run(curves, SETTINGS.changed(bootstrap=100))
        assert result.labels == ("slope", "level[a]", "level[b]")
        used = {each.label: each.used for each in result.intervals}
        assert used["slope"] == 100
        without_a = sum(not {"e0", "e1"} & set(draw.experiments) for draw in result.draws)
        assert 0 < without_a == 100 - used["level[a]"]

    def test_local_unknowns_are_refitted(self):
        slopes = 2.0 + 0.1 * np.random.default_rng(0).normal(size=6)
        for draw in run(lines(slopes), SETTINGS.changed(bootstrap=50)).draws:
            mean = np.mean([slopes[int(name[1:])] for name in draw.experiments])
            assert draw.estimates[0] == pytest.approx(mean, rel=1e-8)


class TestFailures:
    def test_a_wall_in_the_way_of_refits_leaves_them_there(self):
        """The start of a refit is the optimum and can be simulated, so such a draw still counts."""
        curves, settings = levels(6), SETTINGS.changed(bootstrap=40)

        def sometimes(times, values, experiment):
            return np.full(len(times), values[0] if values[0] > 4.9 else np.nan)

        walled = replace(curves, formula=sometimes, parameters=(Parameter("level", 5.1),))
        result = run(walled, settings)
        beyond = drawn_means(curves, result.draws) < 4.89
        stopped = np.array([draw.estimates[0] for draw in result.draws])[beyond]
        assert 0 < len(stopped) < 40
        assert stopped == pytest.approx(np.full(len(stopped), 4.9), abs=1e-3)
        assert min(stopped) > 4.9
        assert result.unfinished >= len(stopped)
        assert (result.failures, result.intervals[0].used) == (0, 40)

    def test_a_budget_that_ends_leaves_fewer_draws_and_says_so(self):
        runner = Runner(CurveExecutor(levels()), Budget(evaluations=60))
        result = run(levels(), SETTINGS.changed(at_once=1), runner=runner)
        used = result.intervals[0].used
        assert 0 < used < 80
        assert result.failures == 80 - used
        assert result.failures == sum(np.isnan(draw.estimates[0]) for draw in result.draws)
        assert f"{80 - used} of 80 draws are not used" in result.sentences[0]

    def test_too_few_usable_draws_give_no_interval(self):
        result = run(levels(), SETTINGS.changed(bootstrap=10))
        assert np.isnan(result.intervals[0].lower)
        assert result.intervals[0].used == 10
        assert "no interval for level, because fewer than 20 draws" in result.sentences[0]

    def test_refits_that_stop_early_are_counted(self):
        result = run(levels(), method=LeastSquares(max_iterations=0))
        assert result.unfinished > 60
        assert result.failures == 0
        assert f"refits of {result.unfinished} of 80 draws stopped" in result.sentences[0]

    def test_few_experiments_are_refused(self):
        with pytest.raises(
            ProblemError, match=r"at least 5 .* but has 4; use uncertainty\.profiles"
        ):
            run(levels(count=4))
        check_bootstrap(levels(count=5).space())


class TestSpaces:
    def test_copies_are_counted_each_and_simulated_once(self):
        curves = levels(count=3)
        executor = CurveExecutor(curves)
        space = resampled(curves.space(), (0, 0, 2), np.array([4.0]))
        runner = Runner(executor)
        (solution,) = runner.run([SearchRequest("copies", METHOD, space)])
        a, _, c = (each.mean() for each in curves.measured)
        assert solution.x[0] == pytest.approx((2 * a + c) / 3)
        assert len(solution.at.residuals) == 15
        assert executor.answered == 2 * runner.evaluations

    def test_a_moved_space_keeps_its_units(self):
        space = levels().space()
        there = with_start(space, np.array([1e-9]))
        assert there.start[0] == 1e-9
        assert there.typical[0] == space.typical[0] == 1.0
        assert with_start(space, np.array([1e9])).start[0] == 100.0
