"""Experiments that begin elsewhere than the model: a spring's truth is its closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.results.initial_errors import (
    free_start_advice,
    initial_errors,
    initial_notes,
    noise_of_samples,
)

NOISE = 0.002
TRUTH = spring_problem(noise=NOISE)
STARTS = np.array([TRUTH.values[f"x0[e{e}]"] for e in range(5)])


def at_the_truth(*, sigma=NOISE, **starts):
    """The springs with their true parameters; initial positions only as they are given."""
    parameters = [ce.Parameter(name, value, 0.0, 100.0) for name, value in TRUE.items()]
    runs = tuple(
        replace(
            run,
            outputs=tuple(replace(o, sigma=sigma) for o in run.outputs),
            values=(("x", starts[run.id]),) if run.id in starts else (),
        )
        for run in TRUTH.problem.experiments
    )
    if starts:
        parameters.append(ce.Parameter("x", 0.0, -1.0, 1.0, fixed=True))
    names = tuple(p.target for p in parameters)
    model = replace(TRUTH.problem.model, parameters=names)
    return replace(TRUTH.problem, model=model, parameters=tuple(parameters), experiments=runs)


@pytest.mark.parametrize("fitted", [False, True])
@pytest.mark.parametrize("sigma", [NOISE, 1.0])
def test_a_spring_that_was_let_go_elsewhere_is_off_by_that_much(fitted, sigma):
    problem = at_the_truth(sigma=sigma)
    (found,) = initial_errors(problem, ce.simulate(problem), fitted=fitted)
    assert found.output == "y"
    assert found.unit == "m"
    assert found.count == 5
    assert found.distance == pytest.approx(np.abs(STARTS).max(), abs=4 * NOISE)
    assert found.over_noise == pytest.approx(found.distance / NOISE, rel=0.6)
    assert found.sentence.startswith(f"{found.found} of 5 experiments begin elsewhere")


def test_where_the_starts_are_right_nothing_is_said():
    starts = {f"e{e}": float(x) for e, x in enumerate(STARTS)}
    problem = at_the_truth(**starts)
    assert initial_errors(problem, ce.simulate(problem), fitted=False) == ()
    assert initial_notes(problem, ce.simulate(problem)) == ()


def test_where_the_starts_are_estimated_nothing_is_said():
    simulations = ce.simulate(TRUTH.problem)  # all of them at 0, from where a fit begins
    assert initial_errors(TRUTH.problem, simulations, fitted=False) == ()


def test_less_than_half_of_the_experiments_say_nothing():
    starts = {f"e{e}": float(x) for e, x in enumerate(STARTS)} | {"e0": float(STARTS[0]) + 0.3}
    problem = at_the_truth(**starts)
    assert initial_errors(problem, ce.simulate(problem), fitted=False) == ()


def test_an_offset_that_stays_is_no_matter_of_the_start():
    starts = {f"e{e}": float(x) for e, x in enumerate(STARTS)}
    problem = at_the_truth(**starts)
    runs = tuple(
        replace(run, outputs=tuple(replace(o, values=o.values + 0.3) for o in run.outputs))
        for run in problem.experiments
    )
    shifted = replace(problem, experiments=runs)
    assert initial_errors(shifted, ce.simulate(shifted), fitted=True) == ()


def test_the_note_of_a_fit_names_the_states_that_may_be_estimated():
    problem = at_the_truth()
    (note,) = ce.fit(problem).notes[:1]
    assert "experiments begin elsewhere than the model: at the first sample y is up to" in note
    assert 'parameters.x = { start = 0, per = "experiment" }' in note
    assert 'parameters.v = { start = 0, per = "experiment" }' in note
    assert "values.x = NUMBER" in free_start_advice(problem)


def test_the_noise_of_a_signal_is_that_of_its_second_differences():
    t = np.linspace(0.0, 1.0, 4000)
    values = np.sin(3.0 * t) + 0.05 * np.random.default_rng(1).standard_normal(4000)
    assert noise_of_samples(values) == pytest.approx(0.05, rel=0.1)
    assert noise_of_samples(values[:3]) == 0.0
