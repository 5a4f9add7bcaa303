"""Problems that are made and changed in Python: parameters by name, costs, functions, indices."""

import threading
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from support.problems.springs import FMU, spring_problem

import cluster_est as ce
from cluster_est.errors import DataError, ProblemError
from cluster_est.problem.costs import SumSquared


@pytest.fixture(scope="module")
def problem():
    return spring_problem(experiments=2, samples=60, noise=0.002).problem


def by_name(problem):
    return {p.name: p for p in problem.parameters}


def test_parameters_are_fixed_freed_and_moved_by_name(problem):
    held = problem.with_values({"c": 0.5, "m": 1.1}).fix("c", "x0")
    assert [p.fixed for p in held.parameters] == [False, False, True, True]
    assert (by_name(held)["c"].start, by_name(held)["m"].start) == (0.5, 1.1)
    assert list(ce.fit(held).x) == ["m", "k"]
    freed = held.free("c", bounds=(0.2, 5.0))
    assert (by_name(freed)["c"].fixed, by_name(freed)["c"].bounds) == (False, (0.2, 5.0))
    assert by_name(held.free("x0"))["x0"] == by_name(problem)["x0"]
    assert by_name(problem)["c"].start == 1.0  # a problem itself never changes


def test_a_prior_goes_with_what_is_fixed(problem):
    mass = replace(problem.parameters[0], prior=ce.NormalPrior(1.2, 0.1))
    held = replace(problem, parameters=(mass, *problem.parameters[1:])).fix("m")
    assert by_name(held)["m"].prior is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda p: p.fix("K"), "parameters: there is no 'K'"),
        (lambda p: p.free("R"), "parameters: there is no 'R'"),
        (lambda p: p.with_values({"x0[e0]": 1.0}), r"parameters: there is no 'x0\[e0\]'"),
        (lambda p: p.with_values({"m": 100.0}), r"parameters.m.start: must lie within the bounds"),
        (lambda p: p.with_values([1.0]), 'with_values: must be.*such as {"k": 25.0}'),
        (
            lambda p: p.free("k", bounds=(1.0, 2.0)),
            "parameters.k.start: must lie within the bounds",
        ),
    ],
)
def test_a_wrong_name_or_value_is_met_with_a_sentence(problem, change, said):
    with pytest.raises(ProblemError, match=said):
        change(problem)


def test_parameters_are_listed_once(problem):
    made = ce.Problem(ce.read_model(FMU), problem.parameters, problem.experiments)
    assert made.model.parameters == ("m", "k", "c", "x")
    assert made.describe().variables["m"].unit == "kg"


def test_a_cost_may_be_a_name_or_a_function(problem):
    assert replace(problem, cost="huber").cost == ce.HuberCost()
    assert replace(problem, cost="SSE").cost == SumSquared()
    squares = ce.fit(problem)
    scale = 3.0
    by_function = replace(problem, cost=lambda r: scale * float(np.sum(r**2)))
    found = ce.fit(by_function, "sqp")
    assert found.cost == pytest.approx(scale * squares.cost, rel=1e-6)
    assert found.x["k"] == pytest.approx(squares.x["k"], rel=1e-4)
    with pytest.raises(ProblemError, match=r"least_squares needs residuals.*'function'"):
        ce.fit(by_function)
    with pytest.raises(ProblemError, match=r"there is no 'hubber'.*'huber'"):
        replace(problem, cost="hubber")
    with pytest.raises(ProblemError, match=r"problem.cost: must return one number.*returned"):
        ce.fit(replace(problem, cost=lambda r: r), "sqp")


def with_function(problem, function):
    runs = (replace(e, cost_function=function) for e in problem.experiments)
    return replace(problem, experiments=tuple(runs))


