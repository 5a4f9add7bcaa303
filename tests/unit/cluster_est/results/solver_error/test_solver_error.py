"""A fit with too long a step says so; the data are exact, from the matrix exponential."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import FMU, TRUE
from support.truth.exact_linear import position

from cluster_est import (
    Experiment,
    LeastSquares,
    Model,
    Output,
    Parameter,
    Problem,
    Result,
    Solver,
    fit,
)

EVERY = 0.3
TIMES = EVERY * np.arange(40.0)


def spring(solver: Solver, *, sigma: float = 1.0, interface: str = "model_exchange") -> Problem:
    """A mass that swings freely, seen at few times."""
    measured = position(TIMES, np.zeros(len(TIMES)), **TRUE, x0=1.0, v0=0.0)
    output, known = Output("y", TIMES, measured, sigma), (("x", 1.0), ("m", TRUE["m"]))
    run = Experiment("e", 0.0, float(TIMES[-1]), (), (output,), values=known)
    model = Model(FMU.name, FMU.read_bytes(), interface, solver, ("m", "k", "c", "x"))
    parameters = [
        Parameter("m", 1.0),
        Parameter("k", 28.0, 1.0, 100.0),
        Parameter("c", 0.5, 0.0, 10.0),
        Parameter("x", 0.0),
    ]
    return Problem(model, parameters, [run])


def too_long(result: Result) -> list[str]:
    return [note for note in result.notes if "too long" in note]


def test_a_step_that_bends_the_parameters_is_named_with_what_to_set():
    problem = spring(Solver("rk4"))
    result = fit(problem)
    assert result.success
    assert abs(result.x["k"] / TRUE["k"] - 1.0) > 0.01
    (said,) = too_long(result)
    found = re.search(
        rf"step of {EVERY} s is too long.*error in y of .*model.step = ([\d.]+)", said
    )
    assert result.facts()["solver_error"]["experiments"] == 1
    model = replace(problem.model, solver=Solver("rk4", float(found[1])))
    assert not too_long(fit(replace(problem, model=model)))


def test_nothing_is_said_of_a_step_that_is_short_enough():
    result = fit(spring(Solver("rk4", 0.01)))
    assert result.solver_error is not None
    assert result.solver_error.sentences == ()
    assert result.x["k"] == pytest.approx(TRUE["k"], rel=1e-4)


def test_it_is_said_of_a_fit_that_has_not_converged_too():
    result = fit(spring(Solver("rk4")), LeastSquares(max_iterations=1))
    assert not result.success
    assert too_long(result)


def test_a_sigma_that_is_given_decides_what_is_noticed():
    """An error of some per cent of the signal hides in noise as large as the signal."""
    loud = fit(spring(Solver("rk4", 0.1), sigma=10.0))
    assert loud.solver_error is not None
    assert loud.solver_error.sentences == ()


def test_a_solver_with_a_tolerance_is_not_asked():
    assert fit(spring(Solver("dormand_prince", rtol=1e-6))).solver_error is None


def test_communication_steps_are_measured_too():
    result = fit(spring(Solver("fmu"), interface="co_simulation"))
    assert result.solver_error is not None
    assert result.solver_error.scale.name == f"the communication step of {EVERY} s"
