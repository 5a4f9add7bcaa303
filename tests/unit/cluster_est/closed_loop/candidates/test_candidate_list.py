"""Which effects could be missing: sites, variables, names."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est import Parameter, Solver
from cluster_est.closed_loop.candidates.equation import equation_text
from cluster_est.closed_loop.candidates.kinematics import integrated_states
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.candidates.scales import _waves
from cluster_est.closed_loop.settings import LoopSettings
from workers.effects.forms import FORMS
from workers.effects.site import parse_site
from workers.messages import Effect, Input, MatrixSeries, Output


def listed(problem, frequencies=(3.0,), **settings):
    with opened(problem) as bench:
        courses = bench.trajectories(unfitted(bench))
        return make_candidates(
            problem, bench.description, courses, frequencies, LoopSettings(**settings)
        )


def changed(problem, **changes):
    """A problem whose second experiment is different."""
    first, second, *rest = problem.experiments
    return replace(problem, experiments=(first, replace(second, **changes), *rest))


@pytest.mark.parametrize(
    ("name", "kinematic"),
    [
        ("mass_spring_damper", {"x"}),
        ("pendulum", {"angle"}),
        ("cascaded_tanks", set()),
        ("two_mass_drive", set()),
        ("gantry_crane", {"x", "phi"}),
        ("battery", set()),
    ],
)
def test_kinematic_states(name, kinematic):
    with opened(missing_effect_problem(name)) as bench:
        assert set(integrated_states(bench.trajectories(unfitted(bench)))) == kinematic


def test_functions_of_the_difference_to_what_is_around_a_state():
    """A kiln in a hall: an input of the state's unit that acts on it, and no other one."""
    own = {(str(c.site), c.form.name, c.effect.variables) for c in listed(
        missing_effect_problem("kiln", signals=())
    )}  # fmt: skip
    lost = ("T_charge - T_ambient",)
    assert ("der(T_charge)", "power", lost) in own
    assert ("parameter G_charge", "linear", lost) in own
    assert ("der(T_charge)", "radiation", ("T_charge", "T_ambient")) in own
    assert ("pair T_plate,T_charge", "radiation", ("T_plate", "T_charge")) in own
    assert not any(site == "der(T_plate)" and v == lost for site, _, v in own)
    assert not any("power" in v for _, _, variables in own for v in variables if " - " in v)


def test_without_units_nothing_is_known_to_be_around_a_state():
    own = listed(missing_effect_problem("mass_spring_damper", signals=()))
    assert not any(
        " - " in v for c in own if c.site.kind == "derivative" for v in c.effect.variables
    )


@pytest.mark.parametrize(("first", "named"), [(0.0, False), (2.0, True)])
def test_a_lag_may_begin_at_zero_only_where_its_signal_does_not(first, named):
    problem = missing_effect_problem("mass_spring_damper", signals=())
    runs = []
    for run in problem.experiments:
        (force,) = run.inputs
        values = force.values - force.values[0] + first
        runs.append(replace(run, inputs=(replace(force, values=values),)))
    own = {c.form.name for c in listed(replace(problem, experiments=tuple(runs)))}
    assert ("lag_from_rest" in own) is named
    assert ("mode_from_rest" in own) is named
    assert "lag" in own


def test_a_kinematic_state_is_one_at_rest_too():
    problem = missing_effect_problem("mass_spring_damper", experiments=1)
    still = Input("F", np.array([0.0, 6.0]), np.zeros(2))
    run = replace(problem.experiments[0], inputs=(still,), values=())
    with opened(replace(problem, experiments=(run,))) as bench:
        assert integrated_states(bench.trajectories(unfitted(bench))) == {"x": ("v", 1.0)}


def test_a_way_is_the_integral_of_a_speed_but_for_a_radius():
    with opened(missing_effect_problem("mass_spring_damper", experiments=1)) as bench:
        (run,) = bench.trajectories(unfitted(bench))
    i = run.linear.state_names.index("x")
    geared = np.ones(2)
    geared[i] = 0.05
    rates = MatrixSeries.of(np.asarray(run.linear.A) * geared[:, None])
    linear = replace(run.linear, A=rates, derivatives=run.linear.derivatives * geared)
    assert integrated_states([replace(run, linear=linear)]) == {"x": ("v", pytest.approx(0.05))}


