from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_fit, made_fitter, made_problem
from support.problems.functions import FunctionExecutor, FunctionProblem
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    started,
    unfitted,
)

from cluster_est import LeastSquares, LoopSettings, close_loop, detect, fit
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.selection.acceptance import (
    RefitWithoutPart,
    predict,
    stays_bounded,
)
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.methods.method import GivenPoints
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

NAME = "mass_spring_damper"


def fitted_to(problem, bench):
    method = LeastSquares(differences="central")
    (fitted,) = bench.fitter.fit(LoopStage.DECLARED_MODEL, [FitStart(problem, {})], method)
    return fitted


def refitted(bench, space):
    (solution,) = bench.fitter.runner.run([SearchRequest("refit", LeastSquares(), space)])
    return solution


def by_refits(problem, bench):
    """Each experiment's sum of squares, predicted by a real fit to all others."""
    squares = []
    everything = range(len(problem.experiments))
    for e in everything:
        others = make_space(problem, tuple(i for i in everything if i != e))
        known = others.estimates(refitted(bench, others).x)
        left_out = make_space(problem, (e,), starts=known)
        look = GivenPoints(left_out.start[None, :], "left out")
        (seen,) = bench.fitter.runner.run([SearchRequest("left out", look, left_out)])
        squares.append(float(np.sum(seen.evaluations[0].residuals ** 2)))
    return np.array(squares)


@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_a_left_out_experiment_is_predicted_as_by_a_real_refit(noise):
    problem = measured(missing_effect_problem(NAME, experiments=4), noise)
    with opened(problem) as bench:
        found = predict(bench.fitter, fitted_to(problem, bench))
        np.testing.assert_allclose(found.squares, by_refits(problem, bench), rtol=0.01)


def test_a_left_out_experiment_of_a_wrong_model_too():
    """Another spring in each experiment, so that the fits without one of them differ."""
    problem = missing_effect_problem(NAME, experiments=4)
    runs = tuple(
        measured(started(problem, k=k), 0.003).experiments[e]
        for e, k in enumerate((26.0, 29.0, 31.0, 33.0))
    )
    problem = replace(problem, experiments=runs)
    with opened(problem) as bench:
        fitted = fitted_to(problem, bench)
        found = predict(bench.fitter, fitted)
        truth = by_refits(problem, bench)
    own = [np.sum(fitted.residuals[rows] ** 2) for rows in fitted.space.rows]
    assert np.max(truth / own) > 1.2
    np.testing.assert_allclose(found.squares, truth, rtol=0.05)


def test_with_one_experiment_quarters_of_its_record_are_left_out():
    problem = measured(missing_effect_problem(NAME, experiments=1), 0.03)
    (run,) = problem.experiments
    (output,) = run.outputs
    truth = []
    with opened(problem) as bench:
        found = predict(bench.fitter, fitted_to(problem, bench))
    for quarter in range(4):
        left = np.digitize(output.times, [1.5, 3.0, 4.5]) == quarter
        kept = replace(output, times=output.times[~left], values=output.values[~left])
        with opened(replace(problem, experiments=(replace(run, outputs=(kept,)),))) as bench:
            estimates = fitted_to(bench.fitter.problem, bench).estimates
        with opened(started(problem, **estimates)) as bench:
            truth.append(float(np.sum(unfitted(bench).residuals[left] ** 2)))
    np.testing.assert_allclose(found.squares, truth, rtol=0.02)


def test_of_two_experiments_quarters_of_both_records_are_left_out():
    with opened(measured(missing_effect_problem(NAME), 0.03)) as bench:
        assert len(predict(bench.fitter, fitted_to(bench.fitter.problem, bench)).squares) == 8


@pytest.mark.parametrize("springs", [(), (24.0, 28.0, 33.0)])
def test_what_belongs_to_the_left_out_experiment_follows_the_rest(springs):
    """As in held-out experiments: their own initial states are fitted to them.

    Of the wrong model, whose spring is another one in each, a refit takes several steps.
    """
    declared = missing_effect_problem(NAME, experiments=3, local=("c",))
    problem = measured(declared, 0.03)
    if springs:
        runs = [
            measured(started(declared, k=k), 0.003).experiments[e] for e, k in enumerate(springs)
        ]
        problem = replace(problem, experiments=tuple(runs))
    truth = []
    with opened(problem) as bench:
        fitted = fitted_to(problem, bench)
        found = predict(bench.fitter, fitted)
        for e in range(3):
            others = make_space(problem, tuple(i for i in range(3) if i != e))
            known = others.estimates(refitted(bench, others).x)
            shared = tuple(
                replace(p, start=known[p.name], fixed=True) if p.name in known else p
                for p in problem.parameters
            )
            own = make_space(replace(problem, parameters=shared), (e,))
            truth.append(refitted(bench, own).cost)
    np.testing.assert_allclose(found.squares, truth, rtol=0.2 if springs else 0.01)


