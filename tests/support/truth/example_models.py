"""The example models' equations, apart from their FMUs, and a solver that is slow but accurate.

Most are those of the closed-loop benchmark (`scripts/closed_loop_benchmark`), others stand here.
Nothing of the packages is used but data classes, and the names in the models' descriptions.
"""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from closed_loop_benchmark.systems import SYSTEMS
from scipy.integrate import solve_ivp

from workers.messages import Experiment, FloatArray, Input, Interpolation, Output

MODELS = Path(__file__).parents[3] / "configs" / "models"

Values = list[float]
Rates = Callable[[FloatArray, Values, Values], Values]
Reading = Callable[[FloatArray, Values, Values], float]


@dataclass(frozen=True)
class Reference:
    """A model's equations and an experiment that moves it, all away from the FMU's own starts.

    Attributes
    ----------
    rates
        dx/dt of (x, inputs and time, parameters), all in the order in which they stand here.
    inputs
        Mean and amplitude of each.
    outputs
        The state that each shows, or how to compute it.
    seconds
        How long an experiment takes.
    step
        Short enough for the classic Runge-Kutta method to reach a relative error of 1e-8; of
        the models that every loop is tried on.
    """

    rates: Rates
    parameters: dict[str, float]
    states: dict[str, float]
    inputs: dict[str, tuple[float, float]]
    outputs: dict[str, int | Reading]
    seconds: float
    step: float | None = None

    @property
    def starts(self) -> dict[str, float]:
        """All that an experiment sets."""
        return {**self.parameters, **self.states}


REFERENCES: dict[str, Reference] = {}


def enter(
    model: str,
    rates: Rates,
    states: Values,
    inputs: Sequence[tuple[float, float]],
    outputs: Sequence[int | Reading],
    seconds: float,
    step: float | None = None,
) -> None:
    """Enter equations for a model, all names in its order.

    Parameters are some percent larger than its own, or than 0.
    """
    variables = variables_of(model)
    names = names_in(variables)
    more = np.random.default_rng(0).uniform(0.03, 0.12, len(variables)).tolist()
    REFERENCES[model] = Reference(
        rates,
        {
            v["name"]: v["start"] + (v["start"] or v["nominal"]) * part
            for v, part in zip(variables, more, strict=True)
            if v["causality"] == "parameter"
        },
        dict(zip(names["local"], states, strict=True)),
        dict(zip(names["input"], inputs, strict=True)),
        dict(zip(names["output"], outputs, strict=True)),
        seconds,
        step,
    )


def variables_of(model: str) -> list[dict[str, Any]]:
    text = (MODELS / model / "model.toml").read_text(encoding="utf-8")
    return list(tomllib.loads(text)["variable"])


def names_in(variables: list[dict[str, Any]]) -> dict[str, list[str]]:
    """By causality."""
    names: dict[str, list[str]] = {"parameter": [], "input": [], "local": [], "output": []}
    for variable in variables:
        names[variable["causality"]].append(variable["name"])
    return names


def example(
    states: Values,
    inputs: Sequence[tuple[float, float]],
    outputs: Sequence[int | Reading],
    seconds: float,
) -> Callable[[Rates], Rates]:
    """Enter the equations of a function for the model of its name."""

    def entered(rates: Rates) -> Rates:
        enter(rates.__name__, rates, states, inputs, outputs, seconds)
        return rates

    return entered


