"""Bootstrap over experiments, where the answer is known in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student
from support.problems.curves import CurveExecutor, Curves

from cluster_est import LeastSquares, Parameter
from cluster_est.errors import ProblemError
from cluster_est.running.records import Budget
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import UncertaintySettings, assess, bootstrap, check_bootstrap
from cluster_est.uncertainty.bootstrap import percentile_interval
from cluster_est.uncertainty.rows import bootstrap_rows, interval_rows
from cluster_est.uncertainty.spaces import resampled, with_fixed_unknown, with_start

TIMES = np.arange(1.0, 6.0)
METHOD = LeastSquares()
SETTINGS = UncertaintySettings(bootstrap=80)


def level(times, values, experiment):
    return np.full(len(times), values[0])


def levels(count=12, seed=3):
    """The mean of all; an experiment's values differ by little, experiments by much."""
    generator = np.random.default_rng(seed)
    centres = 5.0 + generator.normal(size=count)
    measured = [c + 0.01 * generator.normal(size=len(TIMES)) for c in centres]
    return Curves(level, (Parameter("level", 1.0, -100.0, 100.0),), TIMES, measured)


def run(curves, settings=SETTINGS, seed=0):
    runner, space, solution = curves.solve()
    generator = np.random.default_rng(seed)
    return bootstrap(runner, space, solution, METHOD, settings, generator)


class TestIntervals:
    def test_draws_are_the_means_of_the_drawn_experiments(self):
        curves = levels()
        found = run(curves)
        means = {f"e{e}": each.mean() for e, each in enumerate(curves.measured)}
        assert len(found.draws) == 80
        for draw in found.draws:
            assert len(draw.experiments) == 12
            expected = np.mean([means[name] for name in draw.experiments])
            assert draw.estimates[0] == pytest.approx(expected, rel=1e-7)
        assert any(len(set(draw.experiments)) < 12 for draw in found.draws)

    def test_their_scatter_is_that_of_the_mean_over_experiments(self):
        """Of draws: the standard deviation over n of the experiments' means, divided by sqrt(n)."""
        curves = levels()
        (found,) = run(curves).intervals
        means = [each.mean() for each in curves.measured]
        assert found.std_error == pytest.approx(np.std(means) / np.sqrt(12), rel=0.2)
        assert found.value == pytest.approx(np.mean(means))
        assert (found.used, found.label) == (80, "level")

    def test_it_sees_what_white_noise_does_not(self):
        """Experiments differ by far more than the residuals of a white noise would."""
        _, space, solution = levels().solve()
        (narrow,) = assess(space, solution).intervals
        (wide,) = run(levels()).intervals
        assert wide.std_error > 2.0 * narrow.error_white
        assert narrow.std_error == narrow.error_experiments
        assert wide.std_error == pytest.approx(narrow.std_error, rel=0.2)

    def test_kinds_of_interval(self):
        result = run(levels())
        (found,) = result.intervals
        draws = np.array([draw.estimates[0] for draw in result.draws])
        low, high = np.percentile(draws, [2.5, 97.5])
        assert (found.percentile_lower, found.percentile_upper) == pytest.approx((low, high))
        assert found.basic_lower == pytest.approx(2 * found.value - high)
        assert found.basic_upper == pytest.approx(2 * found.value - low)
        assert found.lower < low < high < found.upper

    @pytest.mark.parametrize("count", [5, 8, 20])
    @pytest.mark.parametrize("confidence", [0.9, 0.95])
    def test_the_wider_interval_is_that_of_students_t(self, count, confidence):
        """Of the mean of normal values: t s / sqrt(n), where draws scatter by less than s."""
        spread = np.sqrt((count - 1) / count) / np.sqrt(count)
        draws = spread * np.random.default_rng(0).normal(size=400_000)
        found = percentile_interval("a", 0.0, draws, count, confidence)
        expected = student.ppf(0.5 + confidence / 2, count - 1) / np.sqrt(count)
        assert found.upper == pytest.approx(expected, rel=0.02)
        assert found.lower == pytest.approx(-expected, rel=0.02)

    def test_of_refits_it_is_as_wide_as_students_t_interval_of_the_mean(self):
        """Percentiles as they are would be 0.69 times as wide."""
        count = 6
        curves = levels(count)
        (found,) = run(curves, replace(SETTINGS, bootstrap=300)).intervals
        means = [each.mean() for each in curves.measured]
        expected = student.ppf(0.975, count - 1) * np.std(means, ddof=1) / np.sqrt(count)
        assert (found.upper - found.lower) / 2.0 == pytest.approx(expected, rel=0.1)
        assert found.upper - found.value == pytest.approx(expected, rel=0.15)

    @pytest.mark.parametrize(("count", "confidence"), [(8, 0.95), (8, 0.9), (15, 0.95)])
    def test_it_holds_the_truth_as_often_as_it_says(self, count, confidence):
        """Of the mean of normal values, 1500 times: the standard error of a share is 0.008 at
        most. Percentiles as they are hold it too rarely, by 0.045 to 0.065."""
        generator = np.random.default_rng(count)
        held, held_plain = 0, 0
        for _ in range(1500):
            values = generator.normal(size=count)
            draws = values[generator.integers(0, count, (400, count))].mean(axis=1)
            found = percentile_interval("a", values.mean(), draws, count, confidence)
            held += found.lower <= 0.0 <= found.upper
            held_plain += found.percentile_lower <= 0.0 <= found.percentile_upper
        assert confidence - 0.025 < held / 1500 < confidence + 0.015
        assert held_plain / 1500 < confidence - 0.035

    def test_the_same_generator_gives_the_same_bits(self):
        assert run(levels()) == run(levels())
        assert run(levels(), seed=1) != run(levels())

    def test_how_many_run_at_once_changes_nothing(self):
        assert run(levels(), replace(SETTINGS, at_once=1)) == run(levels())

    def test_rows(self):
        result = run(levels(), replace(SETTINGS, bootstrap=30))
        rows = bootstrap_rows(result)
        assert len(rows) == 30
        assert rows[3].draw == 3
        assert rows[3].experiments == " ".join(result.draws[3].experiments)
        sources = [row.source for row in interval_rows((), result)]
        assert sources == ["bootstrap", "bootstrap percentile", "bootstrap basic"]


