import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_est.errors import ConfigError
from cluster_est.problem.declared_effects import DeclaredCoefficient, DeclaredEffect, make_effect
from cluster_est.problem.formulas import Formula
from cluster_est.problem.free_curves import TableShape, ValueTable


def declared(form, site, **coefficients):
    effect = DeclaredEffect("", site, form, variables=(), coefficients=coefficients)
    return {p.name: p for p in make_effect(effect).parameters}


def test_a_time_constant_is_searched_by_its_logarithm():
    tau = declared("lag", "input F", tau=DeclaredCoefficient(60.0))["lag.tau"]
    assert (tau.scale, tau.lower, tau.upper) == ("log", 0.06, math.inf)
    bounded = DeclaredCoefficient(60.0, bounds=(10.0, 1000.0))
    tau = declared("lag", "input F", tau=bounded)["lag.tau"]
    assert (tau.scale, tau.lower, tau.upper) == ("log", 10.0, 1000.0)


def test_what_a_config_says_is_kept():
    kept = DeclaredCoefficient(60.0, bounds=(0.0, 1000.0))
    tau = declared("lag", "input F", tau=kept)["lag.tau"]
    assert (tau.scale, tau.lower) == ("linear", 0.0)
    kept = DeclaredCoefficient(60.0, bounds=(10.0, 1000.0), scale="linear")
    assert declared("lag", "input F", tau=kept)["lag.tau"].scale == "linear"
    fixed = DeclaredCoefficient(0.01, fixed=True)
    width = declared("coulomb", "der(v)", width=fixed)["coulomb.width"]
    assert (width.scale, width.lower, width.fixed) == ("linear", 0.0, True)


def test_a_strength_may_be_nothing():
    given = {n: DeclaredCoefficient(0.1) for n in ("k", "peak", "vs", "width")}
    found = declared("stribeck", "der(v)", **given)
    scales = {name: (p.scale, p.lower) for name, p in found.items()}
    assert scales == {
        "stribeck.k": ("linear", 0.0),
        "stribeck.peak": ("linear", 0.0),
        "stribeck.vs": ("log", 1e-4),
        "stribeck.width": ("log", 1e-4),
    }


def test_what_has_no_divisor_may_be_linear_to_its_end():
    zone = declared("dead_zone", "input F", k=DeclaredCoefficient(0.5, scale="linear"))
    assert (zone["dead_zone.k"].scale, zone["dead_zone.k"].lower) == ("linear", 0.0)
    vs = {n: DeclaredCoefficient(0.1, scale="linear") for n in ("vs", "width")}
    assert declared("stribeck", "der(v)", **vs)["stribeck.vs"].lower == 1e-4
    assert declared("delay", "input F")["delay.tau"].start == 0.0


@pytest.mark.parametrize(
    ("form", "site", "starts"),
    [
        ("stribeck", "der(v)", {"vs": 0.0, "width": 0.01}),
        ("coulomb", "der(v)", {"width": 0.0}),
        ("lagged", "der(v)", {"tau": 0.0}),
        ("lag", "input F", {"tau": 0.0}),
        ("lag", "output y", {}),
        ("dahl", "der(v)", {"x0": 0.0}),
    ],
)
def test_a_divisor_of_nothing_is_refused(form, site, starts):
    starts = {name: DeclaredCoefficient(value) for name, value in starts.items()}
    sentence = rf"effect '{form}': parameters\.\w+\.start: is 0, but {form} divides by"
    with pytest.raises(ConfigError, match=sentence):
        declared(form, site, **starts)


def test_a_lag_that_is_held_at_nothing_is_none():
    held = declared("lag", "input F", tau=DeclaredCoefficient(0.0, fixed=True))
    assert held["lag.tau"].start == 0.0


ZEROS = ((), (0,), (3,), (0, 6), (2, 5), (6,))
"""Points at which a table is 0 by definition."""


def table(points, zeros, change=0.5, starts=None):
    names = tuple(None if i in zeros else f"map.k{i}" for i in range(len(points)))
    starts = starts or (0.0,) * len(points)
    shape = TableShape(change, bounds=(-50.0, 50.0))
    points = tuple(float(each) for each in points)
    return ValueTable("t", "map.", names, points, tuple(starts), shape)


def values_of(made, unknowns):
    """Every value, by its expression and those before it."""
    columns = {name: np.array([value]) for name, value in unknowns.items()}
    for name, text in made.expressions():
        columns[name] = Formula(text, tuple(columns)).values(columns, 1)
    return np.array([0.0 if name is None else columns[name][0] for name in made.values])


@pytest.mark.parametrize("zeros", ZEROS)
@settings(max_examples=8, deadline=None)  # each reads a formula for every value
@given(seed=st.integers(0, 10_000))
def test_the_slope_changes_by_the_unknowns_and_the_zeros_are_there(zeros, seed):
    generator = np.random.default_rng(seed)
    points = np.cumsum(generator.uniform(0.2, 2.0, 7)) - 3.0
    made = table(points, zeros)
    unknowns = {each.name: float(generator.normal()) for each in made.unknowns()}
    found = values_of(made, unknowns)
    bends = [unknowns[f"map.bend_{i}"] for i in range(2, 7)]
    slopes = np.diff(found) / np.diff(points)
    assert np.diff(slopes) == pytest.approx(bends, abs=1e-9)
    assert found[list(zeros)] == pytest.approx(0.0, abs=1e-9)
    assert len(unknowns) == 7 - len(zeros)  # as many as there are free values
    if not zeros:
        assert found[0] == unknowns["map.level"]


@pytest.mark.parametrize("zeros", ZEROS)
def test_it_starts_from_the_values_that_are_given(zeros):
    points = np.array([-2.0, -1.5, 0.0, 0.3, 1.0, 1.2, 2.0])
    starts = np.array([0.3, -0.2, 0.5, 0.4, 0.6, 0.1, -0.3])
    starts[list(zeros)] = 0.0
    made = table(points, zeros, change=2.0, starts=starts.tolist())
    found = values_of(made, {each.name: each.start for each in made.unknowns()})
    assert found == pytest.approx(starts, abs=1e-12)
