from dataclasses import replace

import numpy as np
import pytest
from support.problems.curves import Curves
from support.problems.seen_springs import with_outputs

from cluster_est.errors import ProblemError
from cluster_est.methods import SEARCH_METHODS
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.costs import COSTS
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import LogNormalPrior, NormalPrior
from cluster_est.studies.fit import Fit
from cluster_est.uncertainty import UncertaintySettings, examine, linearise, profiles

TIMES = np.linspace(0.0, 1.0, 400)
COLUMNS = np.column_stack([np.ones(len(TIMES)), TIMES])
MEANS, SDS = np.array([1.5, -0.4]), np.array([0.02, 0.05])
PRIORS = (
    Parameter("a", 1.0, (-10.0, 10.0), prior=NormalPrior(MEANS[0], SDS[0])),
    Parameter("b", 0.0, (-10.0, 10.0), prior=NormalPrior(MEANS[1], SDS[1])),
)


def line(times, values, experiment):
    return values[0] + values[1] * times


def flat(times, values, experiment):
    """Measurements that tell nothing of the second value."""
    return values[0] + 0.0 * values[1] * times


def found_in(model, parameters, records, *method):
    """The solution of a fit, and what its data determine."""
    runner, space, solution = Curves(model, parameters, TIMES, records).solve(*method)
    return solution, examine(runner, space, linearise(runner, space, solution))


def unknown(parameters):
    return tuple(replace(p, prior=None) for p in parameters)


def measured(count=1, seed=0):
    generator = np.random.default_rng(seed)
    return [1.4 - 0.5 * TIMES + generator.normal(size=len(TIMES)) for _ in range(count)]


def posterior(records):
    """Mean and covariance of the two coefficients under noise of 1 and their priors."""
    columns = np.vstack([COLUMNS for _ in records])
    precision = columns.T @ columns + np.diag(SDS**-2)
    mean = np.linalg.solve(precision, columns.T @ np.concatenate(records) + MEANS / SDS**2)
    return mean, np.linalg.inv(precision)


@pytest.mark.parametrize("method", [LeastSquares(), LeastSquares(differences="central")])
@pytest.mark.parametrize("count", [1, 3])
def test_the_minimum_and_its_intervals_are_those_of_the_posterior(method, count):
    records = measured(count)
    solution, found = found_in(line, PRIORS, records, method)
    mean, covariance = posterior(records)
    assert solution.x == pytest.approx(mean, abs=1e-6)
    errors = [interval.std_error for interval in found.intervals]
    assert errors == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.02)


def test_noise_larger_than_sigma_widens_what_the_measurements_say_and_not_the_priors():
    records = [3.0 * each - 2.0 * line(TIMES, (1.4, -0.5), 0) for each in measured()]
    _, found = found_in(line, PRIORS, records)
    inverse = np.linalg.inv(COLUMNS.T @ COLUMNS + np.diag(SDS**-2))
    middle = found.variance * COLUMNS.T @ COLUMNS + np.diag(SDS**-2)
    expected = np.sqrt(np.diag(inverse @ middle @ inverse))
    assert [each.std_error for each in found.intervals] == pytest.approx(expected, rel=1e-3)
    assert found.variance == pytest.approx(9.0, rel=0.15)


def test_a_prior_of_a_value_for_each_experiment_counts_once_for_each():
    records = measured(3)
    own = (replace(PRIORS[0], per="experiment"), PRIORS[1])
    _, space, solution = Curves(line, own, TIMES, records).solve()
    assert [len(each) for each in space.priors.places] == [2, 1, 1]
    assert int(space.priors.among(space.rows).sum()) == 4
    columns = np.column_stack([np.kron(np.eye(3), COLUMNS[:, :1]), np.tile(TIMES, 3)])
    weights = np.array([SDS[0]] * 3 + [SDS[1]]) ** -2
    means = np.array([MEANS[0]] * 3 + [MEANS[1]])
    precision = columns.T @ columns + np.diag(weights)
    mean = np.linalg.solve(precision, columns.T @ np.concatenate(records) + weights * means)
    values = space.estimates(solution.x)
    assert [values[f"a[e{e}]"] for e in range(3)] == pytest.approx(mean[:3], abs=1e-6)
    assert values["b"] == pytest.approx(mean[3], abs=1e-6)


def test_what_no_measurement_tells_is_as_the_prior_says():
    solution, found = found_in(flat, PRIORS, measured())
    assert solution.x[1] == pytest.approx(MEANS[1], abs=1e-9)
    assert found.intervals[1].std_error == pytest.approx(SDS[1], rel=1e-6)
    assert found.directions == ()


