"""Effects around an FMU that knows nothing of them, against SciPy on equations that have them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems.springs import FMU
from support.truth.form_terms import (
    DERIVATIVE,
    FORCES,
    INPUT,
    OUTPUT,
    OUTPUT_OF_OTHERS,
    OWN_TESTS,
    PARAMETER,
    forms_with_a_truth,
)
from support.truth.springs_with_effects import FORCE, START, TIMES, C, K, M, plain, pushed, solve

from cluster_est import Experiment, Input, Model, Output, Parameter, Problem, Solver, fit
from workers.effects.definition import define
from workers.effects.forms import FORMS
from workers.effects.site import open_sites
from workers.errors import EffectError
from workers.evaluate import Evaluator
from workers.messages import Effect, Task
from workers.wire import TaskBatch

EXACT = Solver("dormand_prince", rtol=1e-10)
CO_SIMULATION = Solver("fmu", step=0.002)


def experiment(measured=None):
    output = Output("y", TIMES, np.zeros(len(TIMES)) if measured is None else measured)
    inputs = (Input("F", TIMES, FORCE),)
    return Experiment("e", 0.0, float(TIMES[-1]), inputs, (output,), (("x", START[0]),))


def model(solver=EXACT):
    interface = "co_simulation" if solver.name == "fmu" else "model_exchange"
    return Model(FMU.name, FMU.read_bytes(), interface, solver, ("m", "k", "c"))


def simulated(effects, coefficients, solver=EXACT):
    """Outputs of a simulation with effects."""
    evaluator = Evaluator(model(solver), (experiment(),), "w")
    values = np.array([M, K, C, *coefficients])
    (outcome,) = evaluator.evaluate(
        TaskBatch.of([Task(0, 0, values, "trajectory", tuple(effects))])
    )
    evaluator.close()
    assert outcome.ok, outcome.message
    return outcome.trajectory.values[:, 0]


BASE = solve(plain)
OTHERWISE = "the form's equation and its truth in support/truth/form_terms.py differ"


def test_every_form_has_a_truth():
    listed = forms_with_a_truth()
    assert set(FORMS) - listed == set(), "add its truth to a table of support/truth/form_terms.py"
    assert listed - set(FORMS) == set(), "it is no form any more"
    here = [file.read_text(encoding="utf-8") for file in Path(__file__).parent.glob("test_*.py")]
    named = {test for test in OWN_TESTS.values() if f"def {test}(" in "".join(here)}
    assert named == set(OWN_TESTS.values()), "write this test of the form"


@pytest.mark.parametrize("form", DERIVATIVE)
def test_terms_at_a_state_derivative(form):
    coefficients, variables, term = DERIVATIVE[form]
    effect = Effect("e", "der(v)", form, variables)
    truth = solve(pushed(term))[:, 0]
    # a kink of an effect is not on the grid, so the tolerance only holds step by step
    np.testing.assert_allclose(
        simulated([effect], coefficients), truth, atol=1e-7, err_msg=OTHERWISE
    )


def test_dahl_friction_has_a_state_of_its_own():
    def slope(t, x, force):
        v, dv = plain(t, x, force)
        return [v, dv - 0.5 * x[2], (x[1] - abs(x[1]) * x[2]) / 0.02]

    truth = solve(slope, (*START, 0.0))[:, 0]
    effect = Effect("e", "der(v)", "dahl")
    np.testing.assert_allclose(simulated([effect], (0.5, 0.02)), truth, atol=1e-8)


def test_a_lagged_coupling_has_a_state_of_its_own():
    """That starts where its variable does."""

    def slope(t, x, force):
        v, dv = plain(t, x, force)
        return [v, dv - 6.0 * x[2], (x[0] - x[2]) / 0.3]

    truth = solve(slope, (*START, START[0]))[:, 0]
    effect = Effect("e", "der(v)", "lagged", ("x",))
    np.testing.assert_allclose(simulated([effect], (-6.0, 0.3)), truth, atol=1e-8)


def test_a_ripple_of_the_way_travelled_begins_at_nought():
    def slope(t, x, force):
        v, dv = plain(t, x, force)
        way = x[0] - START[0]
        return [v, dv + 0.3 * np.sin(40.0 * way) + 0.2 * np.cos(40.0 * way)]

    truth = solve(slope)[:, 0]
    effect = Effect("e", "der(v)", "periodic_travel")
    np.testing.assert_allclose(simulated([effect], (0.3, 0.2, 40.0)), truth, atol=1e-7)


@pytest.mark.parametrize(("solver", "bar"), [(EXACT, 2e-7), (CO_SIMULATION, 1e-3)])
@pytest.mark.parametrize("form", INPUT)
def test_functions_of_an_input(form, solver, bar):
    """In co-simulation the changed input counts as linear between communication points."""
    coefficients, change = INPUT[form]
    truth = solve(lambda t, x, f: plain(t, x, change(t, f)))[:, 0]
    result = simulated([Effect("e", "input F", form)], coefficients, solver)
    np.testing.assert_allclose(result, truth, atol=bar, err_msg=OTHERWISE)


@pytest.mark.parametrize("form", FORCES)
def test_functions_of_a_state_at_an_input(form):
    coefficients, variable, force = FORCES[form]
    truth = solve(lambda t, x, f: plain(t, x, f + force(x, f)))[:, 0]
    result = simulated([Effect("e", "input F", form, (variable,))], coefficients)
    np.testing.assert_allclose(result, truth, atol=2e-7, err_msg=OTHERWISE)


def test_dahl_friction_at_an_input():
    def slope(t, x, force):
        return [*plain(t, x, force - 0.5 * x[2]), (x[1] - abs(x[1]) * x[2]) / 0.02]

    truth = solve(slope, (*START, 0.0))[:, 0]
    effect = Effect("e", "input F", "dahl", ("v",))
    np.testing.assert_allclose(simulated([effect], (0.5, 0.02)), truth, atol=1e-8)


@pytest.mark.parametrize(("solver", "bar"), [(EXACT, 1e-9), (CO_SIMULATION, 1e-5)])
def test_a_lag_of_an_input(solver, bar):
    def slope(t, x, force):
        return [*plain(t, x, x[2]), (force - x[2]) / 0.1]

    truth = solve(slope, (*START, FORCE[0]))[:, 0]
    result = simulated([Effect("e", "input F", "lag")], (0.1,), solver)
    np.testing.assert_allclose(result, truth, atol=bar)


@pytest.mark.parametrize(("solver", "bar"), [(EXACT, 1e-7), (CO_SIMULATION, 1e-3)])
def test_an_actuator_that_swings(solver, bar):
    """The second-order equation z'' = f^2 (F - z) - 2 d f z'."""
    f, d = 12.0, 0.3

    def slope(t, x, force):
        return [*plain(t, x, x[2]), x[3], f**2 * (force - x[2]) - 2.0 * d * f * x[3]]

    truth = solve(slope, (*START, FORCE[0], 0.0))[:, 0]
    assert np.abs(truth - BASE[:, 0]).max() > 0.01
    result = simulated([Effect("e", "input F", "mode")], (f, d), solver)
    np.testing.assert_allclose(result, truth, atol=bar)


