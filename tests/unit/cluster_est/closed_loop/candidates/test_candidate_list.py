from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from support.problems.seen_springs import with_outputs
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est import Effect, Input, LoopSettings, Output, Parameter, Solver
from cluster_est.closed_loop.candidates.arguments import KinematicDefinition
from cluster_est.closed_loop.candidates.make import (
    EffectCandidate,
    OpenSites,
    finer_form,
    in_finer_form,
    make_candidates,
    refined,
)
from cluster_est.closed_loop.candidates.trajectory import pooled
from cluster_est.closed_loop.findings.description import taken_for_definitions
from workers.effects.forms import FORMS
from workers.effects.site import parse_site
from workers.messages import MatrixSeries

SPRING = missing_effect_problem("mass_spring_damper")
PLAIN = missing_effect_problem("mass_spring_damper", signals=())


def simulated(problem):
    """The description of its FMU, and the trajectories at the start of its parameters."""
    with opened(problem) as bench:
        return bench.fitter.description, bench.fitter.trajectories(unfitted(bench))


def listed(problem, frequencies=(3.0,), **settings):
    return make_candidates(problem, *simulated(problem), frequencies, LoopSettings(**settings))


@cache
def all_of(name, signals=("extra",)):
    return listed(missing_effect_problem(name, signals=signals))


def changed(problem, **changes):
    """A problem whose second experiment is different."""
    first, second, *rest = problem.experiments
    return replace(problem, experiments=(first, replace(second, **changes), *rest))


def sites(candidates):
    return {str(c.site) for c in candidates}


def keyed(candidates):
    return {(str(c.site), c.form.name, c.effect.variables): c for c in candidates}


@pytest.mark.parametrize(
    ("name", "dynamic"),
    [
        ("mass_spring_damper", {"v"}),
        ("pendulum", {"speed"}),
        ("cascaded_tanks", {"h1", "h2"}),
        ("two_mass_drive", {"twist", "w_motor", "w_load"}),
        ("gantry_crane", {"v", "w"}),
    ],
)
def test_what_is_the_integral_of_another_state_by_definition_is_no_site(name, dynamic):
    found = {c.site.target for c in all_of(name) if c.site.kind == "derivative"}
    assert found == dynamic


def of_units(own, rate):
    """The spring's description with other units, its states being x and v."""
    description, runs = simulated(SPRING)
    units = {"x": own, "v": rate}
    variables = {
        name: replace(v, unit=units.get(name, v.unit)) for name, v in description.variables.items()
    }
    return replace(description, variables=variables), runs


@pytest.mark.parametrize(
    ("own", "rate", "certain"),
    [
        ("mm", "mm/s", True),
        ("deg", "deg/s", True),
        ("rad", "1/s", True),
        ("", "m/s", True),
        ("1", "rad/s", True),
        ("", "", False),
        ("1", "1/s", False),
        ("furlong", "", False),
        ("V", "V/s", False),
    ],
)
def test_the_speed_of_a_position_or_an_angle_is_a_definition(own, rate, certain):
    description, runs = of_units(own, rate)
    opened = OpenSites(SPRING, description, runs, LoopSettings())
    assert [(d.state, d.speed, d.certain) for d in opened.definitions] == [("x", "v", certain)]
    assert "der(x)" not in opened.searched
    assert "der(v)" in opened.searched
    assert bool(taken_for_definitions(opened.definitions)) is not certain


@pytest.mark.parametrize(
    ("own", "rate"),
    [
        ("l", "l/s"),
        ("", "l/s"),
        ("A.h", "A"),
        ("V", "A"),
        ("J", "W"),
        ("kg", ""),
        ("K", "K/s"),
        ("m/s", "m/s2"),
        ("m", "m3/s"),
    ],
)
def test_the_same_equation_of_another_quantity_is_a_balance(own, rate):
    description, runs = of_units(own, rate)
    opened = OpenSites(SPRING, description, runs, LoopSettings())
    assert not opened.definitions
    assert "der(x)" in opened.searched
    found = make_candidates(SPRING, description, runs, [], LoopSettings(forms=("linear",)))
    assert {"der(x)", "der(v)"} <= sites(found)


