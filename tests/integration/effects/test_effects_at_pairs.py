"""Forces between two states, against SciPy on a quarter car that has them."""

import numpy as np
import pytest
from scipy.integrate import ode
from support.problems.springs import ROOT
from support.simulated import Worker
from support.truth.form_terms import PAIR, TRAVEL

from workers.effects.definition import define
from workers.effects.site import open_pairs, parse_site
from workers.effects.units import coefficient_units
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Model, Output, Solver

FMU = ROOT / "configs" / "models" / "quarter_car.fmu"
M_BODY, M_WHEEL, SPRING, DAMPER, TYRE = 300.0, 40.0, 2e4, 900.0, 1.8e5
TIMES = np.arange(301) * 0.01
ROAD = 0.03 * np.sin(9.0 * TIMES) + 0.02 * np.sin(4.0 * TIMES)
VALUES = {"m_body": M_BODY, "m_wheel": M_WHEEL, "k_spring": SPRING, "c_damper": DAMPER}


def solved(force, *own):
    """The body's velocity and the travel; `force` is what is added to the two accelerations.

    `own` are the rates of further states, of all states, which begin at zero.
    """

    def slope(t, x):
        z_body, v_body, z_wheel, v_wheel = x[:4]
        road = np.interp(t, TIMES, ROAD)
        suspension = SPRING * (z_body - z_wheel) + DAMPER * (v_body - v_wheel)
        body, wheel = force(x)
        pushed = (suspension - TYRE * (z_wheel - road)) / M_WHEEL
        rates = [v_body, -suspension / M_BODY + body, v_wheel, pushed + wheel]
        return [*rates, *(rate(x) for rate in own)]

    solver = ode(slope).set_integrator("dop853", rtol=1e-9, atol=1e-11, nsteps=10_000)
    start = np.zeros(4 + len(own))
    solver.set_initial_value(start, 0.0)
    x = np.array([start, *(solver.integrate(t) for t in TIMES[1:])]).T
    return np.column_stack([x[1], x[0] - x[2]])


def experiment():
    outputs = tuple(Output(n, TIMES, np.zeros(len(TIMES))) for n in ("velocity", "travel"))
    zeros = tuple((n, 0.0) for n in ("z_body", "v_body", "z_wheel", "v_wheel"))
    values = (*VALUES.items(), ("k_tyre", TYRE), *zeros)
    inputs = (Input("road", TIMES, ROAD),)
    return Experiment("e", 0.0, float(TIMES[-1]), inputs, outputs, values)


@pytest.fixture(scope="module")
def simulated():
    """Outputs with an effect, by one worker."""
    solver = Solver("dormand_prince", rtol=1e-10)
    worker = Worker(Model(FMU.name, FMU.read_bytes(), "model_exchange", solver, ()), experiment())
    return lambda effect, coefficients: worker.outputs(coefficients, effects=[effect])[0]


@pytest.fixture(scope="module")
def without():
    return solved(lambda x: (0.0, 0.0))


DEPTH = "max(z_wheel - z_body - at, 0)"
STOP = Effect(
    "stop",
    "pair v_body,v_wheel",
    equation=f"k * {DEPTH}",
    coefficients=(("k", 0.0), ("back", 0.0), ("at", None)),
    reaction=f"-back * {DEPTH}",
)
PLACES = {
    TRAVEL: lambda x: x[0] - x[2],
    (): lambda x: x[1] - x[3],
    ("v_wheel",): lambda x: x[3],
    (*TRAVEL, "v_wheel"): lambda x: (x[0] - x[2], x[3]),
    ("z_body", "z_wheel"): lambda x: (x[0], x[2]),
}


@pytest.mark.parametrize("form", PAIR)
def test_a_force_between_two_states(simulated, without, form):
    coefficients, variables, law = PAIR[form]
    k, back, *_ = coefficients

    def force(x):
        here = law(PLACES[variables](x))
        return -k * here, back * here

    truth = solved(force)
    assert np.abs(truth - without).max() > 3e-4
    effect = Effect("e", "pair v_body,v_wheel", form, variables)
    np.testing.assert_allclose(simulated(effect, coefficients), truth, atol=1e-6)