def test_actuators_that_begin_at_rest():
    def lagged(t, x, force):
        return [*plain(t, x, x[2]), (force - x[2]) / 0.1]

    def swinging(t, x, force):
        return [*plain(t, x, x[2]), x[3], 12.0**2 * (force - x[2]) - 2.0 * 0.3 * 12.0 * x[3]]

    assert abs(FORCE[0]) > 0.1
    truth = solve(lagged, (*START, 0.0))[:, 0]
    result = simulated([Effect("e", "input F", "lag_from_rest")], (0.1,))
    np.testing.assert_allclose(result, truth, atol=1e-8)
    truth = solve(swinging, (*START, 0.0, 0.0))[:, 0]
    result = simulated([Effect("e", "input F", "mode_from_rest")], (12.0, 0.3))
    np.testing.assert_allclose(result, truth, atol=1e-7)


@pytest.mark.parametrize(("f", "d"), [(30.0, 0.1), (5.0, 0.7)])
def test_a_sensor_that_swings(f, d):
    """The second-order equation z'' = f^2 (y - z) - 2 d f z'."""

    def slope(t, x, force):
        return [*plain(t, x, force), x[3], f**2 * (x[0] - x[2]) - 2.0 * d * f * x[3]]

    truth = solve(slope, (*START, START[0], 0.0))[:, 2]
    result = simulated([Effect("e", "output y", "mode")], (f, d))
    np.testing.assert_allclose(result, truth, atol=2e-5)