@pytest.mark.parametrize("site", ["der(x)", "pair x,v"])
def test_a_definition_that_the_user_names_is_searched(site):
    description, runs = of_units("", "")
    settings = LoopSettings(sites=(site,))
    assert OpenSites(SPRING, description, runs, settings).searched == (site,)
    assert sites(make_candidates(SPRING, description, runs, [], settings)) == {site}


def test_a_note_names_the_equations_that_no_unit_explains():
    unsure = [KinematicDefinition(f"V{i}", f"q{i}", certain=False) for i in range(6)]
    (one,) = taken_for_definitions([*unsure[:1], KinematicDefinition("x", "v", certain=True)])
    assert one.startswith("der(V0) = q0 was taken for the definition of a rate, so no effect was")
    assert one.endswith('closed_loop.sites = ["der(V0)"], or the unit of V0 in model.units')
    (many,) = taken_for_definitions(unsure)
    assert many.startswith("der(V0) = q0, der(V1) = q1, der(V2) = q2, der(V3) = q3 and 2 more were")


def test_it_is_one_at_rest_too():
    problem = missing_effect_problem("mass_spring_damper", experiments=1)
    still = Input("F", np.array([0.0, 6.0]), np.zeros(2))
    run = replace(problem.experiments[0], inputs=(still,), values=())
    found = sites(listed(replace(problem, experiments=(run,)), forms=("constant",)))
    assert found == {"der(v)"}


@pytest.mark.parametrize("radius", [1.0, 0.05])
def test_ripples_are_functions_of_a_way_be_it_geared(radius):
    description, runs = simulated(SPRING)
    geared = []
    for run in runs:
        rows = np.ones(2)
        rows[run.linear.state_names.index("x")] = radius
        rates = MatrixSeries.of(np.asarray(run.linear.A) * rows[:, None])
        linear = replace(run.linear, A=rates, derivatives=run.linear.derivatives * rows)
        geared.append(replace(run, linear=linear))
    found = make_candidates(SPRING, description, geared, [], LoopSettings())
    ripples = [c for c in found if c.form.family == "ripple" and str(c.site) == "der(v)"]
    assert {c.effect.variables for c in ripples} == {("x",)}


def test_ripples_without_a_way_are_functions_of_the_speed():
    """The twist of a shaft is the integral of neither speed at its ends."""
    found = [c for c in all_of("two_mass_drive") if c.form.family == "ripple"]
    places = {(str(c.site), *c.effect.variables) for c in found}
    speeds = {("der(w_motor)", "w_motor"), ("der(w_load)", "w_load")}
    assert {place for place in places if place[0] != "der(twist)"} == speeds


def test_the_integral_of_a_temperature_is_no_way():
    """Of what has no unit it may be one."""
    assert not any(c.form.family == "ripple" for c in all_of("kiln"))
    description, runs = simulated(missing_effect_problem("kiln"))
    plain = {name: replace(v, unit="") for name, v in description.variables.items()}
    problem = missing_effect_problem("kiln")
    found = make_candidates(
        problem, replace(description, variables=plain), runs, [], LoopSettings()
    )
    assert {c.effect.variables for c in found if c.form.family == "ripple"} == {
        ("T_plate",),
        ("T_charge",),
    }


def test_functions_of_the_difference_to_what_is_around_a_state():
    """A kiln in a hall: an input of the state's unit that acts on it, and no other one."""
    found = keyed(all_of("kiln", ()))
    lost = ("T_charge - T_ambient",)
    assert {
        ("der(T_charge)", "power", lost),
        ("parameter G_charge", "linear", lost),
        ("der(T_charge)", "radiation", ("T_charge", "T_ambient")),
        ("pair T_plate,T_charge", "radiation", ("T_plate", "T_charge")),
    } <= set(found)
    assert not any(site == "der(T_plate)" and v == lost for site, _, v in found)
    assert not any("power" in v for _, _, variables in found for v in variables if " - " in v)


def test_without_units_nothing_is_known_to_be_around_a_state():
    rates = [c for c in all_of("mass_spring_damper", ()) if c.site.kind == "derivative"]
    assert not any(" - " in v for c in rates for v in c.effect.variables)


FROM_REST = {"lag_from_rest", "mode_from_rest"}