BENCHMARKED: dict[str, tuple[Values, list[tuple[float, float]], float, float | None]] = {
    "mass_spring_damper": ([0.1, -0.2], [(1.0, 4.0)], 3.0, 2e-3),
    "cascaded_tanks": ([3.0, 5.0], [(3.0, 2.0)], 300.0, 0.2),
    "dc_motor_belt": ([0.5, 20.0, 0.01, 18.0], [(6.0, 6.0), (0.05, 0.02)], 0.2, 5e-5),
    "thermal_two_node": ([40.0, 30.0], [(8.0, 5.0), (20.0, 5.0)], 600.0, 0.5),
    "room": ([18.0, 12.0], [(1500.0, 1000.0), (3.0, 6.0)], 54000.0, None),
    "pendulum": ([0.4, -1.0], [(0.2, 0.8)], 2.4, None),
    "dc_motor": ([0.3, 20.0], [(2.0, 5.0)], 0.24, None),
    "two_mass_drive": ([0.02, 5.0, 4.0], [(0.3, 2.0)], 0.6, None),
    "quarter_car": ([0.02, -0.1, 0.01, 0.05], [(0.0, 0.04)], 1.2, None),
    "battery": ([0.7, 0.01], [(0.5, 1.5)], 600.0, None),
    "stirred_tank_reactor": ([480.0, 335.0], [(1.6e-3, 4e-4), (308.0, 5.0)], 300.0, None),
    "gantry_crane": ([0.1, -0.2, 0.3, 0.5], [(2.0, 12.0)], 1.2, None),
    "kiln": ([350.0, 320.0], [(900.0, 600.0), (295.0, 4.0)], 600.0, None),
    "pharmacokinetics": ([40.0, 20.0, 10.0], [(0.02, 0.02), (0.01, 0.005)], 21600.0, None),
    "hydraulic_cylinder": ([0.01, 0.05, 0.4], [(0.3, 0.2), (100.0, 200.0)], 0.3, None),
    "chemostat": ([2.5, 0.8], [(6e-5, 3e-5), (8.0, 3.0)], 21600.0, None),
    "resonant_circuit": ([1.0, 3.0], [(2.0, 8.0)], 0.012, None),
}
"""Models whose equations the closed-loop benchmark has: states, inputs, seconds and step."""


def enter_benchmarked(name: str) -> None:
    system, names = SYSTEMS[name], names_in(variables_of(name))
    assert (names["local"], names["input"]) == (list(system.states), list(system.inputs))
    order = [names["parameter"].index(p) for p in (*system.parameters, *system.constants)]
    count = len(system.inputs)

    def rates(x: FloatArray, u: Values, p: Values) -> Values:
        return [float(rate) for rate in system.rates(x, u[:count], [p[i] for i in order])]

    def reading(place: int) -> Reading:
        def read(x: FloatArray, u: Values, p: Values) -> float:
            return float(system.readings(x, u[:count], [p[i] for i in order])[place])

        return read

    states, inputs, seconds, step = BENCHMARKED[name]
    enter(
        name, rates, states, inputs, list(map(reading, range(len(names["output"])))), seconds, step
    )


for each in BENCHMARKED:
    enter_benchmarked(each)


def accelerations(one: float, mixed: float, other: float, forces: Values) -> Values:
    """Both at once, from Lagrange's equations."""
    return np.linalg.solve([[one, mixed], [mixed, other]], forces).tolist()


@example([1.2, -0.8, 0.5, -1.0], [], [0, 1], 0.6)
def double_pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (one, other, one_speed, other_speed), (m1, m2, l1, l2, g) = x, p
    mixed, turned = (m2 * l1 * l2 * part(one - other) for part in (np.cos, np.sin))
    forces = [
        -turned * other_speed**2 - (m1 + m2) * g * l1 * np.sin(one),
        turned * one_speed**2 - m2 * g * l2 * np.sin(other),
    ]
    rates = accelerations((m1 + m2) * l1**2, mixed, m2 * l2**2, forces)
    return [one_speed, other_speed, *rates]


# The resistor's kink is not reached: fixed steps lose their order there.
@example([0.3, -0.1, 0.3], [], [0, 1], 0.3)
def chua_circuit(x: FloatArray, u: Values, p: Values) -> list[float]:
    (voltage, second, current), (alpha, beta, inner, outer) = x, p
    bent = outer * voltage + (inner - outer) * np.sign(voltage)
    resistor = inner * voltage if abs(voltage) <= 1.0 else bent
    return [alpha * (second - voltage - resistor), voltage - second + current, -beta * second]


@example([0.1, 2.5, -0.2, 0.3], [(0.5, 2.0)], [0, 1], 1.2)
def cart_pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (_, angle, velocity, speed), (cart, rod, length, friction, damping, g) = x, p
    mixed, pushed = rod * length * np.cos(angle), rod * length * np.sin(angle)
    forces = [u[0] - friction * velocity + pushed * speed**2, g * pushed - damping * speed]
    return [velocity, speed, *accelerations(cart + rod, mixed, rod * length**2, forces)]