@pytest.mark.parametrize(("solver", "bar"), [(EXACT, 1e-9), (CO_SIMULATION, 2e-8)])
def test_a_delay_of_an_input(solver, bar):
    times = np.union1d(TIMES, TIMES + 0.013)
    times = times[times <= TIMES[-1]]
    truth = solve(plain, times=times, force=np.interp(times - 0.013, TIMES, FORCE))[:, 0]
    result = simulated([Effect("e", "input F", "delay")], (0.013,), solver)
    np.testing.assert_allclose(result, truth[np.searchsorted(times, TIMES)], atol=bar)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
@pytest.mark.parametrize(
    ("form", "case"),
    [*OUTPUT.items(), *(("feed_through", case) for case in OUTPUT_OF_OTHERS.values())],
)
def test_functions_of_an_output(form, case, solver):
    coefficients, variables, change = case
    result = simulated([Effect("e", "output y", form, variables)], coefficients, solver)
    np.testing.assert_allclose(result, change(*BASE.T), atol=1e-8, err_msg=OTHERWISE)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
def test_a_delay_of_an_output(solver):
    """It shows what was between the measured times."""
    seen = np.union1d(TIMES, TIMES[2:] - 0.033)
    truth = solve(plain, times=seen, force=np.interp(seen, TIMES, FORCE))[:, 0]
    truth = np.where(TIMES > 0.033, truth[np.searchsorted(seen, TIMES - 0.033)], START[0])
    result = simulated([Effect("e", "output y", "delay")], (0.033,), solver)
    np.testing.assert_allclose(result, truth, atol=6e-5)


@pytest.mark.parametrize("tau", [0.0005, 0.05, 1.0])
def test_a_lag_of_an_output(tau):
    """It sees the output between the measured times too."""

    def slope(t, x, force):
        return [*plain(t, x, force), (x[0] - x[2]) / tau]

    truth = solve(slope, (*START, START[0]))[:, 2]
    result = simulated([Effect("e", "output y", "lag")], (tau,))
    np.testing.assert_allclose(result, truth, atol=2e-5)


def test_a_parameter_that_varies_in_co_simulation():
    """It is set at the communication points."""
    truth = solve(pushed(lambda t, x, f: -C / M * 0.8 * (t - 2.0) * x[1]))[:, 0]
    result = simulated([Effect("e", "parameter c", "drift")], (0.8, 2.0), CO_SIMULATION)
    np.testing.assert_allclose(result, truth, atol=1e-4)


def test_an_output_that_shows_a_lagged_state():
    """A lag that begins at nought, of what is linear between the measured times."""

    def slope(t, x, force):
        return [*plain(t, x, force), (force - x[2]) / 0.3]

    y, _, lagged = solve(slope, (*START, 0.0)).T
    effect = Effect("e", "output y", "lagged_feed_through", ("F",))
    np.testing.assert_allclose(simulated([effect], (0.05, 0.3)), y + 0.05 * lagged, atol=1e-6)


@pytest.mark.parametrize("form", PARAMETER)
def test_variations_of_a_parameter(form):
    coefficients, variables, share = PARAMETER[form]
    truth = solve(pushed(lambda t, x, f: -C / M * share(t, x[1]) * x[1]))[:, 0]
    result = simulated([Effect("e", "parameter c", form, variables)], coefficients)
    bar = 1e-6 if form.startswith("table") else 2e-8
    np.testing.assert_allclose(result, truth, atol=bar, err_msg=OTHERWISE)


def test_a_parameter_that_heats_up():
    def slope(t, x, force):
        v, dv = plain(t, x, force)
        share = 0.9 * (x[2] - 0.02)
        return [v, dv - C / M * share * x[1], (x[1] ** 2 - x[2]) / 0.6]

    truth = solve(slope, (*START, 0.0))[:, 0]
    result = simulated([Effect("e", "parameter c", "heating", ("v",))], (0.9, 0.02, 0.6))
    np.testing.assert_allclose(result, truth, atol=2e-8)


def test_effects_combine():
    def slope(t, x, force):
        v, dv = plain(t, x, 1.2 * (force + 0.3))
        return [v, dv - 0.7 * x[1] * abs(x[1])]

    effects = [
        Effect("a", "input F", "bias"),
        Effect("b", "input F", "gain"),
        Effect("c", "der(v)", "quadratic"),
        Effect("d", "output y", "gain"),
    ]
    result = simulated(effects, (0.3, 0.2, 0.7, -0.1))
    np.testing.assert_allclose(result, 0.9 * solve(slope)[:, 0], atol=1e-8)