@pytest.mark.parametrize(("first", "named"), [(0.0, set()), (2.0, FROM_REST)])
def test_a_lag_may_begin_at_zero_only_where_its_signal_does_not(first, named):
    runs = []
    for run in PLAIN.experiments:
        (force,) = run.inputs
        values = force.values - force.values[0] + first
        runs.append(replace(run, inputs=(replace(force, values=values),)))
    found = listed(replace(PLAIN, experiments=tuple(runs)))
    own = {c.form.name for c in found if c.site.kind == "input"}
    assert own & {"lag", *FROM_REST} == {"lag", *named}


ON_TURNS = {"backlash", "hysteresis"}


@pytest.mark.parametrize(("back", "named"), [(0.0, set()), (0.05, set()), (0.5, ON_TURNS)])
def test_what_shows_only_when_a_signal_turns_is_tried_only_where_it_does(back, named):
    """A ramp that comes back by a share of its way; else a play is an offset."""
    runs = []
    for run in PLAIN.experiments:
        (force,) = run.inputs
        way = np.linspace(0.0, 1.0 + back, len(force.values))
        values = 3.0 * np.minimum(way, 2.0 - way)
        runs.append(replace(run, inputs=(replace(force, values=values),)))
    found = listed(replace(PLAIN, experiments=tuple(runs)), sites=("input F",))
    assert {c.form.name for c in found} & {"lag", *ON_TURNS} == {"lag", *named}


def test_a_store_is_of_a_state_and_begins_empty_only_where_zero_is_nothing():
    tanks = {(str(c.site), c.form.name, c.effect.variables) for c in all_of("cascaded_tanks", ())}
    assert ("der(h2)", "store", ("h1",)) in tanks
    assert ("der(h1)", "store_from_zero", ("h1",)) in tanks
    assert not any(name.startswith("store") and v == ("u",) for _, name, v in tanks)
    warm = {c.form.name for c in all_of("kiln", ()) if c.site.kind == "derivative"}
    assert {"store", "store_from_elsewhere"} <= warm
    assert "store_from_zero" not in warm


def test_sites_are_what_moves_is_driven_measured_or_estimated():
    mass, *others = SPRING.parameters
    problem = replace(SPRING, parameters=(replace(mass, fixed=True), *others))
    expected = {"der(v)", "input F", "output y", "parameter k", "parameter c"}
    assert sites(listed(problem)) == expected


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_what_is_measured_is_a_site_whatever_its_causality(interface):
    problem = missing_effect_problem("mass_spring_damper", interface=interface)
    problem = with_outputs(problem, lambda output: replace(output, variable="x"))
    found = sites(listed(problem, forms=("bias",)))
    assert "output x" in found
    assert "output y" not in found


def test_in_co_simulation_states_are_out_of_reach():
    found = listed(missing_effect_problem("battery", interface="co_simulation"))
    assert {c.site.kind for c in found} == {"input", "output", "parameter"}
    followed = {
        kind: {n for c in found if c.site.kind == kind for n in c.effect.variables}
        for kind in ("parameter", "input", "output")
    }
    known = {"current", "extra"}
    own = {"extra", "voltage"}
    assert followed == {"parameter": {*known, "voltage"}, "input": own, "output": known}


def test_what_a_model_shows_may_flow_back_to_an_input_that_it_has_in_co_simulation():
    """A leak, a loss in proportion to both, and a hidden store: others where these lead."""
    found = keyed(listed(missing_effect_problem("battery", interface="co_simulation")))
    laws = {form for site, form, v in found if site == "input current" and v == ("voltage",)}
    assert laws == {"linear", "product", "store"}
    exchange = keyed(all_of("battery", ()))
    assert not any(site == "input current" and v == ("voltage",) for site, _, v in exchange)


def test_stores_of_amounts_in_a_row_may_begin_empty():
    tanks = {(str(c.site), c.form.name) for c in all_of("cascaded_tanks", ())}
    assert {("der(h1)", "two_stores_from_zero"), ("pair h1,h2", "store_between")} <= tanks
    warm = {c.form.name for c in all_of("kiln", ())}
    assert {"two_stores", "store_between"} <= warm
    assert "two_stores_from_zero" not in warm


def test_an_exchange_between_two_states_may_grow_with_anything_else():
    found = [c for c in all_of("kiln") if c.form.name == "power_times"]
    assert {c.effect.variables[0] for c in found} == {"T_plate - T_charge"}
    assert {c.effect.variables[1] for c in found} == {"power", "extra"}