@example([0.05, 10.0], [(0.01, 0.1)], [0], 0.098304)
def silverbox(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, damping, stiffness = p
    return REFERENCES["mass_spring_damper"].rates(x, u, [mass, stiffness, damping])


def controller_force(x: FloatArray, u: Values, p: Values) -> float:
    kp, kv, gain = p[3:6]
    return float(gain * (kv * (kp * (u[0] - x[0]) - x[2]) + u[1]))


@example([0.05, 0.02, 0.01, -1.0], [(0.05, 1e-3), (0.5, 2.0)], [controller_force, 0], 0.06)
def emps(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, friction, offset, _, _, gain, lag_speed, lag_drive = p
    (_, v, known, volts), asked = x, controller_force(x, u, p) / gain
    push = gain * volts - friction * v - offset
    return [v, push / mass, (v - known) / lag_speed, (asked - volts) / lag_drive]


def spring_force(x: FloatArray, u: Values, p: Values) -> float:
    amplitude, omega, k_x, k_w = p[:4]
    return float(k_x * amplitude * np.sin(omega * u[-1]) + k_w * x[0])


@example([-0.35], [], [lambda x, u, p: p[0] * np.sin(p[1] * u[-1]), spring_force], 18.0)
def wen_bouc_spring(x: FloatArray, u: Values, p: Values) -> list[float]:
    (w,), (amplitude, omega, _, _, rho, sigma, n) = x, p
    velocity, size = amplitude * omega * np.cos(omega * u[-1]), np.abs(w)
    hysteresis = sigma * np.abs(velocity) * size ** (n - 1.0) * w
    return [rho * (velocity - hysteresis + (sigma - 1.0) * velocity * size**n)]


def sampled_experiment(
    reference: Reference, interpolation: Interpolation, seed: int = 0
) -> Experiment:
    """Every input and every output at irregular times of its own, in `reference.seconds`."""
    generator = np.random.default_rng(seed)
    length = reference.seconds
    start = 0.4 * length
    inputs = []
    for place, (name, (mean, amplitude)) in enumerate(reference.inputs.items()):
        # some samples before the start, and no more long before the end
        times = np.sort(generator.uniform(-0.1, 0.8 + 0.1 * place, 25 + 9 * place))
        values = mean + amplitude * np.sin(9.0 * times + place)
        inputs.append(Input(name, start + length * times, values, interpolation))
    outputs = []
    for place, name in enumerate(reference.outputs):
        times = np.sort(generator.uniform(0.0, 1.0, 30 + 7 * place))
        outputs.append(Output(name, start + length * times, np.zeros(len(times))))
    starts = tuple(reference.starts.items())
    return Experiment("sampled", start, start + length, tuple(inputs), tuple(outputs), starts)


def solve(reference: Reference, experiment: Experiment, at: FloatArray) -> FloatArray:
    """(times, outputs): the outputs at some times, solved anew from each kink of an input."""
    kinks = np.concatenate([[experiment.start], *(g.times for g in experiment.inputs), [at[-1]]])
    kinks = np.unique(kinks[(kinks >= experiment.start) & (kinks <= at[-1])])
    parameters = list(reference.parameters.values())
    x = np.array(list(reference.states.values()))
    found = np.empty((len(at), len(x)))
    found[at == experiment.start] = x
    for first, last in pairwise(kinks):
        inside = (at > first) & (at <= last)

        def rates(t: float, x: FloatArray, first: float = first) -> Values:
            u = [signal(given, t, first) for given in experiment.inputs]
            return reference.rates(x, [*u, t], parameters)

        times = np.unique([*at[inside], last])
        result = solve_ivp(rates, (first, last), x, "DOP853", times, rtol=1e-12, atol=1e-13)
        found[inside] = result.y[:, : inside.sum()].T
        x = result.y[:, -1]
    driven = [[*(signal(g, t, t) for g in experiment.inputs), t] for t in at.tolist()]
    columns = [
        found[:, how]
        if isinstance(how, int)
        else [how(x, u, parameters) for x, u in zip(found, driven, strict=True)]
        for how in reference.outputs.values()
    ]
    return np.column_stack(columns)


def signal(given: Input, at: float, since: float) -> float:
    """An input at a time; of one that is held the value since the last kink."""
    if given.interpolation == "linear":
        return float(np.interp(at, given.times, given.values))
    before = given.values[given.times <= since]
    return float(before[-1] if len(before) else given.values[0])
