"""Effects, linearisations, filters and sensitivities: the core has the bits of the loops."""

import numpy as np
import pytest
from support import core_in_place
from support.problems.springs import FMU
from support.thinning import thinned

from workers.effects.forms import FORMS, PROCESS_NOISE
from workers.fmu.description import describe
from workers.messages import Effect, Experiment, Input, Model, Output, Solver
from workers.simulation.simulator import Simulator

pytestmark = pytest.mark.slow

TIMES = np.linspace(0.0, 4.0, 81)
FORCE = 2.0 * np.sin(3.0 * TIMES) + np.random.default_rng(3).normal(size=81)
SITES = {
    "derivative": "der(v)", "input": "input F", "parameter": "parameter c", "pair": "pair x,v",
    "output": "output y",
}  # fmt: skip
POINT = (1.0, 25.0, 0.8)
SOLVERS = {"rk4": None, "dormand_prince": None, "cvode": None, "fmu": 0.02}
FORMS_OF_ALL = FORMS | PROCESS_NOISE


def is_possible(kind, name, solver):
    """A co-simulation FMU keeps its states to itself."""
    return solver != "fmu" or not (
        kind in ("derivative", "pair")
        or (kind in ("input", "parameter") and FORMS[kind, name].variables)
    )


CASES = thinned(
    [
        (kind, name, solver, held)
        for kind, name in FORMS
        for solver in SOLVERS
        for held in (False, True)
        if is_possible(kind, name, solver)
    ],
    lambda kind, name, *_: (kind, FORMS[kind, name].family),
    lambda kind, _, solver, __: (kind, solver),
    lambda *given: given[-1],
)


def effect_of(kind, name):
    form = FORMS_OF_ALL[kind, name]
    variables = {"output": ("F", "x"), "pair": ("x", "v")}.get(kind, ("x", "F"))[: form.variables]
    if kind == "pair" and form.variables == 1:
        variables = ("x - v",)
    effect = Effect("e", SITES[kind], name, variables)
    names = [c.name for c in form.coefficients]
    values = 0.05 + 0.3 * np.abs(np.random.default_rng(len(name)).normal(size=len(names)))
    for place, value in (("low", -1.0), ("high", 1.2)):
        if place in names:
            values[names.index(place)] = value
    return effect, values


def simulator_of(solver, held=False):
    driven = Input("F", TIMES, FORCE, "hold" if held else "linear")
    experiment = Experiment("a", 0.0, 4.0, (driven,), (Output("y", TIMES, np.sin(TIMES)),))
    how = Solver(solver, step=SOLVERS[solver], rtol=1e-6)
    interface = "co_simulation" if solver == "fmu" else "model_exchange"
    model = Model(FMU.name, FMU.read_bytes(), interface, how, ("m", "k", "c"))
    simulator = Simulator(model, describe(FMU.name, model.archive), (experiment,))
    simulator.load()
    return simulator


def by_both(monkeypatch, ask, solver, held=False):
    """What the loops answer, and the core."""
    answers = []
    for _ in range(2):
        simulator = simulator_of(solver, held)
        answers.append(ask(simulator))
        simulator.close()
        core_in_place.install(monkeypatch)
    return answers


@pytest.mark.parametrize(("kind", "name", "solver", "held"), CASES)
def test_an_effect_acts_as_compiled(monkeypatch, kind, name, solver, held):
    effect, coefficients = effect_of(kind, name)
    points = np.array([[*POINT, *coefficients], [*POINT, *(1.1 * coefficients)]])
    expected, found = by_both(
        monkeypatch, lambda simulator: simulator.run(0, points, (effect,)), solver, held
    )
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    np.testing.assert_array_equal(found.steps, expected.steps)
    assert found.messages == expected.messages


@pytest.mark.parametrize("solver", ["rk4", "dormand_prince", "cvode"])
@pytest.mark.parametrize(
    "site", [(), ("derivative", "dahl"), ("input", "lag"), ("parameter", "linear")], ids=str
)
def test_a_linearisation_is_that_of_the_loops(monkeypatch, solver, site):
    effects, point = (), np.array([POINT])
    if site:
        effect, coefficients = effect_of(*site)
        effects, point = (effect,), np.array([[*POINT, *coefficients]])
    expected, found = by_both(
        monkeypatch, lambda simulator: simulator.linearise(0, point, effects), solver
    )
    np.testing.assert_array_equal(found.outputs, expected.outputs)
    one, other = expected.linearisations[0], found.linearisations[0]
    for name in ("states", "derivatives", "effective_inputs", "B", "C", "D", "P", "Q"):
        np.testing.assert_array_equal(getattr(other, name), getattr(one, name))


@pytest.mark.parametrize("solver", ["rk4", "dormand_prince"])
@pytest.mark.parametrize("kind_and_name", sorted(PROCESS_NOISE))
def test_a_filter_has_the_innovations_of_the_loop(monkeypatch, solver, kind_and_name):
    effect, coefficients = effect_of(*kind_and_name)
    point = np.array([[*POINT, *coefficients]])

    def ask(simulator):
        return simulator.run(0, point, (effect,)), simulator.linearise(0, point, (effect,))

    for one, other in zip(*by_both(monkeypatch, ask, solver), strict=True):
        np.testing.assert_array_equal(other.outputs, one.outputs)
        np.testing.assert_array_equal(other.innovations[0], one.innovations[0])


@pytest.mark.parametrize("solver", ["rk4", "dormand_prince"])
def test_stiffness_is_found_as_by_the_loop(monkeypatch, solver):
    expected, found = by_both(
        monkeypatch, lambda simulator: simulator.is_stiff(0, np.array(POINT)), solver
    )
    assert found == expected


@pytest.mark.parametrize("solver", ["rk4", "dormand_prince"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("name", ["van_der_pol", "states_directional"])
def test_sensitivities_are_those_of_the_loop(monkeypatch, own_fmu, name, fmi, solver):
    """By a parameter that is a known, and by differences of instances where it is none."""
    path = own_fmu(name, fmi)
    described = describe(path.name, path.read_bytes())
    outputs = [v.name for v in described.variables.values() if v.causality == "output"]
    recorded = tuple(Output(n, TIMES, 0.0 * TIMES) for n in (*outputs, *described.states))
    parameters = tuple(n for n, v in described.variables.items() if v.causality == "parameter")
    values = [described.variables[n].start or 1.0 for n in parameters]
    how = Solver(solver, step=0.01 if solver == "rk4" else None)
    model = Model(path.name, path.read_bytes(), "model_exchange", how, parameters)
    found = []
    for _ in range(2):
        experiment = Experiment("a", 0.0, 4.0, (), recorded)
        simulator = Simulator(model, described, (experiment,))
        simulator.load()
        found.append(simulator.sensitivities(0, np.array([values])))
        simulator.close()
        core_in_place.install(monkeypatch)
    np.testing.assert_array_equal(found[1].outputs, found[0].outputs)
    assert found[1].messages == found[0].messages == [""]
    np.testing.assert_array_equal(found[1].sensitivities[0], found[0].sensitivities[0])
    assert np.isfinite(found[0].sensitivities[0]).all()
