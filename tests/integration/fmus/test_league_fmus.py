import fmpy
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from support.problems.springs import ROOT

Array = NDArray[np.float64]
LEAGUE = ROOT / "configs" / "league"
HOUR, DAY = 3600.0, 86400.0


def two_compartments(t: Array) -> Array:
    rates = np.array([[-1.1 - 0.85, 0.76], [0.85, -0.76]]) / HOUR
    return np.array([(expm(rates * each) @ [2.0, 0.0])[0] for each in t])


def absorbed(t: Array) -> Array:
    """Bateman's function."""
    shares = np.exp(-0.08 * t / HOUR) - np.exp(-1.5 * t / HOUR)
    return np.asarray(4.0 / 0.5 * 1.5 / (1.5 - 0.08) * shares)


def infected(t: Array) -> Array:
    c, delta = 2.0 / DAY, 0.5 / DAY
    rates = np.array([[-c, 0.0, 0.0], [delta, -delta, 0.0], [0.0, c, -c]])
    states = np.array([expm(rates * each) @ [1e6, 1e6, 0.0] for each in t])
    return np.log10(states[:, 0] + states[:, 2])


def cooling(t: Array) -> Array:
    """Air and wall that cool down to 0 degC."""
    c, wall, inner, outer = 5e6, 1e7, 0.005, 0.02
    rates = np.array([[-1.0 / c, 1.0 / c], [1.0 / wall, -(1.0 + inner / outer) / wall]]) / inner
    return np.array([(expm(rates * each) @ [20.0, 10.0])[0] for each in t])


def rolled(t: Array) -> Array:
    return 8.0 - 9.81 * (0.005 - 0.001) * t


TRUTHS = [
    ("models/rocket", {"h": 100.0, "v": 50.0}, "alt", 4.0, lambda t: 100 + 50 * t - 4.905 * t**2),
    ("models/indometacin", {"C": 2.0}, "conc", 8 * HOUR, lambda t: 2 * np.exp(-0.6 * t / HOUR)),
    ("models/theophylline", {"A": 4.0}, "conc", 24 * HOUR, lambda t: 8 * np.exp(-0.1 * t / HOUR)),
    ("models/hiv", {"V": 1e6}, "lgV", 4 * DAY, lambda t: 6 - 0.5 * t / DAY / np.log(10.0)),
    ("models/house", {"T": 20.0}, "T_int", 1e5, lambda t: 20 * np.exp(-t / 1e5)),
    ("models/battery", {"v1": 0.1}, "V", 30.0, lambda t: 4.187 - 0.1 * np.exp(-t / 10)),
    ("models/battery_ocv", {"q": 10.0}, "V", 30.0, lambda t: np.full_like(t, 3.9)),
    ("models/rolling", {"slope": 0.001, "dir": -1.0, "v": 8.0}, "speed", 10.0, rolled),
    ("textbook/models/house", {"T": 20.0, "Tw": 10.0}, "T_int", 1e5, cooling),
    ("textbook/models/theophylline", {"G": 4.0, "k": 0.08}, "conc", 24 * HOUR, absorbed),
    ("textbook/models/hiv", {"VI": 1e6, "Q": 1e6}, "lgV", 4 * DAY, infected),
    (
        "textbook/models/indometacin",
        {"C": 2.0, "k": 1.1, "k12": 0.85, "k21": 0.76},
        "conc",
        8 * HOUR,
        two_compartments,
    ),
]


def simulated(model: str, values: dict[str, float], outputs: list[str], stop: float):
    """Without inputs, in co-simulation, at 21 times."""
    how = {"start_values": values, "output": outputs, "stop_time": stop}
    how |= {"output_interval": stop / 20.0, "fmi_type": "CoSimulation"}
    return fmpy.simulate_fmu(str(LEAGUE / f"{model}.fmu"), **how)


@pytest.mark.parametrize(("model", "values", "output", "stop", "truth"), TRUTHS)
def test_agrees_with_its_formula(model, values, output, stop, truth):
    found = simulated(model, values, [output], stop)
    expected = truth(found["time"])
    np.testing.assert_allclose(found[output], expected, rtol=1e-7, atol=1e-9)


def test_car_comes_to_rest_and_stays():
    found = simulated("models/rolling", {"v": 1.0}, ["speed"], 60.0)
    assert found["speed"][-1] == pytest.approx(0.0, abs=1e-3)
    assert (found["speed"] >= 0.0).all()


@pytest.mark.parametrize("model", ["models/furuta", "textbook/models/furuta"])
def test_pendulum_without_friction_keeps_its_energy(model):
    free = {"f1": 0.0, "f2": 0.0}
    free |= {"F1": 0.0, "F2": 0.0} if model.startswith("textbook") else {}
    names = ["phi", "w", "theta", "u"]
    found = simulated(model, free, names, 5.0)
    w, theta, u = (found[name] for name in names[1:])
    a, b, c = 0.075, 0.075, 0.025
    moving = 0.5 * (a + b * np.sin(theta) ** 2) * w**2 + 0.5 * b * u**2 - c * np.cos(theta) * w * u
    energy = moving + np.cos(theta)
    assert np.ptp(moving) > 0.5
    np.testing.assert_allclose(energy, energy[0], atol=1e-5)


def test_modes_of_the_wing_decay_as_their_damping_says():
    values = {"x2": 1.0, "r1": 0.0, "r2": 1.0, "z2": 0.01}
    found = simulated("textbook/models/f16", values, ["x2", "a2"], 1.0)
    w, z, t = 2.0 * np.pi * 9.16, 0.01, found["time"]
    fast = w * np.sqrt(1.0 - z**2)
    shape = np.cos(fast * t) + z * w / fast * np.sin(fast * t)
    np.testing.assert_allclose(found["x2"], np.exp(-z * w * t) * shape, atol=1e-5)
    speed = -np.exp(-z * w * t) * w**2 / fast * np.sin(fast * t)
    np.testing.assert_allclose(found["a2"], -2 * z * w * speed - w**2 * found["x2"], atol=0.05)