def test_ripples_are_functions_of_the_position_of_what_they_push():
    def places(name):
        return {
            (str(c.site), *c.effect.variables)
            for c in listed(missing_effect_problem(name))
            if c.form.family == "ripple"
        }

    assert places("mass_spring_damper") == {("der(v)", "x")}
    speeds = {("der(w_motor)", "w_motor"), ("der(w_load)", "w_load")}
    found = places("two_mass_drive")  # the twist of its shaft is the integral of neither speed
    assert {place for place in found if place[0] != "der(twist)"} == speeds


@pytest.mark.parametrize(("stop", "whole"), [(1.0, 0), (200.0, 15)])
def test_waves_of_an_angle_of_many_turns_are_whole_numbers_too(stop, whole):
    way = np.array([0.0, stop])
    repeats = np.arange(3, 33) / 2.0
    found = _waves(repeats, float(np.ptp(way)))
    np.testing.assert_allclose(found[:30] * stop / (2.0 * np.pi), repeats)
    assert found[30:].tolist() == [n for n in range(1, whole + 1) if n > found[29]]


def test_sites_are_what_moves_is_driven_measured_or_estimated():
    problem = missing_effect_problem("mass_spring_damper")
    mass, *others = problem.parameters
    problem = replace(problem, parameters=(replace(mass, fixed=True), *others))
    sites = {str(c.site) for c in listed(problem)}
    assert sites == {"der(v)", "input F", "output y", "parameter k", "parameter c"}


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_what_is_measured_is_a_site_whatever_its_causality(interface):
    problem = missing_effect_problem("mass_spring_damper", interface=interface)
    runs = []
    for run in problem.experiments:
        (output,) = run.outputs
        runs.append(replace(run, outputs=(replace(output, variable="x"),)))
    sites = {str(c.site) for c in listed(replace(problem, experiments=tuple(runs)))}
    assert "output x" in sites
    assert "output y" not in sites


def test_in_co_simulation_states_are_out_of_reach():
    problem = missing_effect_problem("battery", interface="co_simulation")
    found = listed(problem)
    assert {c.site.kind for c in found} == {"input", "output", "parameter"}
    names = {name for c in found for name in c.effect.variables}
    assert names == {"current", "extra"}


def test_settings_choose_forms_and_sites():
    problem = missing_effect_problem("pendulum")
    found = listed(problem, forms=("coulomb", "gain"), sites=("der(speed)", "output y"))
    assert {(str(c.site), c.form.name) for c in found} == {
        ("der(speed)", "coulomb"),
        ("output y", "gain"),
    }


@pytest.mark.parametrize(
    "declared",
    [
        Effect("mine", "der(v)", "viscous"),
        Effect("mine", "der(v)", "viscous", ("v",)),
        Effect("mine", "der( v )", "viscous", ("v",)),
        Effect("mine", "der(v)", "product", ("F", "x")),
    ],
)
def test_a_declared_effect_is_no_candidate_however_it_is_written(declared):
    problem = missing_effect_problem("mass_spring_damper")
    strength = Parameter("mine.k", 0.1, 0.0, 1.0)
    before = listed(problem, sites=("der(v)",))
    problem = replace(problem, effects=(declared,), parameters=(*problem.parameters, strength))
    after = listed(problem, sites=("der(v)",))
    gone = {c.effect for c in before} - {c.effect for c in after}
    assert {(e.form, frozenset(e.variables)) for e in gone} == {
        (declared.form, frozenset(declared.variables or ("v",)))
    }


def test_names_are_not_those_of_declared_effects():
    problem = missing_effect_problem("mass_spring_damper")
    theirs = Effect("coulomb_v", "der(v)", "constant")
    strength = Parameter("coulomb_v.k", 0.1, 0.0, 1.0)
    problem = replace(problem, effects=(theirs,), parameters=(*problem.parameters, strength))
    assert "coulomb_v" not in {c.effect.name for c in listed(problem)}


