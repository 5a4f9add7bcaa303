"""First steps of candidates: those of the linear model, in part where that does not hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, opened

from cluster_est.closed_loop.screening.ranking import rank
from cluster_est.closed_loop.selection.declared_model import fit_declared
from cluster_est.closed_loop.selection.refinement.first_steps import first_steps
from cluster_est.closed_loop.selection.refinement.useful_fit import UsefulFit
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.thresholds import LoopThresholds, RefinementThresholds
from cluster_est.closed_loop.workbench import FitStart

SHIFT = 0.3


def shifted():
    """A spring whose sensor shows a little too much: a bias at the output, exactly linear."""
    problem = measured(missing_effect_problem("mass_spring_damper", signals=()), 0.01)
    runs = [
        replace(run, outputs=tuple(replace(o, values=o.values + SHIFT) for o in run.outputs))
        for run in problem.experiments
    ]
    return replace(problem, experiments=tuple(runs))


def stepped(share):
    """The first step of the bias with that threshold, what it cost, and the fit before."""
    thresholds = LoopThresholds(refinement=RefinementThresholds(actual_reduction=share))
    settings = LoopSettings(forms=("bias",), thresholds=thresholds)
    with opened(shifted(), settings) as bench:
        current = fit_declared(bench, FitStart(bench.problem, {}))
        ranking = rank(bench, current)
        (leader,) = [
            i for i, t in enumerate(ranking.trials) if str(t.candidate.site).startswith("output")
        ]
        before = bench.runner.simulations
        (step,) = first_steps(bench, current, ranking, [leader])
        return step, (bench.runner.simulations - before) / len(bench.train), current


def test_a_step_that_does_what_was_predicted_is_not_shortened():
    step, simulated, current = stepped(0.5)
    assert simulated == 1
    assert step.sse < 0.01 * current.sse
    assert step.sse == pytest.approx(step.asked.predicted, rel=0.3)
    (shift,) = [v for k, v in step.start.values.items() if k.startswith("bias")]
    assert shift == pytest.approx(SHIFT, rel=0.05)


def test_a_step_that_does_less_is_tried_in_part():
    whole, _, _ = stepped(0.5)
    step, simulated, _ = stepped(1.5)
    assert simulated == len(RefinementThresholds().step_lengths)
    assert step.sse == whole.sse


def test_one_that_only_gets_worse_starts_from_nothing():
    """Steps that are far too long overshoot a bias; it is as good as the model without it then."""
    thresholds = LoopThresholds(refinement=RefinementThresholds(step_lengths=(40.0, 20.0)))
    with opened(shifted(), LoopSettings(forms=("bias",), thresholds=thresholds)) as bench:
        current = fit_declared(bench, FitStart(bench.problem, {}))
        ranking = rank(bench, current)
        (leader,) = [
            i for i, t in enumerate(ranking.trials) if str(t.candidate.site).startswith("output")
        ]
        (step,) = first_steps(bench, current, ranking, [leader])
    assert step.sse == current.sse
    (shift,) = [p for p in step.start.problem.parameters if p.name.startswith("bias")]
    assert shift.start == 0.0
    assert step.start.values == current.estimates


def test_what_cannot_hope_to_be_useful_is_not_simulated():
    with opened(shifted(), LoopSettings(forms=("bias",))) as bench:
        current = fit_declared(bench, FitStart(bench.problem, {}))
        ranking = rank(bench, current)
        leaders = list(range(len(ranking.trials)))
        before = bench.runner.simulations
        assert leaders
        assert not first_steps(bench, current, ranking, leaders, UsefulFit(criterion=-1e9))
        assert bench.runner.simulations == before


def test_the_linear_model_leaves_what_a_regression_on_all_columns_leaves():
    """A bias of the sensor is a column of ones beside the sensitivities."""
    step, _, current = stepped(0.5)
    columns = np.column_stack([current.jacobian, np.ones(len(current.residuals))])
    left = np.linalg.lstsq(columns, current.residuals)[1]
    assert step.asked.predicted == pytest.approx(float(left[0]), rel=1e-6)