class TestUnknowns:
    def test_only_shared_ones_have_intervals(self):
        def line(times, values, experiment):
            return values[0] * times + values[1] + values[2]

        generator = np.random.default_rng(0)
        measured = [2.0 * TIMES + 1.0 + 0.1 * generator.normal(size=5) for _ in range(6)]
        parameters = (
            Parameter("slope", 1.0),
            Parameter("level", 1.0, per="group:g"),
            Parameter("own", 0.0, fixed=True),
        )
        curves = Curves(line, parameters, TIMES, measured, groups=("a", "a", "b", "b", "b", "c"))
        result = run(curves, replace(SETTINGS, bootstrap=100))
        assert result.labels == ("slope", "level[a]", "level[b]")
        used = {each.label: each.used for each in result.intervals}
        assert used["slope"] == 100
        without_a = sum(not {"e0", "e1"} & set(draw.experiments) for draw in result.draws)
        assert 0 < without_a == 100 - used["level[a]"]

    def test_local_unknowns_are_refitted(self):
        def line(times, values, experiment):
            return values[0] * times + values[1]

        generator = np.random.default_rng(0)
        slopes = 2.0 + 0.1 * generator.normal(size=6)
        measured = [slope * TIMES + 10.0 * e for e, slope in enumerate(slopes)]
        parameters = (Parameter("slope", 1.0), Parameter("level", 1.0, per="experiment"))
        result = run(Curves(line, parameters, TIMES, measured), replace(SETTINGS, bootstrap=50))
        for draw in result.draws:
            mean = np.mean([slopes[int(name[1:])] for name in draw.experiments])
            assert draw.estimates[0] == pytest.approx(mean, rel=1e-8)