@pytest.mark.parametrize("values", [7, 13, 25])
def test_a_curve_between_two_states_acts_on_both_in_proportion(simulated, without, values):
    coarse = (2.0, 1.5, 1.2, 0.1, -0.8, -1.0, -2.5)
    places = np.linspace(-0.03, 0.04, values)
    heights = np.interp(places, np.linspace(-0.03, 0.04, 7), coarse)
    heights[1::2] += 0.3

    def force(x):
        here = np.interp(x[0] - x[2], places, heights)
        return here, -7.5 * here

    truth = solved(force)
    assert np.abs(truth - without).max() > 3e-3
    form = "table" if values == 7 else f"table_{values}"
    effect = Effect("e", "pair v_body,v_wheel", form, TRAVEL)
    found = simulated(effect, (*heights, 7.5, places[0], places[-1]))
    np.testing.assert_allclose(found, truth, atol=2e-5)


def test_a_spring_and_a_damper_in_series_between_two_states(simulated, without):
    """Its force per k is a state: it grows with the speed of the travel, and relaxes."""

    def force(x):
        return -30.0 * x[4], 220.0 * x[4]

    truth = solved(force, lambda x: x[1] - x[3] - x[4] / 0.2)
    assert np.abs(truth - without).max() > 3e-3
    effect = Effect("e", "pair v_body,v_wheel", "store", TRAVEL)
    np.testing.assert_allclose(simulated(effect, (30.0, 220.0, 0.2)), truth, atol=1e-6)


def test_a_wall_between_two_states(simulated, without):
    """A mass of 2 between two dampers of 6 and 4: what each takes follows from Newton's law."""

    def force(x):
        return -6.0 * (x[1] - x[4]), 4.0 * (x[4] - x[3])

    truth = solved(force, lambda x: (6.0 * (x[1] - x[4]) - 4.0 * (x[4] - x[3])) / 2.0)
    assert np.abs(truth - without).max() > 3e-3
    effect = Effect("e", "pair v_body,v_wheel", "store_between", ("v_body", "v_wheel"))
    coefficients = (6.0, 4.0, 2.0 / 10.0, 6.0 / 10.0, 0.5)
    np.testing.assert_allclose(simulated(effect, coefficients), truth, atol=1e-6)


def test_an_equation_of_ones_own_with_a_reaction(simulated, without):
    """A one-sided stop between two masses, which pushes both apart."""

    def force(x):
        push = 4e4 * max(0.0, x[2] - x[0] - 0.01)
        return push / M_BODY, -push / M_WHEEL

    truth = solved(force)
    assert np.abs(truth - without).max() > 3e-3
    coefficients = (4e4 / M_BODY, 4e4 / M_WHEEL, 0.01)
    np.testing.assert_allclose(simulated(STOP, coefficients), truth, atol=2e-5)


def test_the_pairs_that_a_search_should_try_have_one_unit():
    description = describe(FMU.name, FMU.read_bytes())
    pairs = [str(site) for site in open_pairs(description, "model_exchange")]
    assert pairs == ["pair z_body,z_wheel", "pair v_body,v_wheel"]
    assert open_pairs(description, "co_simulation") == []


def test_commas_within_brackets_belong_to_a_name():
    site = parse_site("pair x[1,2], a.b[3]", "here")
    assert site.targets == ("x[1,2]", "a.b[3]")
    assert str(site) == "pair x[1,2],a.b[3]"


@pytest.mark.parametrize(
    ("site", "form", "variables", "units"),
    [
        ("pair v_body,v_wheel", "gap", TRAVEL, ("1/s^2", "1/s^2", "m")),
        ("pair z_body,v_wheel", "coulomb", ("road",), ("m/s", "m/s^2", "m")),
        ("pair v_body,v_wheel", "table", TRAVEL, (*["m/s^2"] * 7, "1", "m", "m")),
        ("der(v_body)", "quadratic", (), ("1/m",)),
        ("der(v_body)", "product", ("z_body", "v_body"), ("1/(m.s)",)),
        ("der(v_body)", "dahl", (), ("m/s^2", "m")),
        ("output velocity", "drift", (), ("m/s^2",)),
        ("output velocity", "hum", (), ("m/s", "m/s", "rad/s")),
        ("input road", "cubic", (), ("1/m^2",)),
        ("parameter k_spring", "drift", (), ("1/s", "s")),
        ("output travel", "feed_through", ("sun",), ("m/?",)),
    ],
)
def test_units_of_coefficients(site, form, variables, units):
    description = describe(FMU.name, FMU.read_bytes())
    effect = Effect("e", site, form, variables)
    definition = define(effect, description, "model_exchange", ("sun",))
    assert coefficient_units(definition, description) == units
