"""What an effect must pass: against real refits, and runaways."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    started,
    unfitted,
)

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.selection.accept import _left_out, predict, stays_bounded
from cluster_est.closed_loop.selection.declared_model import THOROUGH
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.thresholds import AcceptanceThresholds
from cluster_est.closed_loop.workbench import FitStart
from cluster_est.methods.given_points import GivenPoints
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.search_state import SearchRequest

NAME = "mass_spring_damper"


def fitted_to(problem, bench):
    (fitted,) = bench.fit(LoopStage.DECLARED_MODEL, [FitStart(problem, {})], THOROUGH)
    return fitted


def by_refits(problem, bench):
    """Each experiment's sum of squares, predicted by a real fit to all others."""
    squares = []
    for e in range(len(problem.experiments)):
        others = tuple(i for i in range(len(problem.experiments)) if i != e)
        space = make_space(problem, others)
        (solution,) = bench.runner.run([SearchRequest("refit", LeastSquares(), space)])
        left_out = make_space(problem, (e,), starts=space.estimates(solution.x))
        look = GivenPoints(left_out.start[None, :], "left out")
        (seen,) = bench.runner.run([SearchRequest("left out", look, left_out)])
        squares.append(float(np.sum(seen.evaluations[0].residuals ** 2)))
    return np.array(squares)


@pytest.mark.parametrize("noise", [0.003, 0.03])
def test_a_left_out_experiment_is_predicted_as_by_a_real_refit(noise):
    problem = measured(missing_effect_problem(NAME, experiments=4), noise)
    with opened(problem) as bench:
        found = predict(bench, fitted_to(problem, bench))
        np.testing.assert_allclose(found.squares, by_refits(problem, bench), rtol=0.01)


def test_a_left_out_experiment_of_a_wrong_model_too():
    """Another spring in each experiment, so that the fits without one of them differ."""
    problem = missing_effect_problem(NAME, experiments=4)
    runs = []
    for e, k in enumerate((26.0, 29.0, 31.0, 33.0)):
        stiff = replace(
            problem,
            parameters=(
                problem.parameters[0],
                replace(problem.parameters[1], start=k),
                problem.parameters[2],
            ),
        )
        runs.append(measured(stiff, 0.003).experiments[e])
    problem = replace(problem, experiments=tuple(runs))
    with opened(problem) as bench:
        fitted = fitted_to(problem, bench)
        found = predict(bench, fitted)
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
        found = predict(bench, fitted_to(problem, bench))
    for quarter in range(4):
        left = np.digitize(output.times, [1.5, 3.0, 4.5]) == quarter
        kept = replace(output, times=output.times[~left], values=output.values[~left])
        with opened(replace(problem, experiments=(replace(run, outputs=(kept,)),))) as bench:
            estimates = fitted_to(bench.problem, bench).estimates
        with opened(started(problem, **estimates)) as bench:
            truth.append(float(np.sum(unfitted(bench).residuals[left] ** 2)))
    np.testing.assert_allclose(found.squares, truth, rtol=0.02)


def test_what_belongs_to_the_left_out_experiment_follows_the_rest():
    """As in held-out experiments: their own initial states are fitted to them."""
    problem = measured(missing_effect_problem(NAME, experiments=3, local=("c",)), 0.03)
    with opened(problem) as bench:
        fitted = fitted_to(problem, bench)
        found = predict(bench, fitted)
        truth = []
        for e in range(3):
            others = make_space(problem, tuple(i for i in range(3) if i != e))
            (solution,) = bench.runner.run([SearchRequest("refit", LeastSquares(), others)])
            known = others.estimates(solution.x)
            shared = tuple(
                replace(p, start=known[p.name], fixed=True) if p.name in known else p
                for p in problem.parameters
            )
            own = make_space(replace(problem, parameters=shared), (e,))
            (alone,) = bench.runner.run([SearchRequest("own", LeastSquares(), own)])
            truth.append(alone.cost)
    np.testing.assert_allclose(found.squares, truth, rtol=0.01)
    points = _left_out(fitted, bench.records.of_experiment(1), AcceptanceThresholds())
    moved = dict(zip((u.label for u in fitted.space.unknowns), points[0] != fitted.x, strict=True))
    assert moved["c[e1]"]
    assert moved["m"]
    assert moved["k"]


def test_a_step_of_a_logarithm_is_bounded_by_itself_not_by_the_value():
    """A parameter of 1e-6: its logarithm is -14, half of which would be a factor of 1000."""
    problem = missing_effect_problem(NAME, experiments=2)
    small = tuple(replace(p, scale="log", start=1e-6, lower=1e-12, upper=1.0)
                  for p in problem.parameters)  # fmt: skip
    problem = replace(problem, parameters=small)
    space = make_space(problem, (0, 1))
    size = sum(run.size for run in problem.experiments)
    matrix = np.random.default_rng(0).normal(size=(size, 3))
    with opened(missing_effect_problem(NAME)) as bench:
        far = replace(
            unfitted(bench), space=space, x=space.start, jacobian=matrix,
            residuals=matrix @ [100.0, -100.0, 100.0],
        )  # fmt: skip
    step = _left_out(far, np.arange(size // 2), AcceptanceThresholds())[0] - far.x
    np.testing.assert_allclose(step, [-0.5, 0.5, -0.5])


@pytest.mark.parametrize(("strength", "bounded"), [(-1.0, True), (0.2, True), (6.0, False)])
def test_a_negative_damping_that_runs_away_is_refused(strength, bounded):
    """der(v) += k v with c / m = 0.5: from k = 0.5 on the oscillation grows."""
    problem = measured(missing_effect_problem(NAME), 0.01)
    with opened(problem) as bench:
        trusted = unfitted(bench)
        (linear,) = [
            c
            for c in make_candidates(
                problem, bench.description, bench.trajectories(trusted), [],
                LoopSettings(forms=("linear",), sites=("der(v)",)),
            )
            if c.own
        ]  # fmt: skip
        grown = unfitted(bench, trusted.start.plus(linear, (strength,)))
        assert stays_bounded(bench, grown, trusted) is bounded
        assert stays_bounded(bench, grown, grown)