def test_settings_choose_forms_and_sites():
    problem = missing_effect_problem("pendulum")
    found = listed(problem, forms=("coulomb", "gain"), sites=("der(speed)", "output y"))
    assert {(str(c.site), c.form.name) for c in found} == {
        ("der(speed)", "coulomb"),
        ("output y", "gain"),
    }


@pytest.mark.parametrize(
    ("without", "timed"), [((), True), (("functions of time",), False)], ids=["all", "mechanisms"]
)
def test_functions_of_time_can_be_left_out(without, timed):
    found = listed(missing_effect_problem("pendulum"), without=without)
    assert any(c.form.of_time_alone for c in found) is timed
    assert {"coulomb", "gain"} <= {c.form.name for c in found}


def declaring(effect):
    strength = Parameter(f"{effect.name}.k", 0.1, (0.0, 1.0))
    return replace(SPRING, effects=(effect,), parameters=(*SPRING.parameters, strength))


@pytest.mark.parametrize(
    "declared",
    [
        Effect("mine", "der(v)", "viscous"),
        Effect("mine", "der( v )", "viscous", ("v",)),
        Effect("mine", "der(v)", "product", ("F", "x")),
    ],
)
def test_a_declared_effect_is_no_candidate_however_it_is_written(declared):
    before = {c.effect for c in all_of("mass_spring_damper") if str(c.site) == "der(v)"}
    after = {c.effect for c in listed(declaring(declared), sites=("der(v)",))}
    (gone,) = before - after
    assert gone.form == declared.form
    assert frozenset(gone.variables) == frozenset(declared.variables or ("v",))


def test_names_are_not_those_of_declared_effects():
    theirs = declaring(Effect("coulomb_v", "der(v)", "constant"))
    assert "coulomb_v" not in {c.effect.name for c in listed(theirs, sites=("der(v)",))}


def test_nothing_depends_on_a_signal_that_a_training_experiment_lacks():
    three = missing_effect_problem("mass_spring_damper", experiments=3)
    for problem in (changed(SPRING, signals=()), changed(three, signals=(), role="test")):
        assert not any("extra" in c.effect.variables for c in listed(problem, sites=("der(v)",)))


def test_experiments_may_measure_different_outputs():
    problem = missing_effect_problem("two_mass_drive")
    problem = changed(problem, outputs=problem.experiments[1].outputs[1:])
    found = listed(problem, sites=("output motor_speed", "output load_speed"))
    assert {c.site.target for c in found} == {"motor_speed", "load_speed"}
    assert not any("motor_speed" in c.effect.variables for c in found)


def test_no_inputs_no_frequencies_and_an_output_that_stands_still():
    problem = missing_effect_problem("cascaded_tanks", experiments=1, signals=())
    run = replace(problem.experiments[0], inputs=(), values=(("h1", 4.0), ("h2", 2.0)))
    run = replace(run, outputs=(Output("y", run.outputs[0].times, np.zeros(601)),))
    found = listed(replace(problem, experiments=(run,)), frequencies=())
    assert {c.site.kind for c in found} == {"derivative", "pair", "output", "parameter"}
    assert not {"sine", "hum"} & {c.form.name for c in found}


def test_an_input_that_never_moves_is_nothing_to_depend_on():
    still = (Input("F", np.array([0.0, 6.0]), np.array([2.0, 2.0])),)
    runs = tuple(replace(e, inputs=still) for e in PLAIN.experiments)
    found = listed(replace(PLAIN, experiments=runs))
    assert {c.form.name for c in found if c.site.target == "F"} == {"product"}
    assert not any("F" in c.effect.variables for c in found)


@pytest.mark.parametrize(
    ("site", "form", "variables", "expected"),
    [
        ("der(v)", "coulomb", (), "der(v) += -k * tanh(v / width)"),
        ("der(h[1])", "linear", ("p.w",), "der(h[1]) += k * p.w"),
        ("pair a,b", "linear", ("a - b",), "der(a) += -k * (a - b), der(b) += back * (a - b)"),
        ("parameter k", "square", ("v",), "k -> k * (1 + e.k * (v^2 - at))"),
        ("input u", "delay", (), "u -> delay(u, tau)"),
        ("der(v)", "table", ("x",), "der(v) += table of x from low to high: k1, k2, k3, k4, k5, "
         "k6, k7"),
        ("input F", "gain", (), "F -> F * (1 + k)"),
        ("output y", "lag", (), "y -> z, z' = (y - z) / tau"),
        ("parameter R", "linear", ("i",), "R -> R * (1 + k * (i - at))"),
    ],
)  # fmt: skip
def test_the_equation_has_the_names_of_the_fmu(site, form, variables, expected):
    place = parse_site(site, "")
    effect = Effect("e", site, form, variables)
    made = EffectCandidate(effect, FORMS[place.kind, form], place, False, (), (), ())
    assert made.equation == expected