def test_a_step_of_a_logarithm_is_bounded_by_itself_not_by_the_value():
    """A parameter of 1e-6: its logarithm is -14, half of which would be a factor of 1000."""
    plain = made_problem(20, 20, 20)
    small = replace(plain.parameters[0], scale="log", start=1e-6, bounds=(1e-12, 1.0))
    problem = replace(plain, parameters=(small,))
    asked = []

    def simulated(x):
        asked.append(float(x[0]))
        return np.full(20, np.nan)

    residuals = np.random.default_rng(0).normal(size=60)
    fitted = replace(made_fit(problem, residuals), jacobian=0.01 * residuals[:, None])
    with FunctionExecutor(simulated) as executor:
        predict(replace(made_fitter(problem), runner=Runner(executor)), fitted)
    assert min(asked) == pytest.approx(1e-6 * np.exp(-0.5))
    assert max(asked) < 1e-6


def test_an_unknown_that_hardly_moves_keeps_its_derivatives():
    """A step far below its last digit changes no residual; this is no derivative of zero."""
    jacobian = np.zeros((6, 2))
    jacobian[:2, 0], jacobian[2:4, 1], jacobian[4:] = 1.0, 1.0, 1.0
    fitted, start = np.array([1.0, 1.0, 0.3, -0.3 + 1e-12, 0.5, 0.5]), np.array([0.0, 1e6])

    def simulated(x):
        curved = np.array([0.3, 0.3, 0.0, 0.0, 0.0, 0.0]) * x[0] ** 2
        return fitted + jacobian @ (x - start) + curved

    none = np.zeros(2, bool)
    refit = RefitWithoutPart(fitted, jacobian, np.array([4, 5]), none, none)
    found = FunctionProblem("", simulated, tuple(start), np.nan).solve(refit)
    assert found.cost == pytest.approx(2.0 * (0.5 + found.x[0]) ** 2)
    assert found.x[1] == start[1]


@pytest.mark.parametrize(("local", "left"), [(False, 8.0), (True, 0.0)])
def test_a_value_of_a_curve_where_only_the_part_reaches_is_fitted_to_the_part(local, left):
    """The other rows determine it twenty times less well, and would move it by 2."""
    jacobian = np.zeros((6, 2))
    jacobian[:2, 0], jacobian[2:4, 1], jacobian[4:, 1] = 1.0, 0.05, 1.0
    fitted = np.array([0.0, 0.0, 0.1, 0.1, 0.0, 0.0])
    own, none = np.array([False, local]), np.zeros(2, bool)
    refit = RefitWithoutPart(fitted, jacobian, np.array([4, 5]), none, own)
    found = FunctionProblem("", lambda x: fitted + jacobian @ x, (0.0, 0.0), np.nan).solve(refit)
    assert found.cost == pytest.approx(left, rel=0.01, abs=1e-9)


@pytest.mark.parametrize(("strength", "bounded"), [(-1.0, True), (0.2, True), (6.0, False)])
def test_a_negative_damping_that_runs_away_is_refused(strength, bounded):
    """der(v) += k v with c / m = 0.5: from k = 0.5 on the oscillation grows."""
    problem = measured(missing_effect_problem(NAME), 0.01)
    settings = LoopSettings(forms=("linear",), sites=("der(v)",))
    with opened(problem) as bench:
        trusted = unfitted(bench)
        given = problem, bench.fitter.description, bench.fitter.trajectories(trusted)
        (linear,) = [c for c in make_candidates(*given, [], settings) if c.own]
        grown = unfitted(bench, trusted.start.plus(linear, (strength,)))
        assert stays_bounded(bench.fitter, grown, trusted) is bounded
        assert stays_bounded(bench.fitter, grown, grown)


NOISE = 0.01
SETTINGS = LoopSettings(forms=("constant",), sites=("der(speed)",), draws=100)


@pytest.fixture(scope="module")
def pendulum():
    return measured(missing_effect_problem("pendulum", signals=()), NOISE)


@pytest.mark.parametrize(
    "starts", [{"G": 6.0}, {"G": 0.7}, pytest.param({"J": 0.04}, marks=pytest.mark.slow)]
)
def test_a_pendulum_that_starts_at_a_wrong_frequency(pendulum, starts):
    problem = started(pendulum, **starts)
    stuck = fit(problem)
    assert stuck.errors[0].rmse_after > 10.0 * NOISE
    seen = detect(problem, settings=SETTINGS)
    assert seen.rms["y"] == pytest.approx(NOISE, rel=0.1)
    assert not seen.missing


def test_values_of_each_experiment_grow_along(pendulum):
    """Starting angles of their own, which the shortened ones know under other names."""
    angle = replace(
        pendulum.parameters[0], name="angle0", variable="angle", per="experiment",
        start=0.3, bounds=(-2.0, 2.0),
    )  # fmt: skip
    runs = tuple(replace(e, values=()) for e in pendulum.experiments)
    model = replace(pendulum.model, parameters=(*pendulum.model.parameters, "angle"))
    parameters = (*started(pendulum, G=6.0).parameters, angle)
    problem = replace(pendulum, model=model, experiments=runs, parameters=parameters)
    found = close_loop(problem, settings=SETTINGS)
    assert found.verdict == "none"
    assert found.x["G"] == pytest.approx(2.0, rel=0.01)
    for e in range(2):
        assert found.x[f"angle0[e{e}]"] == pytest.approx(0.5, abs=0.01)


def test_a_model_that_cannot_be_simulated_says_so(pendulum):
    mass, *others = pendulum.parameters
    broken = replace(mass, start=-1.0, bounds=(-2.0, -0.5))
    with pytest.raises(ProblemError, match="cannot be simulated"):
        detect(replace(pendulum, parameters=(broken, *others)), settings=SETTINGS)
