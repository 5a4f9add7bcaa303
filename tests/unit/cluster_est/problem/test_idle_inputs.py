"""Inputs without data keep their start values, and a note says so."""

from __future__ import annotations

from dataclasses import replace

from support.problems.springs import spring_problem

from cluster_est.problem.idle_inputs import silent_inputs, silent_notes

PROBLEM = spring_problem(experiments=2).problem


def without_force(ids):
    runs = tuple(replace(run, inputs=()) if run.id in ids else run for run in PROBLEM.experiments)
    return replace(PROBLEM, experiments=runs)


def test_an_input_that_nothing_drives_in_any_experiment_is_named():
    problem = without_force(("e0", "e1"))
    (note,) = silent_notes(problem, problem.describe())
    assert note.startswith("input F (0 N) has no data and keeps its start value; inputs.F = ")


def test_one_that_is_driven_somewhere_is_not():
    for problem in (PROBLEM, without_force(("e0",))):
        assert silent_notes(problem, problem.describe()) == ()


def test_a_value_of_its_own_or_a_parameter_drives_an_input():
    problem = without_force(("e0", "e1"))
    runs = tuple(replace(run, values=(("F", 1.0),)) for run in problem.experiments)
    valued = replace(problem, experiments=runs)
    assert silent_inputs(valued, valued.describe()) == ()
    parameters = (*problem.parameters, replace(problem.parameters[0], name="F"))
    model = replace(problem.model, parameters=(*problem.model.parameters, "F"))
    driven = replace(problem, model=model, parameters=parameters)
    assert silent_inputs(driven, driven.describe()) == ()