def test_effects_of_different_tasks_keep_their_own_coefficients():
    """One worker, asked for an effect alone and then behind another that is neutral."""
    bias, drag = Effect("a", "input F", "bias"), Effect("b", "der(v)", "quadratic")
    evaluator = Evaluator(model(), (experiment(),), "w")

    def ask(effects, coefficients):
        values = np.array([M, K, C, *coefficients])
        (outcome,) = evaluator.evaluate(TaskBatch.of([Task(0, 0, values, "trajectory", effects)]))
        return outcome.trajectory.values.tobytes()

    alone = ask((drag,), (0.7,))
    assert ask((bias, drag), (0.0, 0.7)) == alone
    assert ask((drag, bias), (0.7, 0.0)) == alone
    evaluator.close()


def test_an_equation_of_the_users_own():
    effect = Effect(
        "own",
        "der(v)",
        equation="-a*x^3 + where(x > 0.05, b * F, 0)",
        coefficients=(("a", 0.0), ("b", 0.0)),
    )
    truth = solve(pushed(lambda t, x, f: -40.0 * x[0] ** 3 + (0.1 * f if x[0] > 0.05 else 0.0)))
    np.testing.assert_allclose(simulated([effect], (40.0, 0.1)), truth[:, 0], atol=1e-5)


SITES = {
    "derivative": "der(v)",
    "pair": "pair x,v",
    "input": "input F",
    "output": "output y",
    "parameter": "parameter c",
}


SIZES = {
    "exponential": {"k": -0.4, "width": 0.5},
    "inverse": {"k": 0.1},
    "inverse_square": {"k": 0.1},
}
"""Of forms that leave the range of numbers, or divide by nothing, with the usual ones."""


@pytest.mark.parametrize("solver", [EXACT, Solver("rk4", step=0.005), CO_SIMULATION])
@pytest.mark.parametrize(("kind", "name"), FORMS)
def test_every_form_does_nothing_when_neutral_and_something_otherwise(kind, name, solver):
    if kind in ("derivative", "pair") and solver.name == "fmu":
        pytest.skip("a co-simulation FMU keeps its state derivatives to itself")
    form = FORMS[kind, name]
    variables = (("v", "x") if kind in ("derivative", "pair") else ("F", "F"))[: form.variables]
    effect = Effect("e", SITES[kind], name, variables)
    known = {"low": -0.5, "limit": 0.03} | SIZES.get(name, {})
    shapes = [known.get(c.name, 0.03) for c in form.coefficients]
    sizes = [
        known.get(c.name, 0.4) if c.neutral == 0.0 else s
        for c, s in zip(form.coefficients, shapes, strict=True)
    ]
    neutral = [c.neutral for c in form.coefficients]
    shapes = [s if n is None else n for n, s in zip(neutral, shapes, strict=True)]
    without = simulated([], (), solver)
    assert simulated([effect], shapes, solver).tobytes() == without.tobytes(), (
        "with each coefficient at its `neutral`, the equation must add 0 to a derivative, and be s "
        "elsewhere"
    )
    assert np.abs(simulated([effect], sizes, solver) - without).max() > 1e-6, (
        f"it does nothing with {dict(zip((c.name for c in form.coefficients), sizes, strict=True))}"
        ": look at the equation, or give this test other values in `known`"
    )


def test_a_declared_effect_is_fitted_together_with_the_parameters():
    measured = solve(pushed(lambda t, x, f: -0.5 * np.tanh(x[1] / 0.01)))[:, 0]
    parameters = (
        Parameter("m", 1.0, 0.1, 10.0),
        Parameter("k", 25.0, 1.0, 100.0),
        Parameter("c", 0.8, 0.0, 10.0),
        Parameter("friction.k", 0.0, 0.0),
        Parameter("friction.width", 0.01, fixed=True),
    )
    effects = (Effect("friction", "der(v)", "coulomb"),)
    problem = Problem(model(), parameters, (experiment(measured),), effects=effects)
    result = fit(problem)
    truth = {"m": M, "k": K, "c": C, "friction.k": 0.5}
    assert result.x == pytest.approx(truth, rel=1e-5)
    without = fit(Problem(model(), parameters[:3], problem.experiments))
    assert without.cost > 1e3 * result.cost


