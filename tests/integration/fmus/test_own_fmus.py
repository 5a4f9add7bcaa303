"""The test FMUs show what their equations say, in fmpy's hands, and are valid descriptions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from build_fmus import write_archive
from fmpy import simulate_fmu
from fmpy.validation import validate_fmu
from fmus.build import names, versions
from fmus.description import model_description
from fmus.variables import read_model
from support.thinning import thinned
from support.truth import own_fmus as truth

Give = Callable[[str, int], Path]
Check = Callable[[Any, np.ndarray], Any]

KINDS = ["ModelExchange", "CoSimulation"]
PAIRS = pytest.mark.parametrize(
    ("fmi", "kind"),
    [
        (2, KINDS[0]),
        (3, KINDS[1]),
        pytest.param(2, KINDS[1], marks=pytest.mark.slow),
        pytest.param(3, KINDS[0], marks=pytest.mark.slow),
    ],
)


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


ALL = [(name, fmi) for fmi in (2, 3) for name in names() if fmi in versions(name)]


@pytest.mark.parametrize(("name", "fmi"), thinned(ALL, lambda name, _: name, lambda _, fmi: fmi))
def test_the_description_is_valid(tmp_path: Path, name: str, fmi: int) -> None:
    described = tmp_path / "described.fmu"
    write_archive(described, {"modelDescription.xml": model_description(read_model(name, fmi))})
    problems = validate_fmu(str(described))

    assert bool(problems) == (name == "invalid_xml"), problems


def ball(found: Any, times: np.ndarray) -> None:
    height, velocity, bounces = truth.bouncing_ball(times)
    assert np.allclose(found["height"], height, atol=1e-5)
    assert np.allclose(found["velocity"], velocity, atol=1e-4)
    assert np.array_equal(found["bounces"], bounces)


def chemistry(found: Any, times: np.ndarray) -> None:
    expected = truth.robertson(times)
    for place, name in enumerate(("y1", "y2", "y3")):
        assert np.allclose(found[name], expected[:, place], rtol=1e-4, atol=1e-9)


def heating(found: Any, times: np.ndarray) -> None:
    temperature, on, switches = truth.thermostat(times)
    assert np.allclose(found["y"], temperature, atol=1e-3)
    assert np.array_equal(found["on"], on)
    assert len(switches) > 20


def sawtooth(found: Any, times: np.ndarray) -> None:
    assert np.allclose(found["y"], truth.step_events(times, 0.97), atol=1e-6)
    assert found["falls"][-1] == 3


def growth(found: Any, times: np.ndarray) -> None:
    x, nominal = truth.nominals(times)
    assert np.allclose(found["y"], x, rtol=1e-4)
    assert np.array_equal(found["nominal"], nominal)


def close(expected: Callable[[np.ndarray], np.ndarray], atol: float) -> Check:
    """Compare y with an expectation, except at jumps, which are at whole seconds."""

    def check(found: Any, times: np.ndarray) -> None:
        between = np.mod(times + 1e-9, 1.0) > 1e-6
        assert np.allclose(found["y"][between], expected(times)[between], rtol=0.0, atol=atol)

    return check


@PAIRS
@pytest.mark.parametrize(
    ("name", "stop", "step", "starts", "check"),
    [
        ("bouncing_ball", 3.0, 0.01, {}, ball),
        ("stair", 8.9, 0.2, {"height": 2.0}, close(lambda t: truth.stair(t, 2.0), 0.0)),
        (
            "dahlquist", 5.0, 0.1, {"k": 0.7, "x": 2.0},
            close(lambda t: truth.dahlquist(t, 0.7, 2.0), 1e-6),
        ),
        ("van_der_pol", 20.0, 0.5, {}, close(lambda t: truth.van_der_pol(t)[:, 0], 1e-4)),
        ("robertson", 4.0, 0.1, {}, chemistry),
        ("thermostat", 1800.0, 10.0, {}, heating),
        ("step_events", 4.0, 0.1, {"rate": 0.97}, sawtooth),
        ("nominals", 8.0, 0.1, {}, growth),
        ("iterates", 4.7, 0.2, {"rounds": 3}, close(lambda t: truth.iterates(t, 3), 1e-6)),
    ],
)  # fmt: skip
def test_it_is_what_its_equations_say(
    own_fmu: Give, fmi: int, kind: str, name: str, stop: float, step: float,
    starts: dict[str, float], check: Check,
) -> None:  # fmt: skip
    found = run(own_fmu(name, fmi), kind, stop, step, start_values=starts)

    check(found, found["time"])


@PAIRS
@pytest.mark.parametrize(("ends", "until"), [(True, 9.0), (False, 12.0)])
def test_stair_ends_the_simulation_by_itself(
    own_fmu: Give, fmi: int, kind: str, ends: bool, until: float
) -> None:
    found = run(own_fmu("stair", fmi), kind, 12.0, 0.5, start_values={"ends_at_10": ends})

    assert found["time"][-1] == pytest.approx(until, abs=0.5)


@pytest.mark.slow
def test_the_truth_of_stiff_van_der_pol_is_the_published_one() -> None:
    """The solution at 2000: F. Mazzia, C. Magherini, Test Set for IVP Solvers, problem VDPOL."""
    expected = truth.van_der_pol(np.array([2000.0]), 1000.0)[0]
    assert expected[0] == pytest.approx(1.706167732170483, abs=1e-9)
    assert expected[1] == pytest.approx(-8.928097010247975e-4, rel=1e-7)


@PAIRS
def test_held_input(own_fmu: Give, fmi: int, kind: str) -> None:
    signal = np.array(
        [(0.0, 1.0, True), (1.0, 3.0, True), (2.0, 5.0, False), (3.0, -1.0, True)],
        dtype=[("time", float), ("u", float), ("enabled", bool)],
    )

    found = run(own_fmu("held_input", fmi), kind, 4.0, 0.25, input=signal)

    expected = np.interp(found["time"], [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 4.0, 4.0, 3.0])
    assert np.allclose(found["y"], expected, atol=1e-6)


TYPED = {
    "real": (3.5, 2.5), "integer": (7, 5.0), "boolean": (False, -1.0), "mode": (3, 1.0),
    "text": ("seven..", 3.0),
}  # fmt: skip
TYPED_3 = {
    "float32": (1.5, 1.0), "int8": (-128, -120.0), "int16": (32767, 32783.0),
    "int64": (2**40, 2.0**40 + 64), "uint8": (255, 247.0), "uint16": (65535, 65519.0),
    "uint32": (2**32 - 1, 2.0**32 - 33), "uint64": (2**41, 2.0**41 - 64),
    "weights": ([2.0, 4.0, 6.0], 6.0),
}  # fmt: skip


@PAIRS
def test_parameters_of_every_type_have_an_effect(own_fmu: Give, fmi: int, kind: str) -> None:
    fmu = own_fmu("types", fmi)

    base = run(fmu, kind, 1.0, 0.5)["y"][-1]
    for name, (value, more) in (TYPED if fmi == 2 else TYPED | TYPED_3).items():
        found = run(fmu, kind, 1.0, 0.5, start_values={name: value})["y"][-1]
        assert found - base == pytest.approx(more, rel=1e-6, abs=1e-6), name