@pytest.mark.parametrize(
    "executor", ["local", "processes", pytest.param("ray", marks=pytest.mark.slow)]
)
def test_a_lambda_takes_the_place_of_residuals_on_every_executor(problem, executor):
    weight = 2.0
    changed = with_function(problem, lambda run: weight * run.residuals("y"))
    found = ce.fit(changed, resources={"executor": executor, "workers": 2})
    usual = ce.fit(problem)
    assert found.cost == pytest.approx(4.0 * usual.cost, rel=1e-6)
    assert found.x == pytest.approx(usual.x, rel=1e-5)


def test_a_function_that_returns_one_number_is_the_cost_of_its_experiment(problem):
    def total(run):
        return float(np.sum(run.residuals("y") ** 2))

    found = ce.fit(replace(with_function(problem, total), cost="total"), "sqp")
    assert found.cost == pytest.approx(ce.fit(problem).cost, rel=1e-6)


def test_a_function_that_fails_is_named(problem):
    found = ce.simulate(with_function(problem, lambda run: run.nothing))
    assert "<lambda> failed (AttributeError" in found["e0"].outcome.message


def test_what_cannot_leave_the_process_is_refused(problem):
    lock = threading.Lock()
    with pytest.raises(
        DataError, match=r"'e0'.cost_function: .*contains an object.*lock.*create that object"
    ):
        replace(problem.experiments[0], cost_function=lambda run: lock)
    with pytest.raises(DataError, match=r"cost_function: must be a UserFunction.*3"):
        replace(problem.experiments[0], cost_function=3)


def test_a_function_is_a_constraint_too(problem):
    def limit(run):
        return float(np.max(np.abs(run.simulated["y"]))) - 0.1

    (first, *others) = problem.experiments
    changed = replace(first, constraint_functions=[limit])
    assert changed.constraint_names == ("limit",)
    found = ce.fit(replace(problem, experiments=(changed, *others)))
    (row,) = found.constraints
    assert row.satisfied


TIMES = pd.Timestamp("2026-03-01 10:00") + pd.to_timedelta(0.1 * np.arange(50), unit="s")
VALUES = {"force": np.ones(50), "position": np.linspace(0.0, 1.0, 50)}
GIVEN = {"id": "a", "inputs": {"F": "force"}, "outputs": {"y": "position"}, "sigma": 0.001}


@pytest.mark.parametrize(
    ("frame", "time"),
    [
        (pd.DataFrame(VALUES, index=TIMES), None),
        (pd.DataFrame(VALUES, index=TIMES.tz_localize("UTC")), None),
        (pd.DataFrame(VALUES, index=TIMES - TIMES[0]), None),
        (pd.DataFrame(VALUES, index=pd.Index(0.1 * np.arange(50), name="t")), None),
        (pd.DataFrame(VALUES, index=0.1 * np.arange(50)), None),
        (pd.DataFrame(VALUES | {"when": TIMES}), "when"),
        (pd.DataFrame(VALUES | {"since": TIMES - TIMES[0]}), "since"),
    ],
    ids=[
        "timestamps",
        "of a zone",
        "durations",
        "named",
        "seconds",
        "a column",
        "durations in one",
    ],
)
def test_the_time_is_a_column_or_the_index(frame, time):
    run = ce.Experiment.from_table(frame, time=time, **GIVEN)
    np.testing.assert_allclose(run.outputs[0].times, 0.1 * np.arange(50), atol=1e-9)
    assert (run.start, run.stop) == (0.0, pytest.approx(4.9))


def test_numbers_of_rows_are_no_time():
    with pytest.raises(DataError, match=r"must have either time.*or sample_time"):
        ce.Experiment.from_table(pd.DataFrame(VALUES), **GIVEN)


def test_simulations_are_reached_by_name_and_come_as_frames(problem):
    found = ce.simulate(problem, values={"m": 1.3})
    assert list(found) == ["e0", "e1"]
    frame = found["e1"].to_frame()
    assert list(frame.columns) == ["time", "y"]
    assert frame["time"].iloc[-1] == problem.experiments[1].stop
    broken = ce.simulate(with_function(problem, lambda run: 1.0 / 0.0))
    with pytest.raises(ProblemError, match=r"simulation: .*ZeroDivisionError"):
        broken["e0"].to_frame()