def test_functions_of_states_at_an_input_that_acts_on_several_of_them():
    """The crane's force moves the trolley and, through it, the load; friction is of what it moves.

    By Newton's law it pushes the trolley its own way and the load the other way.
    """
    at_input = [c for c in all_of("gantry_crane") if c.effect.site == "input F"]
    friction = {c.effect.variables[0]: c for c in at_input if c.form.name == "coulomb"}
    assert set(friction) == {"v", "w"}
    assert (friction["v"].lowest[0], friction["v"].highest[0]) == (0.0, np.inf)
    assert (friction["w"].lowest[0], friction["w"].highest[0]) == (-np.inf, 0.0)
    assert friction["v"].equation == "F -> F - k * tanh(v / width)"
    hinges = [c for c in at_input if c.form.name == "hinge"]
    assert {c.effect.variables[0] for c in hinges} == {"x", "v", "phi", "w"}
    assert {(c.lowest[0], c.highest[0]) for c in hinges} == {(-np.inf, np.inf)}


@pytest.mark.parametrize("name", ["mass_spring_damper", "pendulum", "two_mass_drive"])
def test_no_functions_of_states_at_an_input_that_acts_on_one_of_them(name):
    """At that state's derivative they say the same."""
    found = {c.form.name for c in all_of(name) if c.site.kind == "input"}
    assert "product" in found
    assert not {"coulomb", "quadratic", "hinge", "gap"} & found


def test_a_time_constant_is_not_shorter_than_a_tenth_of_what_time_resolves():
    """The spring is sampled every 0.01 s, and may communicate every 0.05 s only."""
    found = all_of("mass_spring_damper")
    lags = [c for c in found if c.form.name == "lag"]
    assert lags
    assert [c.lowest[0] for c in lags] == pytest.approx([0.1 * 0.01] * len(lags))
    delays = [c for c in found if c.form.name == "delay" and c.site.kind == "input"]
    costs_no_steps = [0.05 * 0.01] * len(delays)
    assert [c.lowest[0] for c in delays] == pytest.approx(costs_no_steps)
    together = missing_effect_problem("mass_spring_damper", interface="co_simulation")
    model = replace(together.model, solver=Solver("fmu", step=0.05))
    description, runs = simulated(together)
    fixed = replace(description, variable_steps=False)
    settings = LoopSettings(forms=("lag",))
    lags = make_candidates(replace(together, model=model), fixed, runs, (), settings)
    assert [c.lowest[0] for c in lags] == pytest.approx([0.1 * 0.05] * len(lags))
    assert [c.grid[0][0] for c in lags] == pytest.approx([0.05] * len(lags))


def test_a_state_that_stops_itself_does_so_no_faster_than_can_be_told():
    """The tanks are sampled every 4 s, which is far slower than they are themselves."""
    problem = missing_effect_problem("cascaded_tanks")
    _, runs = simulated(problem)
    step = float(np.median(np.diff(problem.experiments[0].outputs[0].times)))
    rates = [np.abs(run.linear.A.row(0)[:, 0]).max() for run in runs]
    steepest = 10.0 * max(1.0 / step, *rates)
    found = keyed(all_of("cascaded_tanks"))
    own = found["der(h1)", "hinge", ("h1",)]
    assert (own.lowest[0], own.highest[0]) == pytest.approx((-steepest, steepest))
    over = found["pair h1,h2", "overflow", ("h1",)]
    assert (over.lowest[0], over.highest[:2]) == (0.0, (pytest.approx(steepest), np.inf))
    between = found["pair h1,h2", "hinge", ("h1 - h2",)]  # the second stops itself too
    assert max(between.highest[:2]) < np.inf
    other = found["der(h2)", "hinge", ("h1",)]
    assert (other.lowest[0], other.highest[0]) == (-np.inf, np.inf)
    assert found["der(h1)", "linear", ("h2",)].highest[0] == np.inf