class TestFailures:
    def test_a_wall_in_the_way_of_refits_leaves_them_there(self):
        """The start of a refit is the optimum and can be simulated, so such a draw still counts."""
        curves = levels()

        def sometimes(times, values, experiment):
            return np.full(len(times), values[0] if values[0] > 4.9 else np.nan)

        result = run(replace(curves, formula=sometimes, parameters=(Parameter("level", 5.1),)))
        means = {f"e{e}": each.mean() for e, each in enumerate(curves.measured)}
        beyond = [np.mean([means[name] for name in d.experiments]) < 4.89 for d in result.draws]
        stopped = [draw.estimates[0] for draw, low in zip(result.draws, beyond, strict=True) if low]
        assert 0 < len(stopped) < 80
        assert stopped == pytest.approx([4.9] * len(stopped), abs=1e-3)
        assert min(stopped) > 4.9
        assert result.unfinished >= len(stopped)
        assert (result.failures, result.intervals[0].used) == (0, 80)

    def test_a_budget_that_ends_leaves_fewer_draws(self):
        curves = levels()
        _, space, solution = curves.solve()
        runner = Runner(CurveExecutor(curves), Budget(evaluations=150))
        one_by_one = replace(SETTINGS, at_once=1)
        generator = np.random.default_rng(0)
        result = bootstrap(runner, space, solution, METHOD, one_by_one, generator)
        assert 0 < result.intervals[0].used < 80
        assert result.failures == 80 - result.intervals[0].used
        assert result.failures == sum(np.isnan(draw.estimates[0]) for draw in result.draws)

    def test_too_few_usable_draws_give_no_interval(self):
        result = run(levels(), replace(SETTINGS, bootstrap=10))
        assert np.isnan(result.intervals[0].lower)
        assert result.intervals[0].used == 10

    def test_refits_that_stop_early_are_counted(self):
        curves = levels()
        runner, space, solution = curves.solve()
        hasty = LeastSquares(max_iterations=0)
        generator = np.random.default_rng(0)
        result = bootstrap(runner, space, solution, hasty, SETTINGS, generator)
        assert result.unfinished > 60
        assert result.failures == 0

    def test_few_experiments_are_refused(self):
        with pytest.raises(ProblemError, match=r"there are 4; take uncertainty\.profiles"):
            run(levels(count=4))
        check_bootstrap(levels(count=5).space())


class TestSentences:
    def test_draws_that_all_went_well_need_no_word(self):
        assert run(levels()).sentences == ()

    def test_draws_that_failed_or_stopped_early_and_missing_intervals_are_named(self):
        found = replace(run(levels()), failures=62, unfinished=3)
        few = replace(found.intervals[0], used=18)
        failed, early, silent = replace(found, intervals=(few,)).sentences
        assert "62 of 80 draws have no refit" in failed
        assert "the refits of 3 of 80 draws stopped before they converged" in early
        assert "no interval of level, because fewer than 20 draws" in silent


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

    def test_local_unknowns_of_copies_are_one(self):
        def line(times, values, experiment):
            return values[0] * times + values[1]

        measured = [TIMES + e for e in range(3)]
        parameters = (Parameter("slope", 1.0), Parameter("level", 1.0, per="experiment"))
        space = Curves(line, parameters, TIMES, measured).space()
        made = resampled(space, (0, 2, 2), np.array([1.0, 2.0, 3.0, 4.0]))
        assert [u.label for u in made.unknowns] == ["slope", "level[e0]", "level[e2]"]
        assert [u.experiments for u in made.unknowns] == [(0, 1, 2), (0,), (1, 2)]
        np.testing.assert_array_equal(made.start, [1.0, 2.0, 4.0])
        assert made.experiments == (0, 2, 2)

    def test_a_moved_space_keeps_its_units(self):
        space = levels().space()
        there = with_start(space, np.array([1e-9]))
        assert there.start[0] == 1e-9
        assert there.typical[0] == space.typical[0] == 1.0
        assert with_start(space, np.array([1e9])).start[0] == 100.0

    def test_a_space_without_an_unknown_simulates_its_value(self):
        def line(times, values, experiment):
            return values[0] * times + values[1]

        measured = [TIMES + e for e in range(3)]
        parameters = (
            Parameter("slope", 1.0, 0.1, 10.0, scale="log"),
            Parameter("level", 1.0, per="experiment"),
        )
        space = Curves(line, parameters, TIMES, measured).space()
        x = np.array([0.3, 2.0, 3.0, 4.0])
        for i in range(4):
            made = with_fixed_unknown(space, i, x)
            assert made.size == 3
            assert made.physical(made.start).tobytes() == space.physical(x).tobytes()
