from collections import Counter
from dataclasses import replace

import pytest
from support.problems.springs import spring_problem

from cluster_est import LeastSquares, Parameter, fit
from cluster_est.methods.method import Ending


def logged(problem, method, resources=None):
    rows = []
    result = fit(problem, method, resources, record=lambda origin, out: rows.append((origin, out)))
    return result, rows


def test_a_jacobian_costs_shared_plus_local_simulations_for_each_experiment():
    truth = spring_problem(experiments=20, samples=60, noise=0.01, local=("x0", "v0"))
    result, rows = logged(truth.problem, LeastSquares(differences="forward"))
    iterations = Counter()
    for origin, _ in rows:
        if origin.purpose == "jacobian":
            iterations[origin.evaluation] += 1
    assert set(iterations.values()) == {20}
    jacobians = len(iterations) / 5
    assert jacobians == int(jacobians)
    assert jacobians >= result.solution.iterations
    assert sum(iterations.values()) == jacobians * (3 + 2) * 20


def test_failed_simulations_are_outcomes_with_a_reason_and_the_fit_goes_on():
    truth = spring_problem(noise=0.01)
    heavy = Parameter("m", 4.0, (-5.0, 20.0))
    parameters = (heavy, *truth.problem.parameters[1:])
    result, rows = logged(replace(truth.problem, parameters=parameters), LeastSquares())
    failed = [outcome for _, outcome in rows if not outcome.ok]
    assert failed, "the bounds allow masses for which the model refuses to run"
    assert all("mass must be positive" in outcome.message for outcome in failed)
    assert all(outcome.residuals is None for outcome in failed)
    assert result.failures == len(failed)
    assert result.success
    assert result.x["m"] == pytest.approx(1.2, rel=0.02)


def test_a_start_that_cannot_be_simulated_is_a_result_and_no_exception():
    truth = spring_problem()
    bad = replace(truth.problem.parameters[0], start=-1.0, bounds=(-2.0, 10.0))
    result = fit(replace(truth.problem, parameters=(bad, *truth.problem.parameters[1:])))
    assert not result.success
    assert result.solution.ending is Ending.START_FAILED
    assert "mass must be positive" in result.solution.message


def test_test_records_move_no_shared_parameter_but_get_their_own_initial_state():
    truth = spring_problem(noise=0.01)
    *train, last = truth.problem.experiments
    held_out = replace(last, role="test")
    with_test = fit(replace(truth.problem, experiments=(*train, held_out)))
    without = fit(replace(truth.problem, experiments=tuple(train)))
    for name in ("m", "k", "c"):
        assert with_test.x[name] == without.x[name]
    assert with_test.x["x0[e4]"] == pytest.approx(truth.values["x0[e4]"], abs=0.01)
    assert {e.role for e in with_test.errors} == {"train", "test"}