@pytest.fixture(scope="module")
def uneven():
    """Two outputs of different sampling, the second measured at a few times only."""
    problem = missing_effect_problem("two_mass_drive")
    few = {"times": np.array([0.1234, 0.5, 2.71]), "values": np.zeros(3)}
    changes = {"motor_speed": {}, "load_speed": few}
    problem = with_outputs(problem, lambda o: replace(o, **changes[o.variable]))
    return problem, simulated(problem)[1]


def test_residuals_are_measured_less_simulated_over_sigma(uneven):
    problem, (course, _) = uneven
    change = np.zeros((*course.outputs.shape, 1))
    change[:, 0, 0] = course.times
    change[:, 1, 0] = 100.0 + course.times
    first, second = problem.experiments[0].outputs
    expected = [-first.times / first.sigma, -(100.0 + second.times) / second.sigma]
    found = course.residual_change(change)
    np.testing.assert_allclose(found[:, 0], np.concatenate(expected), rtol=1e-14)


def test_states_inputs_measured_signals_and_outputs_have_names(uneven):
    problem, (course, other) = uneven
    names = {"twist", "w_motor", "w_load", "torque", "extra", "motor_speed", "load_speed"}
    assert set(course.signals) == names
    given = problem.experiments[0].inputs[0]
    at = np.searchsorted(course.times, given.times)
    np.testing.assert_allclose(course.signal("torque")[at], given.values, rtol=1e-13)
    gap = course.signal("w_motor") - course.signal("w_load")
    np.testing.assert_array_equal(course.signal("w_motor - w_load"), gap)
    assert course.has("w_motor - w_load")
    assert not course.has("w_motor - speed")
    both = pooled([course, other], "extra")
    np.testing.assert_array_equal(both, [*course.signal("extra"), *other.signal("extra")])


def test_states_that_effects_bring_are_nothing_to_depend_on():
    problem = missing_effect_problem("mass_spring_damper")
    with opened(problem) as bench:
        start = unfitted(bench).start
        lagged = Effect("lag", "input F", "lag")
        tau = Parameter("lag.tau", 0.1, (0.01, 1.0))
        grown = replace(problem, effects=(lagged,), parameters=(*problem.parameters, tau))
        courses = bench.fitter.trajectories(unfitted(bench, replace(start, problem=grown)))
    assert set(courses[0].signals) == {"x", "v", "F", "extra", "y"}
    assert np.abs(courses[0].signal("F") - problem.experiments[0].inputs[0].values).max() > 0.1


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_what_is_held_keeps_its_value_until_the_next_sample(interface):
    problem = missing_effect_problem("battery", interface=interface)
    steps = np.array([0.0, 600.0, 1300.0])
    held = Input("current", steps, np.array([1.0, 2.0, -1.0]), "hold")
    warm = Input("extra", steps, np.array([20.0, 30.0, 40.0]), "hold")
    run = replace(problem.experiments[0], inputs=(held,), signals=(warm,))
    _, (course,) = simulated(replace(problem, experiments=(run,)))
    expected = np.where(course.times < 600.0, 1.0, np.where(course.times < 1300.0, 2.0, -1.0))
    np.testing.assert_array_equal(course.signal("current"), expected)
    np.testing.assert_array_equal(course.signal("extra"), 10.0 * np.digitize(course.times, steps)
                                  + 10.0)  # fmt: skip


RATE = 2.0 * np.pi
"""Of six turns in a record, of 6 s with 0.01 s between two samples."""
SIZE = 3.0
RMS = SIZE / np.sqrt(2.0)


@pytest.fixture(scope="module")
def spring():
    return simulated(PLAIN)


@pytest.fixture
def candidates(spring):
    """Those of a spring whose signals are given, as functions of time."""

    def made(problem=PLAIN, **signals):
        description, runs = spring
        given = [
            replace(
                run,
                signals=dict(run.signals)
                | {n: np.broadcast_to(f(run.times), len(run.times)) for n, f in signals.items()},
            )
            for run in runs
        ]
        found = make_candidates(problem, description, given, (2.5, 7.0), LoopSettings())
        return {(str(c.site), c.form.name, *c.effect.variables): c for c in found}

    return made


def sine(t):
    return SIZE * np.sin(RATE * t)


