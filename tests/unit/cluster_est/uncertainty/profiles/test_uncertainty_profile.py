"""Profiles against exact intervals and against refits by SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares
from scipy.stats import f as fisher
from support.problems.curves import CurveExecutor, Curves

from cluster_est import LeastSquares, Parameter
from cluster_est.costs.likelihood import GaussianLikelihood
from cluster_est.costs.sum_absolute import SumAbsolute
from cluster_est.errors import ProblemError
from cluster_est.methods.base import Ending, Points, Solution
from cluster_est.running.records import Budget
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import UncertaintySettings, assess, check_profiles, profiles, select
from cluster_est.uncertainty.profiles.continuation import ProfileContinuation
from cluster_est.uncertainty.profiles.profile_steps import ProfileTarget
from cluster_est.uncertainty.rows import interval_rows, profile_rows

TIMES = np.linspace(0.0, 3.0, 20)
METHOD = LeastSquares()


def line(times, values, experiment):
    slope, level, shift = values
    return slope * times + level * np.cos(times) + shift * (1.0 + experiment)


def lines(**options):
    generator = np.random.default_rng(2)
    measured = [
        line(TIMES, (1.5, 0.7, 0.2 * e), e) + 0.1 * generator.normal(size=20) for e in range(3)
    ]
    parameters = (
        Parameter("slope", 1.0),
        Parameter("level", 1.0),
        Parameter("shift", 0.1, per="experiment"),
    )
    return Curves(line, parameters, TIMES, measured, **options)


# treated with Puromycin: D. M. Bates, D. G. Watts, Nonlinear Regression Analysis (1988), A1.3
CONCENTRATION = np.array([0.02, 0.02, 0.06, 0.06, 0.11, 0.11, 0.22, 0.22, 0.56, 0.56, 1.10, 1.10])
VELOCITY = np.array([76, 47, 97, 107, 123, 139, 159, 152, 191, 201, 207, 200], float)


def michaelis_menten(times, values, experiment):
    return values[0] * CONCENTRATION / (values[1] + CONCENTRATION)


def puromycin(**bounds):
    parameters = (
        Parameter("velocity", 200.0, 0.0, 1000.0),
        Parameter("affinity", 0.075, bounds.get("lower", 0.0), bounds.get("upper", 10.0)),
    )
    times = np.arange(1.0, 13.0)
    return Curves(michaelis_menten, parameters, times, [VELOCITY])


def scipy_profile(formula, y, start, i, side, confidence=0.95):
    """The end of a profile-likelihood interval by SciPy alone."""
    fit = least_squares(lambda p: y - formula(p), start, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    n, k = len(y), len(start)
    limit = 2 * fit.cost * (1 + fisher.ppf(confidence, 1, n - k) / (n - k))

    def excess(value):
        def rest(p):
            return y - formula(np.insert(p, i, value))

        others = np.delete(fit.x, i)
        again = least_squares(rest, others, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
        return 2 * again.cost - limit

    reach = fit.x[i]
    while excess(reach) < 0.0:
        reach += side * 0.1 * abs(fit.x[i])
    return brentq(excess, fit.x[i], reach, rtol=1e-10)


class TestEnds:
    def test_of_a_linear_model_are_those_of_students_t(self):
        runner, space, solution = lines().solve()
        expected = assess(space, solution).intervals
        found = profiles(runner, space, solution, METHOD, UncertaintySettings(("all",)))
        assert [p.label for p in found] == [u.label for u in space.unknowns]
        for profile, interval in zip(found, expected, strict=True):
            width = interval.upper95 - interval.lower95
            assert profile.lower == pytest.approx(interval.lower95, abs=1e-4 * width)
            assert profile.upper == pytest.approx(interval.upper95, abs=1e-4 * width)
            assert profile.sentences == ()

    @pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
    def test_of_michaelis_menten_are_those_that_scipy_finds(self, confidence):
        runner, space, solution = puromycin().solve()
        settings = UncertaintySettings(("all",), confidence=confidence)
        found = profiles(runner, space, solution, METHOD, settings)
        for i, profile in enumerate(found):
            for side, end in ((-1, profile.lower), (1, profile.upper)):
                expected = scipy_profile(
                    lambda p: michaelis_menten(None, p, 0),
                    VELOCITY,
                    solution.x,
                    i,
                    side,
                    confidence,
                )
                assert end == pytest.approx(expected, abs=1e-3 * abs(expected - profile.value))

    def test_are_not_symmetric_where_the_model_bends(self):
        runner, space, solution = puromycin().solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("affinity",)))
        assert found.upper - found.value > 1.1 * (found.value - found.lower)

    def test_of_a_likelihood_are_those_of_its_ratio(self):
        """Of one output n ln(S / S0) <= 3.84, but for terms of the order of 1 / n."""
        curves = lines(cost=GaussianLikelihood())
        _, space, solution = lines().solve()
        runner = curves.runner()
        at = runner.run([SearchRequest("at", LeastSquares(max_iterations=0), curves.space())])[0]
        likely = replace(solution, cost=60.0 * np.log(solution.cost / 60.0), at=None)
        assert np.isfinite(at.cost)
        settings = UncertaintySettings(("slope",))
        (found,) = profiles(runner, curves.space(), likely, METHOD, settings)
        (usual,) = profiles(lines().runner(), space, solution, METHOD, settings)
        assert found.rise == pytest.approx(3.84, rel=0.15)
        assert found.upper - found.lower == pytest.approx(usual.upper - usual.lower, rel=0.05)

    def test_of_a_profile_with_its_own_rise(self):
        runner, space, solution = lines().solve()
        once, twice = (
            profiles(runner, space, solution, METHOD, UncertaintySettings(("slope",), rise=rise))[0]
            for rise in (0.1, 0.4)
        )
        assert twice.upper - twice.value == pytest.approx(2.0 * (once.upper - once.value), rel=1e-3)

    def test_do_not_depend_on_the_units(self):
        def scaled(times, values, experiment):
            return 1e3 * michaelis_menten(times, (values[0], values[1] * 1e-6), experiment)

        plain = puromycin()
        other = replace(
            plain,
            formula=scaled,
            measured=[1e3 * VELOCITY],
            parameters=(plain.parameters[0], Parameter("affinity", 1e5, 0.0, 1e7)),
        )
        ends = []
        for curves, unit in ((plain, 1.0), (other, 1e6)):
            runner, space, solution = curves.solve()
            (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("affinity",)))
            ends.append((found.lower / unit, found.upper / unit))
        np.testing.assert_allclose(ends[0], ends[1], rtol=1e-4)

    def test_on_a_log_scale_are_the_same(self):
        plain = puromycin()
        log = (plain.parameters[0], Parameter("affinity", 0.1, 1e-6, 10.0, scale="log"))
        ends = []
        for curves in (plain, replace(plain, parameters=log)):
            runner, space, solution = curves.solve()
            (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("affinity",)))
            ends.append((found.lower, found.upper))
        np.testing.assert_allclose(ends[0], ends[1], rtol=2e-4)

    def test_of_the_only_unknown(self):
        def proportional(times, values, experiment):
            return values[0] * times

        measured = [2.0 * TIMES + 0.1 * np.sin(50.0 * TIMES)]
        curves = Curves(proportional, (Parameter("slope", 1.0),), TIMES, measured)
        runner, space, solution = curves.solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("all",)))
        (interval,) = assess(space, solution).intervals
        width = interval.upper95 - interval.lower95
        assert found.lower == pytest.approx(interval.lower95, abs=1e-4 * width)
        assert found.upper == pytest.approx(interval.upper95, abs=1e-4 * width)


class TestOpen:
    def test_at_a_bound(self):
        runner, space, solution = puromycin(upper=0.08).solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("affinity",)))
        assert (found.open_lower, found.open_upper) == ("", "bound")
        assert found.upper == np.inf
        assert found.points[-1].value == 0.08
        assert found.sentences == (
            "affinity has no upper limit: its profile reaches the bound 0.08 first",
        )

    def test_an_optimum_at_a_bound(self):
        runner, space, solution = puromycin(lower=0.07).solve()
        assert solution.x[1] == 0.07
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("affinity",)))
        assert found.open_lower == "bound"
        assert found.upper > 0.07
        assert found.open_upper == ""

    def test_what_the_data_do_not_determine_is_flat(self):
        def product(times, values, experiment):
            return values[0] * values[1] * np.exp(-times)

        measured = [product(TIMES, (2.0, 3.0), 0) + 0.01 * np.cos(40.0 * TIMES)]
        parameters = (Parameter("a", 1.5, 0.1), Parameter("b", 2.5, 0.0))
        runner, space, solution = Curves(product, parameters, TIMES, measured).solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("a",)))
        assert found.open_upper == "flat"
        assert found.upper == np.inf
        assert found.points[-1].value > 1e3
        assert "does not rise enough" in found.sentences[-1]
        assert found.open_lower == "bound"

    def test_open_on_one_side_only(self):
        """The data say that the rate is fast, but not how fast."""

        def saturating(times, values, experiment):
            return 1.0 - np.exp(-values[0] * (times + 0.5)) + 0.0 * times

        generator = np.random.default_rng(0)
        measured = [1.0 + 0.05 * generator.normal(size=len(TIMES))]
        parameters = (Parameter("rate", 5.0, 0.01, 1e9, scale="log"),)
        runner, space, solution = Curves(saturating, parameters, TIMES, measured).solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("rate",)))
        assert (found.open_lower, found.open_upper) == ("", "bound")
        assert 1.0 < found.lower < 20.0

    def test_where_simulations_fail(self):
        def walled(times, values, experiment):
            if values[0] > 216.0:
                return np.full(12, np.nan)
            return michaelis_menten(times, values, experiment)

        curves = replace(puromycin(), formula=walled)
        runner, space, solution = curves.solve()
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("velocity",)))
        assert found.open_upper == "failed"
        assert np.isnan(found.upper)
        assert 213.0 < found.points[-1].value <= 216.0
        assert "refits" in found.sentences[0]
        assert found.open_lower == ""

    @pytest.mark.parametrize("count", [3, 2])
    def test_where_the_residuals_do_not_say_how_far_the_cost_may_rise(self, count):
        """None of them, or as many as unknowns, must not undo a fit that is done."""
        curves = lines()
        short = replace(
            curves,
            formula=lambda times, values, experiment: line(times, (*values, 0.0), 0),
            parameters=curves.parameters[:2],
            times=TIMES[1 : count + 1],
            measured=[line(TIMES[1 : count + 1], (1.0, 1.0, 0.0), 0)],
        )
        runner, space, solution = short.solve()
        solution = replace(solution, x=np.ones(2), at=None, jacobian=None, cost=1.0)
        found = profiles(runner, space, solution, METHOD, UncertaintySettings(("all",)))
        assert [p.open_lower for p in found] == ["unknown", "unknown"]
        assert np.isnan([p.upper for p in found]).all()
        assert "uncertainty.rise" in found[0].sentences[0]
        (row, _) = interval_rows(found, None)
        assert row.open_upper == "unknown"

    def test_when_the_budget_ends(self):
        curves = puromycin()
        _, space, solution = curves.solve()
        runner = Runner(CurveExecutor(curves), Budget(evaluations=5))
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("velocity",)))
        assert found.open_lower == found.open_upper == "failed"


class TestPoints:
    def found(self):
        runner, space, solution = puromycin().solve()
        settings = UncertaintySettings(("affinity",), steps=6)
        return profiles(runner, space, solution, METHOD, settings)[0]

    def test_go_from_one_end_to_the_other_through_the_optimum(self):
        found = self.found()
        values = [p.value for p in found.points]
        assert values == sorted(values)
        assert sum(p.root == 0.0 for p in found.points) == 1
        roots = np.array([p.root for p in found.points])
        assert (np.diff(roots) > 0.0).all()
        assert roots[0] <= -0.999
        assert roots[-1] >= 0.999
        assert (np.abs(roots) <= 1.5).all()
        assert 6 <= (roots > 0).sum() <= 10

    def test_are_minima_of_the_others(self):
        found = self.found()
        for point in found.points:
            # linear in the velocity: its minimum is known
            column = CONCENTRATION / (point.value + CONCENTRATION)
            best = column @ VELOCITY / (column @ column)
            assert point.estimates[0] == pytest.approx(best, rel=1e-7)
            residuals = VELOCITY - best * column
            assert point.cost == pytest.approx(residuals @ residuals, rel=1e-9)
            assert point.estimates[1] == point.value

    def test_rows(self):
        found = self.found()
        rows = profile_rows([found])
        assert len(rows) == 2 * len(found.points)
        own = [row for row in rows if row.unknown == "affinity"]
        assert all(row.value == row.estimate for row in own)
        (row,) = interval_rows([found], None)
        assert (row.lower, row.upper, row.source) == (found.lower, found.upper, "profile")


def test_a_better_minimum_is_reported():
    def twofold(times, values, experiment):
        """Minima with a near -0.85 and, of cost 0, with a = b = 1."""
        a, b = values
        return np.array([a**2 - 1.0, 0.5 * (a - 1.0), 2.0 * (b - a)])

    parameters = (Parameter("a", -1.0, -3.0, 3.0), Parameter("b", -1.0, -3.0, 3.0))
    curves = Curves(twofold, parameters, np.arange(1.0, 4.0), [np.zeros(3)])
    runner, space, solution = curves.solve()
    assert solution.cost == pytest.approx(0.93, abs=0.01)
    settings = UncertaintySettings(("b",), rise=20.0, steps=8)
    (found,) = profiles(runner, space, solution, METHOD, settings)
    assert found.better is not None
    estimates, cost = found.better
    assert estimates["a"] == pytest.approx(1.0, abs=0.4)
    assert cost < 0.5
    assert "better minimum" in found.sentences[-1]


def test_a_profile_with_a_kink_is_closed_in_on():
    """b makes up for a until it meets its bound; from there on the cost rises steeply."""

    def kinked(times, values, experiment):
        return 100.0 * (values[0] - values[1]) + times

    parameters = (Parameter("a", 1.0, 0.0, 100.0), Parameter("b", 1.0, 0.0, 5.0))
    measured = [TIMES + 0.1 * np.sin(50.0 * TIMES)]
    runner, space, solution = Curves(kinked, parameters, TIMES, measured).solve()
    (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("a",)))
    # beyond it one unknown is left: the rise is 20 (100 d)^2
    shift = float(np.mean(0.1 * np.sin(50.0 * TIMES)))
    expected = 5.0 + (np.sqrt(found.rise / 20.0) + shift) / 100.0
    assert found.upper == pytest.approx(expected, abs=1e-5)
    assert found.open_lower == "bound"


def test_all_sides_run_at_the_same_time_and_in_any_order():
    runner, space, solution = lines().solve()
    settings = UncertaintySettings(("all",))
    alone = profiles(runner, space, solution, METHOD, replace(settings, at_once=1))
    together = profiles(lines().runner(), space, solution, METHOD, settings)
    assert alone == together


def test_an_inner_method_may_be_asynchronous():
    """Indices and dropped points are those of the inner search, whatever was asked before it."""

    class Impatient(LeastSquares):
        def search(self, space, generator):
            search = super().search(space, generator)
            points = next(search)
            asked = 0
            while True:
                sent = replace(points, asynchronous=True)
                answers = {}
                answers |= {e.index: e for e in (yield sent)}
                while len(answers) < len(points.x):
                    none = replace(points, x=points.x[:0], asynchronous=True)
                    answers |= {e.index: e for e in (yield none)}
                wanted = [answers[asked + j] for j in range(len(points.x))]
                asked += len(points.x)
                try:
                    points = search.send(wanted)
                except StopIteration as end:
                    return end.value

    runner, space, solution = lines().solve()
    settings = UncertaintySettings(("slope", "level"))
    usual = profiles(runner, space, solution, METHOD, settings)
    assert profiles(lines().runner(), space, solution, Impatient(), settings) == usual


def test_what_a_refit_leaves_unanswered_is_dropped():
    """A search may end while points that it asked for are under way."""

    class Hasty(LeastSquares):
        def search(self, space, generator):
            solution = yield from super().search(space, generator)
            points = np.tile(solution.x, (3, 1)) + np.arange(3.0)[:, None]
            first = yield Points(points, "never mind", asynchronous=True)
            assert first
            return solution

    class OneByOne(CurveExecutor):
        def completed(self):
            task, self._queue = self._queue[:1], self._queue[1:]
            return [self._answer(each) for each in task]

    curves = lines()
    runner, space, solution = curves.solve()
    settings = UncertaintySettings(("slope", "level"))
    usual = profiles(runner, space, solution, METHOD, settings)
    assert profiles(Runner(OneByOne(curves)), space, solution, Hasty(), settings) == usual


def test_a_continuation_is_a_method_like_any_other():
    _, space, solution = puromycin().solve()
    side = ProfileContinuation(METHOD, ProfileTarget(1, 1, solution.cost, 1e3), 0.01)
    search = side.search(space, np.random.default_rng(0))
    next(search)
    search.close()


class TestSelection:
    space = lines().space()

    @pytest.mark.parametrize(
        ("names", "chosen"),
        [
            (("all",), [0, 1, 2, 3, 4]),
            (("shared",), [0, 1]),
            (("shift",), [2, 3, 4]),
            (("shift[e1]", "slope"), [0, 3]),
            (("slope", "all", "slope"), [0, 1, 2, 3, 4]),
            ((), []),
        ],
    )
    def test_names(self, names, chosen):
        assert select(self.space, names) == chosen

    def test_an_unknown_name_is_refused(self):
        with pytest.raises(ProblemError, match="did you mean 'slope'"):
            select(self.space, ("slop",))

    def test_no_profiles(self):
        runner, space, solution = lines().solve()
        before = runner.evaluations
        assert profiles(runner, space, solution, METHOD, UncertaintySettings()) == ()
        assert runner.evaluations == before

    def test_a_cost_without_weights_needs_a_rise(self):
        curves = lines(cost=SumAbsolute())
        settings = UncertaintySettings(("slope",))
        with pytest.raises(ProblemError, match=r"uncertainty\.rise"):
            check_profiles(curves.space(), settings)
        check_profiles(curves.space(), replace(settings, rise=3.84))
        start = Solution(curves.space().start, 1.0, Ending.CONVERGED)
        with pytest.raises(ProblemError, match=r"uncertainty\.rise"):
            profiles(curves.runner(), curves.space(), start, METHOD, settings)

    def test_a_failed_fit_has_no_profiles(self):
        curves = lines()
        failed = Solution(curves.space().start, np.nan, Ending.START_FAILED)
        settings = UncertaintySettings(("all",))
        assert profiles(curves.runner(), curves.space(), failed, METHOD, settings) == ()

    @pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0])
    def test_a_confidence_that_is_none_is_refused(self, confidence):
        with pytest.raises(ProblemError, match=r"uncertainty\.confidence"):
            UncertaintySettings(confidence=confidence)
