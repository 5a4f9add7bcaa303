"""The data of the fits are exact, from the matrix exponential."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import FMU, TRUE
from support.truth.exact_linear import position
from support.truth.systems_with_missing_effects import missing_effect_problem

import cluster_est as ce
from cluster_est.results.solver_error.finer_solver import (
    solver_scale,
    step_never_taken,
    usual_interval,
)

EVERY = 0.3
TIMES = EVERY * np.arange(40.0)


def spring(solver, *, sigma=1.0, interface="model_exchange"):
    """A mass that swings freely, seen at few times."""
    measured = position(TIMES, np.zeros(len(TIMES)), **TRUE, x0=1.0, v0=0.0)
    output, known = ce.Output("y", TIMES, measured, sigma), (("x", 1.0), ("m", TRUE["m"]))
    run = ce.Experiment("e", 0.0, float(TIMES[-1]), (), (output,), values=known)
    model = ce.Model(FMU.name, FMU.read_bytes(), interface, solver, ("m", "k", "c", "x"))
    given = {"m": (1.0,), "k": (28.0, (1.0, 100.0)), "c": (0.5, (0.0, 10.0)), "x": (0.0,)}
    return ce.Problem(model, [ce.Parameter(name, *g) for name, g in given.items()], [run])


def too_long(result):
    return [note for note in result.notes if "too long" in note]


def test_a_step_that_bends_the_parameters_is_named_with_what_to_set():
    problem = spring(ce.Solver("rk4"))
    result = ce.fit(problem)
    assert result.success
    assert abs(result.x["k"] / TRUE["k"] - 1.0) > 0.01
    (said,) = too_long(result)
    found = re.search(
        rf"step of {EVERY} s is too long.*error in y that .*model.step = ([\d.]+)", said
    )
    assert result.facts()["solver_error"]["experiments"] == 1
    model = replace(problem.model, solver=ce.Solver("rk4", float(found[1])))
    assert not too_long(ce.fit(replace(problem, model=model)))


def test_it_is_said_of_a_fit_that_has_not_converged_too():
    result = ce.fit(spring(ce.Solver("rk4")), ce.LeastSquares(max_iterations=1))
    assert not result.success
    assert too_long(result)


def test_a_sigma_that_is_given_decides_what_is_noticed():
    """An error of some per cent of the signal hides in noise as large as the signal."""
    loud = ce.fit(spring(ce.Solver("rk4", 0.1), sigma=10.0))
    assert loud.solver_error is not None
    assert loud.solver_error.sentences == ()


def test_a_solver_with_a_tolerance_is_not_asked():
    assert ce.fit(spring(ce.Solver("dormand_prince", rtol=1e-6))).solver_error is None


def test_communication_steps_are_measured_too():
    result = ce.fit(spring(ce.Solver("fmu"), interface="co_simulation"))
    assert result.solver_error is not None
    assert result.solver_error.scale.name == f"the communication step of {EVERY} s"


EXCHANGE = missing_effect_problem("mass_spring_damper")
TOGETHER = missing_effect_problem("mass_spring_damper", interface="co_simulation")
DESCRIPTION = EXCHANGE.describe()
FIXED = replace(DESCRIPTION, variable_steps=False, fixed_internal_step=None, default_step=None)
INTERVAL = 0.01


def scale(problem, solver, description=DESCRIPTION):
    model = replace(problem.model, solver=solver)
    return solver_scale(model, description, problem.experiments)


def never(problem, solver, description=DESCRIPTION):
    model = replace(problem.model, solver=solver)
    return step_never_taken(model, description, problem.experiments)


def test_a_tolerance_is_divided_by_a_hundred_with_the_absolute_one():
    found = scale(EXCHANGE, ce.Solver("dormand_prince", rtol=1e-3, atol=1e-5))
    assert found.name == "the tolerance model.rtol = 0.001"
    finer = found.finer()
    assert finer.rtol == pytest.approx(1e-5)
    assert finer.atol == pytest.approx(1e-7)
    assert finer.step == pytest.approx(INTERVAL / 2.0)  # or samples close together would decide
    assert not found.can_be_finer_twice()


def test_no_tolerance_is_tighter_than_the_tightest():
    found = scale(EXCHANGE, ce.Solver("cvode", rtol=1e-13))
    assert "double precision" in found.why_not


@pytest.mark.parametrize(
    ("problem", "solver", "step"),
    [
        (EXCHANGE, ce.Solver("rk4"), INTERVAL),
        (EXCHANGE, ce.Solver("rk4", step=0.004), 0.004),
        (TOGETHER, ce.Solver("fmu", step=10.0 * INTERVAL), INTERVAL),
    ],
)
def test_no_step_is_longer_than_the_interval_of_the_data(problem, solver, step):
    found = scale(problem, solver)
    assert found.step == pytest.approx(step)
    assert found.finer().step == pytest.approx(step / 2.0)
    assert found.finer(2).step == pytest.approx(step / 4.0)


def test_a_step_that_is_never_taken_is_named():
    assert "model.step = 0.1 has no effect" in never(TOGETHER, ce.Solver("fmu", step=0.1))
    assert never(TOGETHER, ce.Solver("fmu", step=0.1), FIXED) == ""
    assert never(TOGETHER, ce.Solver("fmu", step=INTERVAL)) == ""
    assert never(TOGETHER, ce.Solver("fmu")) == ""


def test_a_tolerance_for_the_fmu_is_tightened_along_with_the_step():
    finer = scale(TOGETHER, ce.Solver("fmu", rtol=1e-3)).finer()
    assert (finer.step, finer.rtol) == pytest.approx((INTERVAL / 2.0, 1e-5))


def test_a_fixed_step_is_halved_only_where_a_user_has_chosen_it():
    assert "communicates with a fixed step" in scale(TOGETHER, ce.Solver("fmu"), FIXED).why_not
    own = scale(TOGETHER, ce.Solver("fmu"), replace(FIXED, fixed_internal_step=0.02))
    assert own.name == "the communication step of 0.02 s"
    assert own.why_not
    chosen = scale(TOGETHER, ce.Solver("fmu", step=0.1), FIXED)
    assert chosen.name == "the communication step of 0.1 s"
    assert chosen.finer().step == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("own", "steps", "twice"), [(0.05, 2.0, False), (0.02, 5.0, False), (0.025, 2.0, True)]
)
def test_steps_of_an_fmu_with_a_step_of_its_own_are_multiples_of_it(own, steps, twice):
    found = scale(TOGETHER, ce.Solver("fmu", step=0.1), replace(FIXED, fixed_internal_step=own))
    assert (found.ratio, found.can_be_finer_twice()) == (steps, twice)
    multiple = found.finer().step / own
    assert multiple == pytest.approx(round(multiple))


@pytest.mark.parametrize("own", [0.1, 0.03])
def test_a_step_of_its_own_that_no_shorter_one_is_a_multiple_of_stays(own):
    description = replace(FIXED, fixed_internal_step=own)
    assert scale(TOGETHER, ce.Solver("fmu", step=0.1), description).why_not


def test_what_to_set_follows_from_the_order():
    alone = replace(FIXED, offers=tuple(o for o in FIXED.offers if o.interface != "model_exchange"))
    step = scale(TOGETHER, ce.Solver("fmu", step=0.1), alone)
    assert step.advice(7.0, 1.0) == "model.step = 0.0125"
    assert step.advice(7.0, 2.0) == "model.step = 0.025"
    own = scale(TOGETHER, ce.Solver("fmu", step=0.1), replace(alone, fixed_internal_step=0.02))
    assert own.advice(2.0, 1.0) == "model.step = 0.04"
    assert own.advice(1000.0, 1.0) == "model.step = 0.02"
    both = scale(TOGETHER, ce.Solver("fmu", step=0.1), FIXED)
    assert both.advice(7.0, 1.0) == 'model.step = 0.0125 (or model.interface = "model_exchange")'
    rtol = scale(EXCHANGE, ce.Solver("dormand_prince", rtol=1e-3))
    assert rtol.advice(30.0, np.nan) == "model.rtol = 1e-05"


def test_the_usual_interval_is_not_that_of_two_times_that_rounding_keeps_apart():
    times = np.arange(0.0, 1.0, 0.1)
    late = ce.Input("F", times + 1e-9, 0.0 * times)
    run = ce.Experiment("e", 0.0, 0.9, (late,), (ce.Output("y", times, 0.0 * times),))
    assert usual_interval([run]) == pytest.approx(0.1, abs=1e-6)
