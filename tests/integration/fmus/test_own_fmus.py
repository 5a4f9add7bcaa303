from itertools import product

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

KINDS = [*product((2, 3), ("ModelExchange", "CoSimulation"))]
ALL = [(name, fmi) for fmi in (2, 3) for name in names() if fmi in versions(name)]


@pytest.mark.parametrize(("name", "fmi"), thinned(ALL, lambda name, _: name, lambda _, fmi: fmi))
def test_the_description_is_valid(tmp_path, name, fmi):
    described = tmp_path / "described.fmu"
    write_archive(described, {"modelDescription.xml": model_description(read_model(name, fmi))})
    problems = validate_fmu(str(described))
    assert bool(problems) == (name == "invalid_xml"), problems


def chemistry(found, times):
    expected = truth.robertson(times)
    for place, name in enumerate(("y1", "y2", "y3")):
        assert np.allclose(found[name], expected[:, place], rtol=1e-4, atol=1e-9)


def sawtooth(found, times):
    assert np.allclose(found["y"], truth.step_events(times, 0.97), atol=1e-6)
    assert found["falls"][-1] == 3


def growth(found, times):
    x, nominal = truth.nominals(times)
    assert np.allclose(found["y"], x, rtol=1e-4)
    assert np.array_equal(found["nominal"], nominal)


def jumps(found, times):
    """The jumps are at whole seconds, where a value may be that before or after."""
    between = np.mod(times + 1e-9, 1.0) > 1e-6
    assert np.allclose(found["y"][between], truth.iterates(times, 3)[between], rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("fmi", "kind"), thinned(KINDS, lambda f, _: f, lambda _, k: k))
@pytest.mark.parametrize(
    ("name", "stop", "step", "starts", "check"),
    [
        ("robertson", 4.0, 0.1, {}, chemistry),
        ("step_events", 4.0, 0.1, {"rate": 0.97}, sawtooth),
        ("nominals", 8.0, 0.1, {}, growth),
        ("iterates", 4.7, 0.2, {"rounds": 3}, jumps),
    ],
)  # fmt: skip
def test_it_is_what_its_equations_say(own_fmu, fmi, kind, name, stop, step, starts, check):
    given = {"stop_time": stop, "output_interval": step, "step_size": step, "start_values": starts}
    given |= {"relative_tolerance": 1e-9, "record_events": False, "timeout": 60}
    found = simulate_fmu(str(own_fmu(name, fmi)), fmi_type=kind, **given)
    check(found, found["time"])


@pytest.mark.slow
def test_the_truth_of_stiff_van_der_pol_is_the_published_one():
    """The solution at 2000: F. Mazzia, C. Magherini, Test Set for IVP Solvers, problem VDPOL."""
    expected = truth.van_der_pol(np.array([2000.0]), 1000.0)[0]
    assert expected[0] == pytest.approx(1.706167732170483, abs=1e-9)
    assert expected[1] == pytest.approx(-8.928097010247975e-4, rel=1e-7)
