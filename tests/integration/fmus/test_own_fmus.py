"""The test FMUs show what their equations say, in fmpy's hands, and are valid descriptions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu
from fmus.build import names, versions
from support.truth import own_fmus as references

Give = Callable[[str, int], Path]

KINDS = ["ModelExchange", "CoSimulation"]
BOTH = pytest.mark.parametrize("fmi", [2, 3])
INTERFACES = pytest.mark.parametrize("kind", KINDS)
ALL = [(name, fmi) for name in names() for fmi in versions(name)]


def run(
    fmu: Path, kind: str, stop: float, step: float, tolerance: float = 1e-9, **options: Any
) -> Any:
    return simulate_fmu(
        str(fmu),
        fmi_type=kind,
        stop_time=stop,
        output_interval=step,
        step_size=step,
        relative_tolerance=tolerance,
        record_events=False,
        timeout=60,
        **options,
    )


@pytest.mark.parametrize(("name", "fmi"), ALL)
def test_the_description_is_valid(own_fmu: Give, name: str, fmi: int) -> None:
    problems = validate_fmu(str(own_fmu(name, fmi)))

    assert bool(problems) == (name == "invalid_xml"), problems


@BOTH
@INTERFACES
def test_bouncing_ball(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("bouncing_ball", fmi), kind, 3.0, 0.01)

    height, velocity, bounces = references.bouncing_ball(found["time"])
    assert np.allclose(found["height"], height, atol=1e-5)
    assert np.allclose(found["velocity"], velocity, atol=1e-4)
    assert np.array_equal(found["bounces"], bounces)


@BOTH
@INTERFACES
def test_stair(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("stair", fmi), kind, 8.9, 0.2, start_values={"height": 2.0})

    between = np.mod(found["time"] + 1e-9, 1.0) > 1e-6
    expected = references.stair(found["time"][between], 2.0)
    assert np.array_equal(found["y"][between], expected)


@BOTH
@INTERFACES
@pytest.mark.parametrize(("ends", "until"), [(True, 9.0), (False, 12.0)])
def test_stair_ends_the_simulation_by_itself(
    own_fmu: Give, fmi: int, kind: str, ends: bool, until: float
) -> None:
    found = run(own_fmu("stair", fmi), kind, 12.0, 0.5, start_values={"ends_at_10": ends})

    assert found["time"][-1] == pytest.approx(until, abs=0.5)


@BOTH
@INTERFACES
def test_dahlquist(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("dahlquist", fmi), kind, 5.0, 0.1, start_values={"k": 0.7, "x": 2.0})

    assert np.allclose(found["y"], references.dahlquist(found["time"], 0.7, 2.0), atol=1e-6)


@BOTH
@INTERFACES
def test_van_der_pol(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("van_der_pol", fmi), kind, 20.0, 0.5)

    assert np.allclose(found["y"], references.van_der_pol(found["time"])[:, 0], atol=1e-4)


def test_stiff_van_der_pol_and_its_published_solution(own_fmu: Give) -> None:
    """The solution at 2000: F. Mazzia, C. Magherini, Test Set for IVP Solvers, problem VDPOL."""
    times = np.array([0.0, 500.0, 1000.0, 1500.0, 2000.0])
    stiff = {"mu": 1000.0}
    found = run(own_fmu("van_der_pol", 2), KINDS[0], 2000.0, 2.0, 1e-6, start_values=stiff)

    expected = references.van_der_pol(times, 1000.0)
    assert expected[-1, 0] == pytest.approx(1.706167732170483, abs=1e-9)
    assert expected[-1, 1] == pytest.approx(-8.928097010247975e-4, rel=1e-7)
    assert np.allclose(found["y"][::250], expected[:, 0], atol=1e-3)


@BOTH
@INTERFACES
def test_robertson(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("robertson", fmi), kind, 4.0, 0.1)

    expected = references.robertson(found["time"])
    for place, name in enumerate(("y1", "y2", "y3")):
        assert np.allclose(found[name], expected[:, place], rtol=1e-4, atol=1e-9)


@BOTH
@INTERFACES
def test_thermostat(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("thermostat", fmi), kind, 1800.0, 10.0)

    temperature, on, switches = references.thermostat(found["time"])
    assert np.allclose(found["y"], temperature, atol=1e-3)
    assert np.array_equal(found["on"], on)
    assert len(switches) > 20


@BOTH
@INTERFACES
def test_step_events(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("step_events", fmi), kind, 4.0, 0.1, start_values={"rate": 0.97})

    expected = references.step_events(found["time"], 0.97)
    assert np.allclose(found["y"], expected, atol=1e-6)
    assert found["falls"][-1] == 3


@BOTH
@INTERFACES
def test_nominals(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("nominals", fmi), kind, 8.0, 0.1)

    x, nominal = references.nominals(found["time"])
    assert np.allclose(found["y"], x, rtol=1e-4)
    assert np.array_equal(found["nominal"], nominal)


@BOTH
@INTERFACES
def test_iterates(own_fmu: Give, fmi: int, kind: str) -> None:
    found = run(own_fmu("iterates", fmi), kind, 4.7, 0.2, start_values={"rounds": 3})

    between = np.mod(found["time"] + 1e-9, 1.0) > 1e-6
    expected = references.iterates(found["time"], 3)
    assert np.allclose(found["y"][between], expected[between], atol=1e-6)


@BOTH
@INTERFACES
def test_held_input(own_fmu: Give, fmi: int, kind: str) -> None:
    signal = np.array(
        [(0.0, 1.0, True), (1.0, 3.0, True), (2.0, 5.0, False), (3.0, -1.0, True)],
        dtype=[("time", float), ("u", float), ("enabled", bool)],
    )

    found = run(own_fmu("held_input", fmi), kind, 4.0, 0.25, input=signal)

    expected = np.interp(found["time"], [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 4.0, 4.0, 3.0])
    assert np.allclose(found["y"], expected, atol=1e-6)


@BOTH
def test_chatters_makes_no_progress(own_fmu: Give, fmi: int) -> None:
    with pytest.raises(Exception, match="DoStep failed"):
        run(own_fmu("chatters", fmi), "CoSimulation", 2.0, 0.1)


@BOTH
@INTERFACES
@pytest.mark.parametrize(
    ("name", "value", "more"),
    [
        ("real", 3.5, 2.5),
        ("integer", 7, 5.0),
        ("boolean", False, -1.0),
        ("mode", 3, 1.0),
        ("text", "seven..", 3.0),
    ],
)
def test_every_type_of_a_parameter_has_an_effect(
    own_fmu: Give, fmi: int, kind: str, name: str, value: Any, more: float
) -> None:
    fmu = own_fmu("types", fmi)

    base = run(fmu, kind, 1.0, 0.5)["y"][-1]
    found = run(fmu, kind, 1.0, 0.5, start_values={name: value})["y"][-1]

    assert found - base == pytest.approx(more, abs=1e-6)


@INTERFACES
@pytest.mark.parametrize(
    ("name", "value", "more"),
    [
        ("float32", 1.5, 1.0),
        ("int8", -128, -120.0),
        ("int16", 32767, 32783.0),
        ("int64", 2**40, 2.0**40 + 64),
        ("uint8", 255, 247.0),
        ("uint16", 65535, 65519.0),
        ("uint32", 2**32 - 1, 2.0**32 - 33),
        ("uint64", 2**41, 2.0**41 - 64),
        ("weights", [2.0, 4.0, 6.0], 6.0),
    ],
)
def test_the_types_of_fmi_3_have_an_effect(
    own_fmu: Give, kind: str, name: str, value: Any, more: float
) -> None:
    fmu = own_fmu("types", 3)

    base = run(fmu, kind, 1.0, 0.5)["y"][-1]
    found = run(fmu, kind, 1.0, 0.5, start_values={name: value})["y"][-1]

    assert found - base == pytest.approx(more, rel=1e-6)
