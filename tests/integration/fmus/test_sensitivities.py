"""Derivatives carried along with a simulation: right by complex steps, and chosen by a clock."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.thinning import thinned

from cluster_est import Experiment, Input, Output, Parameter, Problem, Solver, fit
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.sqp.sqp import Sqp
from cluster_est.preflight.solver_checks import sensitivities
from cluster_est.preflight.subject import CheckSubject, TimeBudget
from cluster_est.problem.search_space import make_space
from workers.evaluate import Evaluator
from workers.messages import Curve, FloatArray, Model, Outcome, SignalBound, Task
from workers.probes.probes import SensitivityCost, SensitivityCostProbe
from workers.process.trial import ProbeBench
from workers.wire import OutcomeColumns, TaskBatch

SOLVERS = [Solver("dormand_prince", rtol=1e-10), Solver("rk4", step=1e-3)]
TIMES = np.linspace(0.0, 5.0, 26)
RATES = tuple(f"{kind}{i}" for kind in "ab" for i in range(1, 6))


def measured(outputs: tuple[str, ...], times: FloatArray = TIMES, **options: object) -> Experiment:
    given = Input("u", np.array([0.0, 2.0, 5.0]), np.array([0.0, 1.0, 0.5]))
    columns = tuple(Output(name, times, 0.0 * times, 0.5) for name in outputs)
    return replace(Experiment("e", 0.0, 5.0, (given,), columns), **options)


def input_at(t: float) -> float:
    return 0.5 * t if t < 2.0 else 1.0 - (t - 2.0) / 6.0


def solved(slopes, x, times):
    """States at each time, complex where x is; no step goes across a kink of the input."""
    found = [x]
    for ends in pairwise(times):
        result = solve_ivp(slopes, ends, found[-1], "DOP853", rtol=1e-11, atol=1e-12)
        found.append(result.y[:, -1])
    return np.array(found)


def by_complex_steps(outputs: Callable[[np.ndarray], np.ndarray], point: FloatArray) -> np.ndarray:
    """(outputs, parameters): derivatives without a difference.

    W. Squire, G. Trapp, SIAM Rev. 40 (1998) 110-112, doi:10.1137/S003614459631241X.
    """
    size = 1e-30
    moved = [point + 1j * size * unit for unit in np.eye(len(point))]
    return np.stack([outputs(each).T.ravel().imag / size for each in moved], axis=1)


def van_der_pol(p: np.ndarray) -> np.ndarray:
    def slopes(t: float, x: np.ndarray) -> np.ndarray:
        return np.array([x[1], p[0] * (1.0 - x[0] ** 2) * x[1] - x[0] + input_at(t)])

    return solved(slopes, p[1:], TIMES)


def chain(p: np.ndarray) -> np.ndarray:
    a, b = p[:5], p[5:]

    def slopes(t: float, x: np.ndarray) -> np.ndarray:
        inflow = np.concatenate([[input_at(t)], a[:4] * x[:4]])
        return inflow - a * x - b * x**2

    x = solved(slopes, np.array([2.0, 0, 0, 0, 0]) + 0 * p[:5], TIMES)
    return np.column_stack([x, a[4] * x[:, 4]])


def decay(p: np.ndarray) -> np.ndarray:
    x = solved(lambda t, x: input_at(t) - p[0] * x, p[2:], TIMES)
    return p[1] * x


@pytest.fixture
def ask(own_fmu):
    """Have one point answered, as a worker would, and sent."""
    made: list[Evaluator] = []

    def give(
        name: str, fmi: int, experiment: Experiment, parameters: tuple[str, ...],
        point: FloatArray, solver: Solver = SOLVERS[0], want: str = "sensitivities",
        interface: str = "model_exchange",
    ) -> Outcome:  # fmt: skip
        model = Model(name, own_fmu(name, fmi).read_bytes(), interface, solver, parameters)
        made.append(Evaluator(model, (experiment,), "w"))
        batch = TaskBatch.of([Task(0, 0, point, want)])
        return OutcomeColumns.of(made[-1].evaluate(batch)).outcomes()[0]

    yield give
    for each in made:
        each.close()


CASES = {
    "van_der_pol": (("mu", "x0", "x1"), [1.3, 2.0, 0.4], ("x0", "x1"), van_der_pol),
    "chain": (
        RATES, [1.0, 0.8, 0.6, 0.5, 0.4, 0.1, 0.15, 0.2, 0.25, 0.3],
        ("x1", "x2", "x3", "x4", "x5", "y"), chain,
    ),
    "states_directional": (("k", "c", "x"), [1.2, 0.7, 1.5], ("y",), decay),
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "fmi", "solver"),
    thinned(
        [(name, fmi, solver) for solver in SOLVERS for fmi in (2, 3) for name in CASES],
        lambda name, *_: name,
    ),
    ids=str,
)
def test_against_complex_steps(ask, name, fmi, solver):
    parameters, point, outputs, truth = CASES[name]
    found = ask(name, fmi, measured(outputs), parameters, np.array(point), solver)
    expected = -by_complex_steps(truth, np.array(point)) / 0.5
    assert found.message == ""
    scale = np.abs(expected).max(axis=0)
    assert np.abs((found.sensitivities - expected) / scale).max() < 1e-6


@pytest.mark.parametrize(
    ("fmi", "solver"),
    [(2, SOLVERS[0]), pytest.param(3, SOLVERS[1], marks=pytest.mark.slow)],
    ids=str,
)
def test_the_trajectory_keeps_its_bits(ask, fmi, solver):
    given = "states_directional", fmi, measured(("y",)), ("k", "c", "x"), np.array([1.2, 0.7, 1.5])
    plain = ask(*given, solver, "residuals")
    again = [ask(*given, solver) for _ in range(2)]
    assert np.array_equal(again[0].residuals, plain.residuals)
    assert np.array_equal(again[0].sensitivities, again[1].sensitivities)


def test_curves_and_bounds_are_differentiated_too(ask):
    curve = Curve(
        ("x0", "x1"), np.array([[2.0, 0.0], [1.0, -1.0], [-1.0, -1.5]]), np.linspace(0, 5, 201)
    )
    bound = SignalBound("low", "x1", TIMES, np.full(26, -1.0), np.full(26, 9.0))
    run = replace(measured(()), curve=curve, bounds=(bound,))
    point, parameters = np.array([1.3, 2.0, 0.4]), ("mu", "x0", "x1")

    found = ask("van_der_pol", 2, run, parameters, point)

    def both(at: FloatArray) -> FloatArray:
        given = ask("van_der_pol", 2, run, parameters, at, want="residuals")
        return np.concatenate([given.residuals, given.constraints])

    steps = 1e-5 * np.eye(3)
    expected = np.stack([(both(point + h) - both(point - h)) / 2e-5 for h in steps], axis=1)
    assert found.sensitivities.shape == expected.shape == (4, 3)
    np.testing.assert_allclose(found.sensitivities, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("given", "options", "why"),
    [
        (("bouncing_ball", "height", "e"), {}, "does not provide directional derivatives"),
        (("van_der_pol", "y", "mu"), {"solver": Solver("cvode")}, "solver 'cvode'"),
        (
            ("van_der_pol", "y", "mu"),
            {"solver": Solver("fmu"), "interface": "co_simulation"}, "only in model exchange",
        ),
    ],
)  # fmt: skip
def test_it_says_why_there_are_none(ask, given, options, why):
    name, output, parameter = given
    asked = name, 2, replace(measured((output,)), inputs=()), (parameter,), np.array([0.8])
    found = ask(*asked, **options)
    assert found.ok
    assert found.sensitivities is None
    assert why in found.message
    plain = ask(*asked, want="residuals", **options)
    assert np.array_equal(found.residuals, plain.residuals)


def problem_of(own_fmu, ask, name, parameters, truth, outputs):
    """Two experiments with a little disturbance, to which the truth is no perfect fit."""
    names = tuple(p.name for p in parameters if not p.auxiliary)
    run = measured(outputs)
    exact = -0.5 * ask(name, 2, run, names, np.array(truth), want="residuals").residuals
    pieces = np.split(exact + 1e-3 * np.sin(7.0 * np.arange(len(exact))), len(outputs))
    columns = tuple(Output(n, TIMES, piece) for n, piece in zip(outputs, pieces, strict=True))
    runs = tuple(replace(run, id=label, outputs=columns) for label in ("e", "f"))
    model = Model(name, own_fmu(name, 2).read_bytes(), "model_exchange", SOLVERS[0], names)
    return Problem(model, parameters, runs)


def fitted(problem, method=LeastSquares):
    return [fit(problem, method(differences=how)) for how in ("auto", "sensitivities")]


@pytest.mark.parametrize("method", [LeastSquares, Sqp])
def test_ten_parameters_reach_the_same_minimum_in_fewer_simulations(own_fmu, ask, method):
    truth = [1.0, 0.8, 0.6, 0.5, 0.4, 0.1, 0.15, 0.2, 0.25, 0.3]
    factors = np.linspace(0.8, 1.3, 10)
    scales = ["linear"] * 5 + ["log"] * 5
    parameters = tuple(
        Parameter(name, value * factor, bounds=(1e-3, 5.0), scale=scale)
        for name, value, factor, scale in zip(RATES, truth, factors, scales, strict=True)
    )
    problem = problem_of(own_fmu, ask, "chain", parameters, truth, ("x1", "x2", "x3", "x4", "x5"))
    usual, carried = fitted(problem, method)
    assert carried.solution.message == ""
    assert carried.solution.cost == pytest.approx(usual.solution.cost, rel=1e-9)
    np.testing.assert_allclose(carried.solution.x, usual.solution.x, rtol=1e-5)
    assert carried.simulated < usual.simulated / 2


def test_local_tied_and_logarithmic_parameters(own_fmu, ask):
    parameters = (
        Parameter("mu", 1.0, bounds=(0.1, 10.0), scale="log"),
        Parameter("x0", 1.8, bounds=(0.0, 4.0), per="experiment"),
        Parameter("x1", 0.0, expression="0.2 * x0 * mu"),
    )
    problem = problem_of(own_fmu, ask, "van_der_pol", parameters, [1.3, 2.0, 0.52], ("y",))
    usual, carried = fitted(problem)
    assert carried.solution.message == ""
    np.testing.assert_allclose(carried.solution.x, usual.solution.x, rtol=1e-6)
    np.testing.assert_allclose(
        carried.solution.jacobian, usual.solution.jacobian,
        atol=1e-5 * np.abs(usual.solution.jacobian).max(),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["zero_directional", "wrong_directional"])
def test_derivatives_that_disagree_give_way_to_differences(own_fmu, ask, name):
    parameters = (Parameter("k", 0.8), Parameter("x", 1.4))
    problem = problem_of(own_fmu, ask, name, parameters, [1.2, 1.1], ("y",))
    usual, carried = fitted(problem)
    assert "directional derivatives differ from finite differences" in carried.solution.message
    assert np.array_equal(carried.solution.x, usual.solution.x)


@pytest.fixture
def problem(own_fmu):
    """Two parameters of an FMU that gives directional derivatives."""
    archive = own_fmu("states_directional", 2)
    model = Model(archive.name, archive.read_bytes(), "model_exchange", SOLVERS[0], ("k", "c"))
    times = np.linspace(0.0, 1.0, 3)
    run = Experiment("a", 0.0, 1.0, (), (Output("y", times, 0.0 * times, 1.0),))
    return Problem(
        model, (Parameter("k", 1.0, (0.1, 5.0)), Parameter("c", 1.0, (0.1, 5.0))), (run,)
    )


def found_at(problem, cost):
    """What is said of a problem where the clock shows that cost."""
    bench = SimpleNamespace(ask=lambda probe, seconds: cost)
    return sensitivities(CheckSubject(problem, problem.describe(), bench, TimeBudget.of(60.0)))


@pytest.mark.parametrize(
    ("plain", "carrying", "recommended"), [(1.0, 0.9, True), (1.0, 1.1, False), (0.1, 5.0, False)]
)
def test_half_the_time_of_differences_is_needed(problem, plain, carrying, recommended):
    """Differences take two further simulations of an experiment with two unknowns."""
    (found,) = found_at(problem, SensitivityCost(plain, carrying))
    assert f"takes {carrying / plain / 2.0:.2g} of the time of the 2" in found.found
    assert ('method.options.differences = "sensitivities"' in found.do) == recommended


def test_nothing_is_said_where_there_are_none(problem):
    assert found_at(problem, None) == []


def test_what_is_timed_gives_sensitivities(problem):
    space = make_space(problem, (0,))
    with ProbeBench.open(problem.model, problem.experiments) as bench:
        found = bench.ask(SensitivityCostProbe(0, space.physical(space.start)[0]), 300.0)
    assert isinstance(found, SensitivityCost)
    assert min(found.plain, found.carrying) > 0.0