@pytest.mark.parametrize("method", [LeastSquares(), LeastSquares(differences="central")])
def test_a_profile_keeps_the_prior_of_the_value_that_it_holds(method):
    runner, space, solution = Curves(line, PRIORS, TIMES, measured()).solve(method)
    settings = UncertaintySettings(profiles=("a", "b"))
    _, covariance = posterior(measured())
    found = profiles(runner, space, solution, method, settings)
    assert len(found) == 2
    for profile, i in zip(found, (0, 1), strict=True):
        half = 0.5 * (profile.upper - profile.lower)
        assert half == pytest.approx(1.96 * np.sqrt(covariance[i, i]), rel=0.05)


@pytest.mark.parametrize("noise", [0.3, 3.0])
def test_a_profile_of_what_no_measurement_tells_is_as_wide_as_its_prior(noise):
    """Also where the measurements scatter by less or more than their sigmas."""
    records = [1.4 + noise * np.random.default_rng(0).normal(size=len(TIMES))]
    runner, space, solution = Curves(flat, PRIORS, TIMES, records).solve()
    settings = UncertaintySettings(profiles=("b",))
    (found,) = profiles(runner, space, solution, LeastSquares(), settings)
    assert 0.5 * (found.upper - found.lower) == pytest.approx(1.96 * SDS[1], rel=0.02)


def test_a_prior_on_one_value_hides_no_other_that_the_measurements_do_not_tell():
    def noisy(times, values, experiment):
        noise = 1e-9 * np.sin(1e6 * values[1])  # of a simulation
        return 300.0 + values[0] * times + noise

    a, b = (Parameter(name, 1.0, (-10.0, 10.0)) for name in "ab")
    own = (replace(a, prior=NormalPrior(0.5, 100.0)), b)
    records = [noisy(TIMES, (0.7, 1.0), 0) + np.random.default_rng(0).normal(size=len(TIMES))]
    known, free = (found_in(noisy, given, records)[1] for given in (own, unknown(own)))
    assert [d.labels for d in known.directions] == [d.labels for d in free.directions]


def test_the_jacobian_of_the_priors_is_that_of_their_residuals():
    own = (
        Parameter("a", 1.0, (0.01, 10.0), "log", prior=NormalPrior(1.5, 0.2)),
        Parameter("b", 0.5, (0.0, 10.0), per="experiment", prior=LogNormalPrior(1.0, 3.0)),
    )
    space = Curves(line, own, TIMES, measured(2)).space()
    x, step = space.start + 0.1, 1e-6
    for e, acting in enumerate(space.acting):
        jacobian = space.priors.jacobian(e, x, acting)
        for j, i in enumerate(acting):
            moved = np.eye(space.size)[i] * step
            change = space.priors.residuals(e, x + moved) - space.priors.residuals(e, x - moved)
            assert jacobian[:, j] == pytest.approx(change / (2.0 * step), rel=1e-6, abs=1e-9)


def test_a_front_of_several_outputs_is_refused():
    space = Curves(line, PRIORS, TIMES, measured(2)).space()
    with pytest.raises(ProblemError, match="a prior belongs to neither"):
        SEARCH_METHODS["nsga2"]().check(space)


def test_what_a_prior_cannot_be_weighed_against_is_refused():
    """A held-out record without a sigma too: values that only it has are fitted to it."""
    problem = Curves(line, PRIORS, TIMES, measured(6)).problem()
    whole = with_outputs(problem, lambda output: replace(output, sigma=1.5))
    held_out = (replace(e, role="test") for e in problem.experiments[1:])
    runs = (whole.experiments[0], *held_out)
    bootstrap = UncertaintySettings(bootstrap=10)
    for study, pattern in (
        (Fit(replace(whole, cost=COSTS["huber"]())), 'a.prior: .*the cost "sse".*huber'),
        (Fit(problem), "experiment 'e0': sigma.y0 is missing, but the prior"),
        (Fit(replace(problem, experiments=runs)), "experiment 'e1': sigma.y0 is missing"),
        (Fit(whole, uncertainty=bootstrap), "uncertainty.bootstrap: must be 0 with priors"),
    ):
        with pytest.raises(ProblemError, match=pattern):
            study.space()
    Fit(replace(problem, parameters=unknown(problem.parameters))).space()
    Fit(whole).space()
