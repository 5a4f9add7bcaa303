"""Intervals, correlations and derived parameters against dense formulas and simulation."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t as student
from support.problems.curves import Curves

from cluster_est import LeastSquares, Parameter
from cluster_est.methods.method import Ending, Evaluation, Solution
from cluster_est.problem.costs import COSTS
from cluster_est.problem.search_space import make_space
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty import assess, examine, linearise
from workers.messages import Outcome, Status

TIMES = np.linspace(0.1, 4.0, 25)
HUBER, SOFT_L1, CAUCHY = (COSTS[name] for name in ("huber", "soft_l1", "cauchy"))


def decay(times, values, experiment):
    """Shared rate and gain, an offset for each experiment."""
    rate, gain, offset = values
    return offset + (1.0 + experiment) * gain * np.exp(-rate * times)


def decays(count=4, noise=0.02, seed=0, scale="linear", **options):
    generator = np.random.default_rng(seed)
    measured = [
        decay(TIMES, (0.8, 2.0, 0.3 * e), e) + noise * generator.normal(size=len(TIMES))
        for e in range(count)
    ]
    parameters = (
        Parameter("rate", 1.0, (0.01, 10.0), scale=scale),
        Parameter("gain", 1.0, (-10.0, 10.0)),
        Parameter("offset", 0.1, (-5.0, 5.0), per="experiment"),
    )
    return Curves(decay, parameters, TIMES, measured, **options)


def dense_errors(matrix, cost):
    count, size = matrix.shape
    return np.sqrt(np.diag(np.linalg.inv(matrix.T @ matrix)) * cost / (count - size))


def errors(found):
    """Those of the textbook, for white noise."""
    return np.array([interval.error_white for interval in found.intervals])


def check_errors(found, matrix, cost, rtol=1e-10):
    """Whether they are those of a dense Jacobian."""
    np.testing.assert_allclose(errors(found), dense_errors(matrix, cost), rtol=rtol)


def at(curves, x):
    """(space, solution) with derivatives at some point."""
    space = curves.space()
    return space, linearise(curves.runner(), space, Solution(np.array(x), 1.0, Ending.CONVERGED))


class TestSharedAndLocal:
    @pytest.mark.parametrize("count", [1, 4])
    def test_errors_are_those_of_the_dense_jacobian(self, count):
        _, space, solution = decays(count).solve()
        check_errors(assess(space, solution), solution.jacobian, solution.cost)

    def test_intervals_are_those_of_students_t(self):
        _, space, solution = decays().solve()
        found = assess(space, solution)
        width = student.ppf(0.975, 4 * len(TIMES) - 6)
        for x, interval in zip(solution.x, found.intervals, strict=True):
            assert interval.upper95 - x == pytest.approx(width * interval.std_error)
            assert x - interval.lower95 == pytest.approx(width * interval.std_error)

    def test_a_log_scale_makes_no_difference_to_first_order(self):
        linear, log = (assess(*decays(scale=scale).solve()[1:]) for scale in ("linear", "log"))
        np.testing.assert_allclose(errors(linear), errors(log), rtol=1e-5)
        interval = log.intervals[0]
        middle = np.sqrt(interval.lower95 * interval.upper95)
        assert interval.upper95 - middle > middle - interval.lower95

    def test_correlations(self):
        _, space, solution = decays().solve()
        found = assess(space, solution)
        inverse = np.linalg.inv(solution.jacobian.T @ solution.jacobian)
        roots = np.sqrt(np.diag(inverse))
        expected = inverse / np.outer(roots, roots)
        assert found.shared == ("rate", "gain")
        assert found.local == tuple(f"offset[e{e}]" for e in range(4))
        np.testing.assert_allclose(found.correlations, expected[:2, :2], rtol=1e-9)
        np.testing.assert_allclose(found.local_correlations, expected[2:, :2], rtol=1e-9)

    def test_values_per_group_are_shared(self):
        curves = decays(groups=("a", "a", "b", "c"))
        grouped = (*curves.parameters[:2], replace(curves.parameters[2], per="group:g"))
        _, space, solution = replace(curves, parameters=grouped).solve()
        found = assess(space, solution)
        assert found.shared == ("rate", "gain", "offset[a]")
        assert found.local == ("offset[b]", "offset[c]")
        check_errors(found, solution.jacobian, solution.cost)

    def test_without_the_evaluation_a_sum_of_squares_is_enough(self):
        _, space, solution = decays().solve()
        bare = assess(space, replace(solution, at=None))
        np.testing.assert_allclose(errors(bare), errors(assess(space, solution)), rtol=1e-12)

    def test_copies_of_an_experiment_count_each(self):
        curves = decays()
        problem, runner = curves.problem(), curves.runner()
        once, twice = (make_space(problem, e) for e in ((0, 1, 2), (0, 1, 2, 0, 1, 2)))
        requests = [SearchRequest(str(s.experiments), LeastSquares(), s) for s in (once, twice)]
        one, two = runner.run(requests)
        assert two.cost == pytest.approx(2.0 * one.cost)
        np.testing.assert_allclose(two.x, one.x, rtol=1e-7)
        stacked = np.vstack([one.jacobian, one.jacobian])
        check_errors(assess(twice, two), stacked, 2.0 * one.cost, rtol=1e-6)


class TestHeld:
    def test_an_unknown_at_a_bound_is_held_and_its_side_named(self):
        curves = decays()
        bounded = (replace(curves.parameters[0], bounds=(0.9, np.inf)), *curves.parameters[1:])
        _, space, solution = replace(curves, parameters=bounded).solve()
        found = assess(space, solution)
        assert [i.at_bound for i in found.intervals] == ["lower", "", "", "", "", ""]
        assert np.isnan(found.intervals[0].std_error)
        expected = dense_errors(solution.jacobian[:, 1:], solution.cost)
        np.testing.assert_allclose(errors(found)[1:], expected, rtol=1e-10)

    @pytest.mark.parametrize(
        ("text", "x", "basis"),
        [
            pytest.param(
                "2 <= rate + gain",
                (0.8, 1.2, 0.3),
                [[1, 0], [-1, 0], [0, 1]],
                marks=pytest.mark.slow,
            ),
            ("rate + gain <= 3", (0.8, 1.2, 0.3), np.eye(3)),
            ("gain == 1.2", (0.8, 1.2, 0.3), [[1, 0], [0, 0], [0, 1]]),
            (
                "offset <= gain",
                (0.8, 2.0, 0.1, 2.0, 0.2),
                [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]],
            ),
        ],
    )
    def test_constraints_leave_the_errors_of_what_may_move(self, text, x, basis):
        """The columns of `basis` are the moves that an active constraint allows."""
        space, solution = at(decays(count=len(x) - 2, constraints=(text,)), x)
        found, basis = assess(space, solution), np.array(basis, float)
        matrix = solution.jacobian @ basis
        variance = solution.cost / (len(matrix) - basis.shape[1])
        spread = np.diag(basis @ np.linalg.inv(matrix.T @ matrix) @ basis.T)
        expected = np.where(spread > 0.0, np.sqrt(variance * spread), np.nan)
        np.testing.assert_allclose(errors(found), expected, rtol=1e-9)
        named = any(text.split()[0] in note and "constraint" in note for note in found.notes)
        assert named == (basis.shape[0] > basis.shape[1])

    def test_a_perfect_fit_has_intervals_of_no_width(self):
        _, space, solution = decays(noise=0.0).solve()
        assert errors(assess(space, replace(solution, cost=0.0, at=None))).max() == 0.0


class TestCosts:
    def two_outputs(self, cost, noise=(0.01, 0.5), count=4, seed=0, size=60):
        generator = np.random.default_rng(seed)
        times = np.linspace(0.1, 4.0, size)

        def both(times, values, experiment):
            rate, gain = values
            return np.array([gain * np.exp(-rate * times), gain * np.exp(-2.0 * rate * times)])

        scatter = np.array(noise)[:, None]
        measured = [
            both(times, (0.8, 2.0), e) + scatter * generator.normal(size=(2, size))
            for e in range(count)
        ]
        parameters = (Parameter("rate", 1.0, (0.01, 10.0)), Parameter("gain", 1.0, (-10.0, 10.0)))
        return Curves(both, parameters, times, measured, cost=cost)

    def solved(self, curves):
        """The minimum by reweighting, whatever the method does with weights."""
        x = curves.space().start
        for _ in range(60):
            space, solution = at(curves, x)
            weights = space.problem.cost.weights(solution.at.residuals, space.outputs)
            root = np.sqrt(weights)
            step = np.linalg.lstsq(root[:, None] * solution.jacobian, root * solution.at.residuals)
            x = x - step[0]
        return at(curves, x)

    def test_a_likelihood_weights_outputs_by_their_scatter(self):
        space, solution = self.solved(self.two_outputs(COSTS["likelihood"]()))
        found = assess(space, solution)
        assert found.variance == pytest.approx(1.0, rel=0.02)
        residuals, matrix = solution.at.residuals, solution.jacobian
        sums = np.array([(residuals[space.outputs == j] ** 2).mean() for j in (0, 1)])
        weights = 1.0 / sums[space.outputs]
        count = len(residuals)
        expected = np.linalg.inv(matrix.T @ (weights[:, None] * matrix)) * count / (count - 2)
        np.testing.assert_allclose(errors(found), np.sqrt(np.diag(expected)), rtol=1e-9)

    @pytest.mark.parametrize("cost", [HUBER(0.02), SOFT_L1(0.02), CAUCHY(0.05)], ids=repr)
    def test_a_robust_cost_has_the_covariance_of_an_m_estimator(self, cost):
        """Huber (1981), section 7.6: K^2 mean(psi^2) n / (n - k) / mean(psi')^2 (J'J)^-1."""
        curves = replace(decays(count=3, noise=0.03, seed=4), cost=cost)
        space, solution = self.solved(curves)
        r, matrix, c = solution.at.residuals, solution.jacobian, cost.scale
        z = (r / c) ** 2
        if isinstance(cost, HUBER):
            psi, slope = np.clip(r, -c, c), (np.abs(r) < c).astype(float)
        elif isinstance(cost, SOFT_L1):
            psi, slope = r / np.sqrt(1 + z), (1 + z) ** -1.5
        else:
            psi, slope = r / (1 + z), (1 - z) / (1 + z) ** 2
        n, k = matrix.shape
        correction = 1 + k / n * slope.var() / slope.mean() ** 2
        scale = correction**2 * (psi**2).sum() / (n - k) / slope.mean() ** 2
        expected = np.sqrt(scale * np.diag(np.linalg.inv(matrix.T @ matrix)))
        np.testing.assert_allclose(errors(assess(space, solution)), expected, rtol=1e-6)

    def test_a_robust_cost_of_several_outputs_takes_each_on_its_own(self):
        cost = HUBER(0.03)
        space, solution = self.solved(self.two_outputs(cost, noise=(0.02, 0.2)))
        r, matrix = solution.at.residuals, solution.jacobian
        n, k = matrix.shape
        bread, filling = np.zeros((k, k)), np.zeros((k, k))
        for j in (0, 1):
            inside = space.outputs == j
            part, psi = matrix[inside], np.clip(r[inside], -0.03, 0.03)
            slope = (np.abs(r[inside]) < 0.03).astype(float)
            correction = 1 + k / n * slope.var() / slope.mean() ** 2
            bread += slope.mean() * part.T @ part
            filling += correction**2 * (psi**2).mean() * n / (n - k) * part.T @ part
        expected = np.linalg.inv(bread) @ filling @ np.linalg.inv(bread)
        found = assess(space, solution)
        np.testing.assert_allclose(errors(found), np.sqrt(np.diag(expected)), rtol=1e-9)

    @pytest.mark.parametrize(
        ("cost", "said"), [(COSTS["sae"](), "no weights"), (CAUCHY(1e-5), "too small")]
    )
    def test_a_cost_without_intervals_says_why(self, cost, said):
        curves = decays(count=2, cost=cost)
        start = Solution(curves.space().start, 1.0, Ending.CONVERGED)
        found = examine(curves.runner(), curves.space(), start)
        assert np.isnan(errors(found)).all()
        assert said in found.notes[0]


class TestDerived:
    def test_standard_errors_are_those_of_the_delta_method(self):
        curves = decays(scale="log")
        derived = Parameter("ratio", 1.0, expression="gain / rate", auxiliary=True)
        per_run = Parameter("level", 1.0, expression="gain + 2 * offset", auxiliary=True)
        _, space, solution = replace(
            curves, parameters=(*curves.parameters, derived, per_run)
        ).solve()
        found = {each.label: each for each in assess(space, solution).derived}
        matrix = solution.jacobian
        covariance = np.linalg.inv(matrix.T @ matrix) * solution.cost / (matrix.shape[0] - 6)
        rate, gain, *offsets = space.estimates(solution.x).values()
        slope = np.array([-gain / rate, 1.0 / rate, 0, 0, 0, 0])  # the rate's is for its logarithm
        assert found["ratio"].value == pytest.approx(gain / rate)
        assert found["ratio"].std_error == pytest.approx(np.sqrt(slope @ covariance @ slope))
        for e, offset in enumerate(offsets):
            slope = np.array([0.0, 1.0, 0, 0, 0, 0])
            slope[2 + e] = 2.0
            each = found[f"level[e{e}]"]
            assert each.value == pytest.approx(gain + 2.0 * offset)
            assert each.std_error == pytest.approx(np.sqrt(slope @ covariance @ slope))
            width = student.ppf(0.975, matrix.shape[0] - 6) * each.std_error
            assert each.upper95 - each.value == pytest.approx(width)

    @pytest.mark.parametrize(("k", "side"), [(0.1, "lower"), (1.0, "")])
    def test_a_ratio_may_be_determined_where_its_parts_are_not(self, k, side):
        """Also where a search went along the ratio until a bound stopped it."""

        def only_ratio(times, values, experiment):
            return np.exp(-values[0] / values[1] * times)

        measured = [only_ratio(TIMES, (1.0, 2.0), 0) + 0.01 * np.sin(40.0 * TIMES)]
        parameters = (
            Parameter("k", 1.0, (0.1, 10.0)),
            Parameter("m", 1.0, (0.1, 10.0)),
            Parameter("ratio", 1.0, expression="k / m", auxiliary=True),
            Parameter("product", 1.0, expression="k * m", auxiliary=True),
        )
        space, solution = at(Curves(only_ratio, parameters, TIMES, measured), (k, 2.0 * k))
        found = assess(space, solution)
        assert [i.at_bound for i in found.intervals] == [side, ""]
        assert np.isnan(errors(found)).all()
        values = {each.label: each for each in found.derived}
        slope = solution.jacobian[:, 0] * solution.x[1]  # d residuals / d ratio
        variance = solution.cost / (len(TIMES) - 1)
        assert values["ratio"].std_error == pytest.approx(
            np.sqrt(variance / (slope @ slope)), rel=1e-3
        )
        assert np.isnan(values["product"].std_error)


class TestIncomplete:
    def test_no_jacobian(self):
        _, space, solution = decays().solve()
        found = assess(space, replace(solution, jacobian=None))
        assert np.isnan(errors(found)).all()
        assert "no derivatives" in found.notes[0]

    def test_what_is_missing_is_simulated(self):
        runner, space, solution = decays().solve()
        bare = replace(solution, jacobian=None, at=None, difference_steps=None)
        np.testing.assert_allclose(
            errors(examine(runner, space, bare)), errors(assess(space, solution)), rtol=1e-6
        )

    def test_a_failed_search(self):
        runner, space, _ = decays().solve()
        failed = Solution(space.start, np.nan, Ending.START_FAILED)
        assert np.isnan(errors(examine(runner, space, failed))).all()

    def test_as_many_unknowns_as_residuals(self):
        curves = decays(count=1)
        short = replace(curves, times=TIMES[:3], measured=[curves.measured[0][:3]])
        _, space, solution = short.solve()
        found = assess(space, solution)
        assert np.isnan(errors(found)).all()
        assert (
            "3 residuals determine 3 independent combinations of the parameters" in found.notes[0]
        )

    @pytest.mark.parametrize(
        ("samples", "said"),
        [
            (4, "are 6.5 times as wide.*4 residuals determine 3 values, .* 1 degree of freedom"),
            (6, "are 1.6 times as wide.*6 residuals determine 3 values, .* 3 degrees of freedom"),
            (8, ""),
        ],
    )
    def test_intervals_from_few_samples_are_explained(self, samples, said):
        """The 97.5 % quantiles of Student's t are 12.71, 3.18 and 2.57, that of the normal 1.96."""
        curves = decays(count=1)
        short = replace(curves, times=TIMES[:samples], measured=[curves.measured[0][:samples]])
        _, space, solution = short.solve()
        notes = [note for note in assess(space, solution).notes if "as with many" in note]
        assert bool(notes) == bool(said)
        assert not said or re.search(said, notes[0])

    def test_more_samples_are_no_advice_against_a_systematic_error(self):
        curves = decays(count=1)
        short = replace(curves, times=TIMES[:4], measured=[curves.measured[0][:4]])
        _, space, solution = short.solve()
        found = assess(space, solution)
        for systematic in (False, True):
            said = found.sentences_of(systematic=systematic)
            assert any("1 degree of freedom" in each for each in said)
            assert any("more samples" in each for each in said) is not systematic

    def test_an_active_constraint_on_a_signal_is_noted(self):
        _, space, solution = decays(count=1).solve()
        vars(space)["constraint_names"] = ("T [e0]",)
        vars(space)["equality"] = np.array([False])
        outcome = Outcome(0, Status.OK, solution.at.residuals, constraints=np.zeros(1))
        at = Evaluation((outcome,), solution.cost, np.zeros(1))
        found = assess(space, replace(solution, at=at))
        assert "T [e0]" in found.notes[0]
        assert "profiles" in found.notes[0]
