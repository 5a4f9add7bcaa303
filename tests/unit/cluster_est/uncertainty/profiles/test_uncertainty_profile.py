import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares
from scipy.stats import f as fisher
from support.problems.curves import CurveExecutor, Curves
from support.shuffling_executor import ShufflingExecutor

from cluster_est import Budget, LeastSquares, Parameter
from cluster_est.errors import ProblemError
from cluster_est.methods.method import Ending, Points, Solution
from cluster_est.problem.costs import COSTS
from cluster_est.running.runner import Runner
from cluster_est.uncertainty import UncertaintySettings, assess, check_profiles, profiles, select

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


def puromycin(lower=0.0, upper=10.0):
    parameters = (
        Parameter("velocity", 200.0, (0.0, 1000.0)),
        Parameter("affinity", 0.075, (lower, upper)),
    )
    return Curves(michaelis_menten, parameters, np.arange(1.0, 13.0), [VELOCITY])


def one_slope():
    measured = [2.0 * TIMES + 0.1 * np.sin(50.0 * TIMES)]
    return Curves(lambda t, values, e: values[0] * t, (Parameter("slope", 1.0),), TIMES, measured)


def profiled(curves, *names, **settings):
    return profiles(*curves.solve(), METHOD, UncertaintySettings(names, **settings))


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
    @pytest.mark.parametrize("curves", [lines(), one_slope()], ids=["five unknowns", "one"])
    def test_of_a_linear_model_are_those_of_students_t(self, curves):
        runner, space, solution = curves.solve()
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
        found = profiled(puromycin(), "all", confidence=confidence)
        estimates = [profile.value for profile in found]
        for i, profile in enumerate(found):
            for side, end in ((-1, profile.lower), (1, profile.upper)):
                expected = scipy_profile(
                    lambda p: michaelis_menten(None, p, 0), VELOCITY, estimates, i, side, confidence
                )
                assert end == pytest.approx(expected, abs=1e-3 * abs(expected - profile.value))

    def test_of_a_likelihood_are_those_of_its_ratio(self):
        """Of one output n ln(S / S0) <= 3.84, but for terms of the order of 1 / n."""
        curves, (_, space, solution) = lines(cost=COSTS["likelihood"]()), lines().solve()
        likely = replace(solution, cost=60.0 * np.log(solution.cost / 60.0), at=None)
        settings = UncertaintySettings(("slope",))
        (found,) = profiles(curves.runner(), curves.space(), likely, METHOD, settings)
        (usual,) = profiles(lines().runner(), space, solution, METHOD, settings)
        assert found.rise == pytest.approx(3.84, rel=0.15)
        assert found.upper - found.lower == pytest.approx(usual.upper - usual.lower, rel=0.05)

    def test_of_a_profile_with_its_own_rise(self):
        once, twice = (profiled(lines(), "slope", rise=rise)[0] for rise in (0.1, 0.4))
        assert twice.upper - twice.value == pytest.approx(2.0 * (once.upper - once.value), rel=1e-3)

    def test_do_not_depend_on_the_units_or_the_scale(self):
        def scaled(times, values, experiment):
            return 1e3 * michaelis_menten(times, (values[0], values[1] * 1e-6), experiment)

        def with_affinity(*given, **changes):
            velocity = puromycin().parameters[0]
            own = (velocity, Parameter("affinity", *given))
            return profiled(replace(puromycin(), parameters=own, **changes), "affinity")[0]

        plain = with_affinity(0.075, (0.0, 10.0))
        large = with_affinity(1e5, (0.0, 1e7), formula=scaled, measured=[1e3 * VELOCITY])
        log = with_affinity(0.1, (1e-6, 10.0), "log")
        ends = np.array([plain.lower, plain.upper])
        np.testing.assert_allclose([large.lower, large.upper], 1e6 * ends, rtol=1e-4)
        np.testing.assert_allclose([log.lower, log.upper], ends, rtol=2e-4)