@pytest.mark.parametrize(
    ("effect", "phrases"),
    [
        (Effect("e", "der(q)", "coulomb"), ["no such site der(q)", "'x', 'v'"]),
        (Effect("e", "input f", "gain"), ["no such site input f", "did you mean 'F'"]),
        (Effect("e", "nowhere", "gain"), ["must be", "but is 'nowhere'"]),
        (Effect("e", "der(v)", "coulom"), ["no form 'coulom'", "did you mean 'coulomb'"]),
        (Effect("e", "der(v)", "product", ("x",)), ["product needs 2 but has 1"]),
        (Effect("e", "der(v)", "linear", ("z",)), ["variables", "'z'"]),
        (Effect("e", "der(v)", "linear", ("x - z",)), ["variables", "unknown variable 'z'"]),
        (Effect("e", "der(v)", "linear", ("2 * x",)), ["a name or the difference of two but"]),
        (Effect("e", "pair v", "gap"), ["two different states but is 'pair v'"]),
        (Effect("e", "pair v,v", "gap"), ["two different states but is 'pair v,v'"]),
        (Effect("e", "pair v,q", "gap"), ["no such site der(q)", "'x', 'v'"]),
        (Effect("e", "pair x,v", "jiont"), ["no form 'jiont'", "did you mean 'joint'"]),
        (Effect("e", "pair x,v", equation="x"), ["reaction: must be", "to der(v)", "is missing"]),
        (Effect("e", "der(v)", equation="x", reaction="x"), ["reaction: must stand", "no pair"]),
        (Effect("e", "pair x,v", "gap", reaction="x"), ["reaction: must stand", "form is 'gap'"]),
        (Effect("e", "der(v)", equation="2 *"), ["must be an equation but '2 *' is not"]),
        (Effect("e", "der(v)", equation="2 * q"), ["unknown variable 'q'"]),
        (Effect("e", "der(v)", equation="sinn(x)"), ["unknown function 'sinn'", "'sin'"]),
        (Effect("e", "der(v)", equation="__import__('os').remove('x')"), ["must be made of"]),
        (Effect("e", "der(v)", equation="x.__class__"), ["unknown variable 'x.__class__'"]),
        (Effect("e", "der(v)", equation="[x for x in (1,)]"), ["must be made of"]),
        (Effect("e", "der(v)", equation="sin(x, x, x)"), ["sin(...) cannot be used so"]),
    ],
)
def test_an_effect_that_cannot_be_is_refused_with_a_sentence(effect, phrases):
    from workers.fmu.description import describe

    with pytest.raises(EffectError) as refused:
        define(effect, describe(FMU.name, FMU.read_bytes()), "model_exchange")
    for phrase in phrases:
        assert phrase in str(refused.value)


def test_co_simulation_closes_the_sites_at_derivatives():
    from workers.fmu.description import describe

    description = describe(FMU.name, FMU.read_bytes())
    kinds = {site.kind for site in open_sites(description, "co_simulation")}
    assert kinds == {"input", "output", "parameter"}
    with pytest.raises(EffectError, match=r"der\(v\) is closed.*keeps its states"):
        define(Effect("e", "der(v)", "coulomb"), description, "co_simulation")
    with pytest.raises(EffectError, match=r"pair x,v is closed.*keeps its states"):
        define(Effect("e", "pair x,v", "gap"), description, "co_simulation")


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION], ids=["exact", "co_simulation"])
def test_a_sensor_at_a_variable_that_is_no_output(solver):
    """The state x is what the output y shows."""
    output = Output("x", TIMES, np.zeros(len(TIMES)))
    run = replace(experiment(), outputs=(output,))
    effect = Effect("sensor", "output x", "gain")
    evaluator = Evaluator(model(solver), (run,), "w")
    values = np.array([M, K, C, 0.25])
    (outcome,) = evaluator.evaluate(TaskBatch.of([Task(0, 0, values, "trajectory", (effect,))]))
    evaluator.close()
    assert outcome.ok, outcome.message
    plain_outputs = simulated((), (), solver)
    np.testing.assert_allclose(outcome.trajectory.values[:, 0], 1.25 * plain_outputs, rtol=1e-12)


def test_an_effect_that_divides_by_zero_ends_its_simulation_with_a_reason():
    output = Output("y", TIMES, np.zeros(len(TIMES)))
    given = Input("F", TIMES, FORCE)
    experiment = Experiment("e", 0.0, float(TIMES[-1]), (given,), (output,))
    model = Model(FMU.name, FMU.read_bytes(), "model_exchange", EXACT, ("m", "k", "c"))
    evaluator = Evaluator(model, (experiment,), "w")
    effect = Effect("e", "der(v)", "coulomb")
    task = Task(0, 0, np.array([M, K, C, 0.5, 0.0]), "residuals", (effect,))
    (outcome,) = evaluator.evaluate(TaskBatch.of([task]))
    evaluator.close()
    assert not outcome.ok
    assert outcome.message
