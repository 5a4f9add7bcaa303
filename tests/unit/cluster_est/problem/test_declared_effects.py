"""What a declared coefficient gets where little is said of it, and what is refused."""

import math

import pytest

from cluster_est.errors import ConfigError
from cluster_est.problem.effects.declared import DeclaredCoefficient, DeclaredEffect, make_effect
from cluster_est.problem.parameter import Parameter


def declared(form: str, site: str, **coefficients: DeclaredCoefficient) -> dict[str, Parameter]:
    effect = DeclaredEffect("", site, form, variables=(), coefficients=coefficients)
    return {p.name: p for p in make_effect(effect).parameters}


def test_a_time_constant_is_searched_by_its_logarithm() -> None:
    tau = declared("lag", "input F", tau=DeclaredCoefficient(60.0))["lag.tau"]
    assert (tau.scale, tau.lower, tau.upper) == ("log", 0.06, math.inf)
    bounded = DeclaredCoefficient(60.0, bounds=(10.0, 1000.0))
    tau = declared("lag", "input F", tau=bounded)["lag.tau"]
    assert (tau.scale, tau.lower, tau.upper) == ("log", 10.0, 1000.0)


def test_what_a_config_says_is_kept() -> None:
    kept = DeclaredCoefficient(60.0, bounds=(0.0, 1000.0))
    tau = declared("lag", "input F", tau=kept)["lag.tau"]
    assert (tau.scale, tau.lower) == ("linear", 0.0)
    kept = DeclaredCoefficient(60.0, bounds=(10.0, 1000.0), scale="linear")
    assert declared("lag", "input F", tau=kept)["lag.tau"].scale == "linear"
    fixed = DeclaredCoefficient(0.01, fixed=True)
    width = declared("coulomb", "der(v)", width=fixed)["coulomb.width"]
    assert (width.scale, width.lower, width.fixed) == ("linear", 0.0, True)


def test_a_strength_may_be_nothing() -> None:
    given = {n: DeclaredCoefficient(0.1) for n in ("k", "peak", "vs", "width")}
    found = declared("stribeck", "der(v)", **given)
    scales = {name: (p.scale, p.lower) for name, p in found.items()}
    assert scales == {
        "stribeck.k": ("linear", 0.0),
        "stribeck.peak": ("linear", 0.0),
        "stribeck.vs": ("log", 1e-4),
        "stribeck.width": ("log", 1e-4),
    }


def test_what_has_no_divisor_may_be_linear_to_its_end() -> None:
    zone = declared("dead_zone", "input F", k=DeclaredCoefficient(0.5, scale="linear"))
    assert (zone["dead_zone.k"].scale, zone["dead_zone.k"].lower) == ("linear", 0.0)
    vs = {n: DeclaredCoefficient(0.1, scale="linear") for n in ("vs", "width")}
    assert declared("stribeck", "der(v)", **vs)["stribeck.vs"].lower == 1e-4
    assert declared("delay", "input F")["delay.tau"].start == 0.0


@pytest.mark.parametrize(
    ("form", "site", "given"),
    [
        ("stribeck", "der(v)", {"vs": 0.0, "width": 0.01}),
        ("coulomb", "der(v)", {"width": 0.0}),
        ("lagged", "der(v)", {"tau": 0.0}),
        ("lag", "input F", {"tau": 0.0}),
        ("lag", "output y", {}),
        ("dahl", "der(v)", {"x0": 0.0}),
    ],
)
def test_a_divisor_of_nothing_is_refused(form: str, site: str, given: dict[str, float]) -> None:
    starts = {name: DeclaredCoefficient(value) for name, value in given.items()}
    sentence = rf"effect '{form}': parameters\.\w+\.start: must not be 0, because {form} divides by"
    with pytest.raises(ConfigError, match=sentence):
        declared(form, site, **starts)


def test_a_lag_that_is_held_at_nothing_is_none() -> None:
    held = declared("lag", "input F", tau=DeclaredCoefficient(0.0, fixed=True))
    assert held["lag.tau"].start == 0.0