class TestOpen:
    def test_at_a_bound(self):
        (found,) = profiled(puromycin(upper=0.08), "affinity")
        assert (found.open_lower, found.open_upper) == ("", "bound")
        assert found.upper == np.inf
        assert found.points[-1].value == 0.08
        (said,) = found.sentences
        assert re.search("affinity has no upper limit.*bound 0.08", said)

    def test_an_optimum_at_a_bound(self):
        (found,) = profiled(puromycin(lower=0.07), "affinity")
        assert (found.open_lower, found.open_upper) == ("bound", "")
        assert found.upper > found.value == 0.07

    def test_what_the_data_do_not_determine_is_flat(self):
        def product(times, values, experiment):
            return values[0] * values[1] * np.exp(-times)

        measured = [product(TIMES, (2.0, 3.0), 0) + 0.01 * np.cos(40.0 * TIMES)]
        parameters = (Parameter("a", 1.5, (0.1, np.inf)), Parameter("b", 2.5, (0.0, np.inf)))
        (found,) = profiled(Curves(product, parameters, TIMES, measured), "a")
        assert (found.open_lower, found.open_upper) == ("bound", "flat")
        assert found.upper == np.inf
        assert found.points[-1].value > 1e3
        assert "does not rise enough" in found.sentences[-1]

    def test_where_simulations_fail(self):
        def walled(times, values, experiment):
            found = michaelis_menten(times, values, experiment)
            return found if values[0] <= 216.0 else np.nan * found

        (found,) = profiled(replace(puromycin(), formula=walled), "velocity")
        assert (found.open_lower, found.open_upper) == ("", "failed")
        assert np.isnan(found.upper)
        assert 213.0 < found.points[-1].value <= 216.0
        assert "refits" in found.sentences[0]

    @pytest.mark.parametrize("count", [3, 2])
    def test_where_the_residuals_do_not_say_how_far_the_cost_may_rise(self, count):
        """None of them, or as many as unknowns, must not undo a fit that is done."""
        times = TIMES[1 : count + 1]
        short = replace(
            lines(),
            formula=lambda times, values, experiment: line(times, (*values, 0.0), 0),
            parameters=lines().parameters[:2],
            times=times,
            measured=[line(times, (1.0, 1.0, 0.0), 0)],
        )
        runner, space, solution = short.solve()
        solution = replace(solution, x=np.ones(2), at=None, jacobian=None, cost=1.0)
        found = profiles(runner, space, solution, METHOD, UncertaintySettings(("all",)))
        assert [p.open_lower for p in found] == ["unknown", "unknown"]
        assert np.isnan([p.upper for p in found]).all()
        assert "uncertainty.rise" in found[0].sentences[0]

    def test_when_the_budget_ends(self):
        curves = puromycin()
        _, space, solution = curves.solve()
        runner = Runner(CurveExecutor(curves), Budget(evaluations=5))
        (found,) = profiles(runner, space, solution, METHOD, UncertaintySettings(("velocity",)))
        assert found.open_lower == found.open_upper == "failed"


@pytest.fixture(scope="module")
def found():
    return profiled(puromycin(), "affinity", steps=6)[0]


class TestPoints:
    def test_go_from_one_end_to_the_other_through_the_optimum(self, found):
        values = [p.value for p in found.points]
        assert values == sorted(values)
        roots = np.array([p.root for p in found.points])
        assert np.count_nonzero(roots == 0.0) == 1
        assert (np.diff(roots) > 0.0).all()
        assert -1.5 <= roots[0] <= -0.999
        assert 0.999 <= roots[-1] <= 1.5
        assert 6 <= (roots > 0).sum() <= 10

    def test_are_minima_of_the_others(self, found):
        for point in found.points:
            # linear in the velocity: its minimum is known
            column = CONCENTRATION / (point.value + CONCENTRATION)
            best = column @ VELOCITY / (column @ column)
            assert point.estimates == pytest.approx((best, point.value), rel=1e-7)
            residuals = VELOCITY - best * column
            assert point.cost == pytest.approx(residuals @ residuals, rel=1e-9)