def test_nothing_depends_on_a_signal_that_an_experiment_lacks():
    problem = changed(missing_effect_problem("mass_spring_damper"), signals=())
    assert not any("extra" in c.effect.variables for c in listed(problem))
    problem = missing_effect_problem("mass_spring_damper", experiments=3)
    problem = changed(problem, signals=(), role="test")
    assert not any("extra" in c.effect.variables for c in listed(problem))


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
    problem = missing_effect_problem("mass_spring_damper", signals=())
    steady = tuple(
        replace(e, inputs=(Input("F", np.array([0.0, 6.0]), np.array([2.0, 2.0])),))
        for e in problem.experiments
    )
    found = listed(replace(problem, experiments=steady))
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
        (
            "der(v)",
            "table",
            ("x",),
            "der(v) += table of x from low to high: k1, k2, k3, k4, k5, k6, k7",
        ),
        ("input F", "gain", (), "F -> F * (1 + k)"),
        ("output y", "lag", (), "y -> z, z' = (y - z) / tau"),
        ("parameter R", "linear", ("i",), "R -> R * (1 + k * (i - at))"),
    ],
)
def test_the_equation_has_the_names_of_the_fmu(site, form, variables, expected):
    place = parse_site(site, "")
    effect = Effect("e", site, form, variables)
    assert equation_text(effect, FORMS[place.kind, form], place) == expected


def test_functions_of_states_at_an_input_that_acts_on_several_of_them():
    """The crane's force moves the trolley and, through it, the load; friction is of what it moves.

    By Newton's law it pushes the trolley its own way and the load the other way.
    """
    at_input = [
        c for c in listed(missing_effect_problem("gantry_crane")) if c.effect.site == "input F"
    ]
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
    found = [c for c in listed(missing_effect_problem(name)) if c.site.kind == "input"]
    assert "product" in {c.form.name for c in found}
    assert not {"coulomb", "quadratic", "hinge", "gap"} & {c.form.name for c in found}


def test_a_time_constant_is_not_shorter_than_a_tenth_of_what_time_resolves():
    """The spring is sampled every 0.01 s, and may communicate every 0.05 s only."""
    found = listed(missing_effect_problem("mass_spring_damper"))
    lags = [c for c in found if c.form.name == "lag"]
    assert lags
    assert [c.lowest[0] for c in lags] == pytest.approx([0.1 * 0.01] * len(lags))
    delays = [c for c in found if c.form.name == "delay" and c.site.kind == "input"]
    assert [c.lowest[0] for c in delays] == pytest.approx(
        [0.05 * 0.01] * len(delays)
    )  # costs no steps
    together = missing_effect_problem("mass_spring_damper", interface="co_simulation")
    model = replace(together.model, solver=Solver("fmu", step=0.05))
    fixed = replace(together.describe(), variable_steps=False)
    with opened(together) as bench:
        trajectories = bench.trajectories(unfitted(bench))
    found = make_candidates(replace(together, model=model), fixed, trajectories, (), LoopSettings())
    lags = [c for c in found if c.form.name == "lag"]
    assert [c.lowest[0] for c in lags] == pytest.approx([0.1 * 0.05] * len(lags))
    assert [c.grid[0][0] for c in lags] == pytest.approx([0.05] * len(lags))


def test_a_state_that_stops_itself_does_so_no_faster_than_can_be_told():
    """The tanks are sampled every 4 s, which is far slower than they are themselves."""
    problem = missing_effect_problem("cascaded_tanks")
    with opened(problem) as bench:
        trajectories = bench.trajectories(unfitted(bench))
    step = float(np.median(np.diff(problem.experiments[0].outputs[0].times)))
    rates = [np.abs(t.linear.A.row(0)[:, 0]).max() for t in trajectories]
    steepest = 10.0 * max(1.0 / step, *rates)
    found = {(str(c.site), c.form.name, c.effect.variables): c for c in listed(problem)}
    own = found["der(h1)", "hinge", ("h1",)]
    assert (own.lowest[0], own.highest[0]) == pytest.approx((-steepest, steepest))
    over = found["pair h1,h2", "overflow", ("h1",)]
    assert (over.lowest[0], over.highest[:2]) == (0.0, (pytest.approx(steepest), np.inf))
    between = found["pair h1,h2", "hinge", ("h1 - h2",)]  # the second stops itself too
    assert max(between.highest[:2]) < np.inf
    other = found["der(h2)", "hinge", ("h1",)]
    assert (other.lowest[0], other.highest[0]) == (-np.inf, np.inf)
    drag = found["der(h1)", "linear", ("h2",)]
    assert drag.highest[0] == np.inf