def axis(candidate, name):
    """The values of a coefficient that are looked at, ascending."""
    place = [c.name for c in candidate.form.coefficients].index(name)
    return sorted({values[place] for values in candidate.grid})


V = ("der(v)", "v")
SCALES = [
    (*V, "coulomb", "width", lambda g: g * RMS),
    (*V, "gap", "at", lambda g: g * SIZE),
    (*V, "hinge", "at", lambda g: SIZE * np.sin(np.pi * (g - 0.5))),
    (*V, "dahl", "x0", lambda g: g * RMS / RATE),
    (*V, "table", "low", lambda g: -SIZE * np.cos(0.01 * np.pi)),
    (*V, "table", "high", lambda g: SIZE * np.cos(0.01 * np.pi)),
    ("der(v)", "x", "periodic", "n", lambda g: 2.0 * np.pi * g / 0.2),
    ("parameter k", "v", "linear", "at", lambda g: 0.0),
    ("parameter k", "v", "magnitude", "at", lambda g: 2.0 * SIZE / np.pi),
    ("parameter k", "v", "square", "at", lambda g: RMS**2),
    ("parameter k", "", "drift", "at", lambda g: 3.0),
    ("output y", "", "lag", "tau", lambda g: g * 0.01),
    ("output y", "", "mode", "f", lambda g: g / 0.01),
    ("output y", "", "saturation", "limit", lambda g: g * (SIZE + 1.0)),
    ("output y", "", "clip_above", "limit", lambda g: 1.0 - SIZE + g * 2.0 * SIZE),
    ("input F", "", "rate_limit", "rate", lambda g: g * SIZE * RATE),
]


@pytest.mark.parametrize(("site", "variable", "form", "coefficient", "expected"), SCALES)
def test_a_grid_is_in_proportion_to_the_signals(
    candidates, site, variable, form, coefficient, expected
):
    found = candidates(v=sine, F=sine, y=lambda t: sine(t) + 1.0, x=lambda t: 0.1 * np.sin(9.0 * t))
    shares = {c.name: c.grid for c in FORMS[parse_site(site, "").kind, form].coefficients}
    key = (site, form, variable) if variable else (site, form)
    truth = sorted({expected(g) for g in shares[coefficient] or (1.0,)})
    assert axis(found[key], coefficient) == pytest.approx(truth, rel=1e-2, abs=2e-2)


def test_waves_begin_at_the_peaks_of_a_spectrum(candidates):
    assert axis(candidates()["der(v)", "sine"], "f") == [2.5, 7.0]


@pytest.mark.parametrize(("span", "whole"), [(1.0, []), (200.0, list(range(1, 16)))])
def test_waves_of_an_angle_of_many_turns_are_whole_numbers_too(candidates, span, whole):
    found = axis(candidates(x=lambda t: span * t / t[-1])["der(v)", "periodic", "x"], "n")
    repeats = 2.0 * np.pi * np.arange(3, 33) / 2.0 / span
    assert found == pytest.approx(sorted([*repeats, *(n for n in whole if n > repeats[-1])]))


@pytest.mark.parametrize(("solver", "moved"), [("rk4", 1.0), ("dormand_prince", 0.0)])
def test_a_switch_is_no_narrower_than_what_a_fixed_step_goes_across(candidates, solver, moved):
    """|v'| = 3 RATE |cos| has the median 3 RATE / sqrt(2); a step is one from sample to sample."""
    problem = replace(PLAIN, model=replace(PLAIN.model, solver=Solver(solver)))
    found = axis(candidates(problem, v=sine)["der(v)", "coulomb", "v"], "width")
    crossed = moved * 0.01 * SIZE * RATE / np.sqrt(2.0)
    shares = FORMS["derivative", "coulomb"].coefficients[-1].grid
    assert found == pytest.approx(sorted({max(g * RMS, crossed) for g in shares}), rel=1e-2)


@pytest.mark.parametrize(
    ("form", "signal", "expected"),
    [
        ("linear", sine, True),
        ("linear", lambda t: 5.0, False),
        ("linear", lambda t: 0.0, False),
        ("coulomb", sine, True),
        ("coulomb", lambda t: sine(t) + 2.9, False),
        ("coulomb", lambda t: np.abs(sine(t)), False),
        ("square_root", lambda t: sine(t) + 4.0, True),
        ("square_root", lambda t: 1e-9 * (sine(t) + 2.0), False),
        ("square_root", lambda t: 1e-9 * (sine(t) + 3.0), True),
        ("table", sine, True),
        ("table", lambda t: np.where(t > 5.97, 1.0, 0.0), False),
    ],
)
def test_forms_that_make_sense_for_a_signal(candidates, form, signal, expected):
    assert (("der(v)", form, "v") in candidates(v=signal)) is expected