def test_a_better_minimum_is_reported():
    def twofold(times, values, experiment):
        """Minima with a near -0.85 and, of cost 0, with a = b = 1."""
        a, b = values
        return np.array([a**2 - 1.0, 0.5 * (a - 1.0), 2.0 * (b - a)])

    parameters = (Parameter("a", -1.0, (-3.0, 3.0)), Parameter("b", -1.0, (-3.0, 3.0)))
    curves = Curves(twofold, parameters, np.arange(1.0, 4.0), [np.zeros(3)])
    (found,) = profiled(curves, "b", rise=20.0, steps=8)
    assert found.value < 0.0
    assert found.better is not None
    estimates, cost = found.better
    assert estimates["a"] == pytest.approx(1.0, abs=0.4)
    assert cost < 0.5
    assert "better minimum" in found.sentences[-1]


def test_a_profile_with_a_kink_is_closed_in_on():
    """b makes up for a until it meets its bound; from there on the cost rises steeply."""
    parameters = (Parameter("a", 1.0, (0.0, 100.0)), Parameter("b", 1.0, (0.0, 5.0)))
    measured = [TIMES + 0.1 * np.sin(50.0 * TIMES)]
    kinked = Curves(lambda t, v, e: 100.0 * (v[0] - v[1]) + t, parameters, TIMES, measured)
    (found,) = profiled(kinked, "a")
    # beyond it one unknown is left: the rise is 20 (100 d)^2
    shift = float(np.mean(0.1 * np.sin(50.0 * TIMES)))
    expected = 5.0 + (np.sqrt(found.rise / 20.0) + shift) / 100.0
    assert found.upper == pytest.approx(expected, abs=1e-5)
    assert found.open_lower == "bound"


class Impatient(LeastSquares):
    """Asks asynchronously, and again before all answers are there."""

    def search(self, space, generator):
        search = super().search(space, generator)
        points, asked = next(search), 0
        while True:
            answers = {e.index: e for e in (yield replace(points, asynchronous=True))}
            while len(answers) < len(points.x):
                none = replace(points, x=points.x[:0], asynchronous=True)
                answers |= {e.index: e for e in (yield none)}
            wanted = [answers[asked + j] for j in range(len(points.x))]
            asked += len(points.x)
            try:
                points = search.send(wanted)
            except StopIteration as end:
                return end.value


class Hasty(LeastSquares):
    """Ends while points that it asked for are under way."""

    def search(self, space, generator):
        solution = yield from super().search(space, generator)
        points = np.tile(solution.x, (3, 1)) + np.arange(3.0)[:, None]
        assert (yield Points(points, "never mind", asynchronous=True))
        return solution


@pytest.mark.parametrize(
    ("method", "changed"),
    [(METHOD, {"at_once": 1}), (Impatient(), {}), (Hasty(), {})],
    ids=["one side at a time", "asynchronous", "unanswered points"],
)
def test_refits_are_the_same_in_any_order(method, changed):
    """Indices and dropped points are those of the inner search, whatever was asked before it."""
    runner, space, solution = lines().solve()
    settings = UncertaintySettings(("slope", "level"))
    usual = profiles(runner, space, solution, METHOD, settings)
    other = Runner(ShufflingExecutor(CurveExecutor(lines())._answer))
    assert profiles(other, space, solution, method, settings.changed(**changed)) == usual


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
        failed = Solution(space.start, np.nan, Ending.START_FAILED)
        assert profiles(runner, space, failed, METHOD, UncertaintySettings(("all",))) == ()
        assert runner.evaluations == before

    def test_a_cost_without_weights_needs_a_rise(self):
        curves = lines(cost=COSTS["sae"]())
        settings = UncertaintySettings(("slope",))
        check_profiles(curves.space(), settings.changed(rise=3.84))
        with pytest.raises(ProblemError, match=r"uncertainty\.rise"):
            check_profiles(curves.space(), settings)
        start = Solution(curves.space().start, 1.0, Ending.CONVERGED)
        with pytest.raises(ProblemError, match=r"uncertainty\.rise"):
            profiles(curves.runner(), curves.space(), start, METHOD, settings)

    @pytest.mark.parametrize("confidence", [0.0, 1.0, 95.0])
    def test_a_confidence_that_is_none_is_refused(self, confidence):
        with pytest.raises(ProblemError, match=r"uncertainty\.confidence"):
            UncertaintySettings(confidence=confidence)