def test_a_product_needs_two_signals_that_move(candidates):
    assert not any("product" in key and "F" in key for key in candidates(F=lambda t: 2.0))


def test_an_experiment_without_a_signal_does_not_count():
    problem = missing_effect_problem("two_mass_drive", signals=())
    problem = changed(problem, outputs=problem.experiments[1].outputs[:1])
    description, runs = simulated(problem)
    settings = LoopSettings(forms=("saturation",), sites=("output load_speed",))
    (found,) = make_candidates(problem, description, runs, (), settings)
    largest = np.abs(runs[0].signal("load_speed")).max()
    assert axis(found, "limit")[-1] == pytest.approx(0.95 * largest)


def curve(kind, name, site, variables):
    ends = {"low": 0.0, "high": 6.0, "back": 2.0}
    form = FORMS[kind, name]
    grid = (tuple(ends.get(c.name, 0.0) for c in form.coefficients),)
    free = (-np.inf,) * len(form.coefficients), (np.inf,) * len(form.coefficients)
    effect = Effect("e", site, name, variables)
    return EffectCandidate(effect, form, parse_site(site, "site"), False, grid, *free)


@pytest.mark.parametrize(
    ("kind", "name", "site", "variables"),
    [
        ("derivative", "table", "der(v)", ("x",)),
        ("pair", "table", "pair v,w", ("v",)),
        ("input", "characteristic", "input u", ()),
        ("output", "table", "output y", ("x",)),
        ("parameter", "table", "parameter k", ("x",)),
    ],
)
def test_a_finer_curve_says_the_same_where_the_coarse_one_was(kind, name, site, variables):
    coarse = curve(kind, name, site, variables)
    heights = dict(zip(coarse.strengths, np.sin(np.arange(len(coarse.strengths))), strict=True))
    values = [heights.get(c.name, v) for c, v in zip(coarse.form.coefficients, coarse.grid[0],
                                                     strict=True)]  # fmt: skip
    form = finer_form(coarse)
    course = np.linspace(1.0, 5.0, 100)
    goes = SimpleNamespace(has=lambda name: True, signal=lambda name: course)
    finer, found = refined(coarse, values, [goes], form)
    known = dict(zip([c.name for c in form.coefficients], found, strict=True))
    assert form.values == 13
    if len(coarse.strengths) == 7:  # all are free: it goes to where its argument does
        assert (known["low"], known["high"]) == pytest.approx((1.0, 5.0), abs=0.03)
    else:
        assert (known["low"], known["high"]) == (0.0, 6.0)
    at = np.linspace(known["low"], known["high"], 13)
    expected = np.interp(at, np.arange(7), [heights.get(f"k{i}", 0.0) for i in range(1, 8)])
    np.testing.assert_allclose([known.get(f"k{i}", 0.0) for i in range(1, 14)], expected)
    for parameter in finer.parameters(found):
        assert parameter.lower <= parameter.start <= parameter.upper
    assert known.get("back", 2.0) == 2.0


def test_a_filter_of_higher_order_says_the_same_and_is_the_last():
    coarse = curve("derivative", "hidden_dynamics", "der(v)", ("x",))
    finer, values = refined(coarse, (1.0, -2.0, 0.5, 7.0, 1.0), [], finer_form(coarse))
    assert values == [1.0, -2.0, 0.5, 0.0, 0.0, 7.0, 1.0]
    assert [len(e.form.states) for e in (coarse, finer)] == [3, 5]
    assert finer.effect.form == "hidden_dynamics_5"
    assert finer_form(finer) is None


def test_there_are_three_resolutions_and_none_finer():
    coarse = curve("derivative", "table", "der(v)", ("x",))
    sizes = [coarse.form.values]
    while (form := finer_form(coarse)) is not None:
        coarse = in_finer_form(coarse, form)
        sizes.append(coarse.form.values)
    assert sizes == [7, 13, 25]
    assert coarse.effect.form == "table_25"
