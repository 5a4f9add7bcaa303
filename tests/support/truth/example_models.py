"""The example models' equations, written down again, and a solver that is slow but accurate.

Nothing of the project is used but its data classes, and the names in the models' descriptions.
"""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
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


def example(
    states: Values,
    inputs: Sequence[tuple[float, float]],
    outputs: Sequence[int | Reading],
    seconds: float,
    step: float | None = None,
    name: str | None = None,
) -> Callable[[Rates], Rates]:
    """Enter equations for a model, by default that of their name.

    All names are in the model's order; parameters are some percent larger than its own, or than 0.
    """

    def enter(rates: Rates) -> Rates:
        model = name or rates.__name__
        text = (MODELS / model / "model.toml").read_text(encoding="utf-8")
        variables = tomllib.loads(text)["variable"]
        names: dict[str, list[str]] = {"parameter": [], "input": [], "local": [], "output": []}
        for variable in variables:
            names[variable["causality"]].append(variable["name"])
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
        return rates

    return enter


@example([0.1, -0.2], [(1.0, 4.0)], [0], 3.0, step=2e-3)
def mass_spring_damper(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, stiffness, damping = p
    return [x[1], (u[0] - stiffness * x[0] - damping * x[1]) / mass]


@example([3.0, 5.0], [(3.0, 2.0)], [1], 300.0, step=0.2)
def cascaded_tanks(x: FloatArray, u: Values, p: Values) -> list[float]:
    (k1, k2, kp), root = p, np.sqrt(np.maximum(x, 0.0))
    return [kp * u[0] - k1 * root[0], k1 * root[0] - k2 * root[1]]


@example([0.5, 20.0, 0.01, 18.0], [(6.0, 6.0), (0.05, 0.02)], [0, 1, 3], 0.2, step=5e-5)
def dc_motor_belt(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, motor, twist, load), (voltage, load_torque, _) = x, u
    r, ind, k, j_motor, b_motor, k_belt, d_belt, j_load, b_load = p
    belt = k_belt * twist + d_belt * (motor - load)
    return [
        (voltage - r * current - k * motor) / ind,
        (k * current - b_motor * motor - belt) / j_motor,
        motor - load,
        (belt - b_load * load - load_torque) / j_load,
    ]


@example([18.0, 12.0], [(1500.0, 1000.0), (3.0, 6.0)], [0], 54000.0, name="room")
@example([40.0, 30.0], [(8.0, 5.0), (20.0, 5.0)], [0, 1], 600.0, step=0.5)
def thermal_two_node(x: FloatArray, u: Values, p: Values) -> list[float]:
    (core, case), (power, ambient, _) = x, u
    c_core, c_case, r_inner, r_outer = p
    inner, outer = (core - case) / r_inner, (case - ambient) / r_outer
    return [(power - inner) / c_core, (inner - outer) / c_case]


@example([0.4, -1.0], [(0.2, 0.8)], [0], 2.4)
def pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (angle, speed), (inertia, gravity, friction) = x, p
    return [speed, (u[0] - gravity * np.sin(angle) - friction * speed) / inertia]


@example([0.3, 20.0], [(2.0, 5.0)], [0, 1], 0.24)
def dc_motor(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, speed), (r, ind, k, inertia, friction) = x, p
    return [(u[0] - r * current - k * speed) / ind, (k * current - friction * speed) / inertia]


@example([0.02, 5.0, 4.0], [(0.3, 2.0)], [1, 2], 0.6)
def two_mass_drive(x: FloatArray, u: Values, p: Values) -> list[float]:
    (twist, motor, load), (j_motor, j_load, stiffness, damping, b_motor, b_load) = x, p
    shaft = stiffness * twist + damping * (motor - load)
    return [
        motor - load,
        (u[0] - shaft - b_motor * motor) / j_motor,
        (shaft - b_load * load) / j_load,
    ]


@example([0.02, -0.1, 0.01, 0.05], [(0.0, 0.04)], [1, lambda x, u, p: x[0] - x[2]], 1.2)
def quarter_car(x: FloatArray, u: Values, p: Values) -> list[float]:
    (body, v_body, wheel, v_wheel), (m_body, m_wheel, spring, damper, tyre) = x, p
    upward = spring * (wheel - body) + damper * (v_wheel - v_body)
    return [v_body, upward / m_body, v_wheel, (tyre * (u[0] - wheel) - upward) / m_wheel]


def terminal_voltage(x: FloatArray, u: Values, p: Values) -> float:
    (soc, v1), r0 = x, p[1]
    at_rest = 3.45 + 0.45 * soc + 0.25 * soc**3 - 0.35 * np.exp(-18.0 * soc)
    return float(at_rest - r0 * u[0] - v1)


@example([0.7, 0.01], [(0.5, 1.5)], [terminal_voltage], 600.0)
def battery(x: FloatArray, u: Values, p: Values) -> list[float]:
    capacity, _, r1, c1 = p
    return [-u[0] / capacity, u[0] / c1 - x[1] / (r1 * c1)]


@example([480.0, 335.0], [(1.6e-3, 4e-4), (308.0, 5.0)], [0, 1], 300.0)
def stirred_tank_reactor(x: FloatArray, u: Values, p: Values) -> list[float]:
    (c, temperature), (flow, coolant, _) = x, u
    volume, k_350, activation, c_feed, t_feed, rise, cooling = p
    rate = k_350 * c * np.exp(activation / 350.0 - activation / temperature)
    exchange = cooling * (coolant - temperature)
    return [
        flow / volume * (c_feed - c) - rate,
        flow / volume * (t_feed - temperature) + rise * rate + exchange,
    ]


def accelerations(one: float, mixed: float, other: float, forces: Values) -> Values:
    """Both at once, from Lagrange's equations."""
    return np.linalg.solve([[one, mixed], [mixed, other]], forces).tolist()


@example([0.1, -0.2, 0.3, 0.5], [(2.0, 12.0)], [0, 2], 1.2)
def gantry_crane(x: FloatArray, u: Values, p: Values) -> list[float]:
    (_, v, phi, w), (trolley, load, rope, friction, damping) = x, p
    mixed, pushed = load * rope * np.cos(phi), load * rope * np.sin(phi)
    forces = [u[0] - friction * v + pushed * w**2, -damping * w - 9.81 * pushed]
    first, second = accelerations(trolley + load, mixed, load * rope**2, forces)
    return [v, first, w, second]


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
    bent = np.clip(voltage, -1.0, 1.0)
    resistor = inner * bent + outer * (voltage - bent)
    return [alpha * (second - voltage - resistor), voltage - second + current, -beta * second]


@example([0.1, 2.5, -0.2, 0.3], [(0.5, 2.0)], [0, 1], 1.2)
def cart_pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (_, angle, velocity, speed), (cart, rod, length, friction, damping, g) = x, p
    mixed, pushed = rod * length * np.cos(angle), rod * length * np.sin(angle)
    forces = [u[0] - friction * velocity + pushed * speed**2, g * pushed - damping * speed]
    return [velocity, speed, *accelerations(cart + rod, mixed, rod * length**2, forces)]


@example([350.0, 320.0], [(900.0, 600.0), (295.0, 4.0)], [0, 1], 600.0)
def kiln(x: FloatArray, u: Values, p: Values) -> list[float]:
    (plate, charge), (power, ambient, _) = x, u
    c_plate, c_charge, between, to_plate, to_charge = p
    heat = power - to_plate * (plate - ambient), to_charge * (ambient - charge)
    passed = between * (plate - charge)
    return [(heat[0] - passed) / c_plate, (heat[1] + passed) / c_charge]


@example(
    [40.0, 20.0, 10.0],
    [(0.02, 0.02), (0.01, 0.005)],
    [lambda x, u, p: x[1] / p[4], lambda x, u, p: x[2] / p[5]],
    21600.0,
)
def pharmacokinetics(x: FloatArray, u: Values, p: Values) -> list[float]:
    k_a, k_e, k_12, k_21, _, _ = p
    exchange = np.array([[-k_a, 0.0, 0.0], [k_a, -k_e - k_12, k_21], [0.0, k_12, -k_21]])
    return (exchange @ x + np.array([u[0], u[1], 0.0])).tolist()


@example([0.01, 0.05, 0.4], [(0.3, 0.2), (100.0, 200.0)], [0, 2], 0.3)
def hydraulic_cylinder(x: FloatArray, u: Values, p: Values) -> list[float]:
    (position, v, pressure), (opening, load, _) = x, u
    mass, friction, spring, oil, gain, area, supply = p
    drop = supply - pressure if opening > 0.0 else supply + pressure
    return [
        v,
        (area * pressure * 1e6 - friction * v - spring * position - load) / mass,
        oil * (gain * opening * np.sqrt(drop) - area * v),
    ]


@example([2.5, 0.8], [(6e-5, 3e-5), (8.0, 3.0)], [0, 1], 21600.0)
def chemostat(x: FloatArray, u: Values, p: Values) -> list[float]:
    (biomass, substrate), (dilution, feed, _), (fastest, half, gained) = x, u, p
    rate = fastest / (half / substrate + 1.0)
    return [biomass * (rate - dilution), dilution * (feed - substrate) - biomass * rate / gained]


@example([1.0, 3.0], [(2.0, 8.0)], [0, 1], 0.012)
def resonant_circuit(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, voltage), (r, inductance, c, g) = x, p
    return [(u[0] - r * current - voltage) / inductance, (current - g * voltage) / c]


@example([0.05, 10.0], [(0.01, 0.1)], [0], 0.098304)
def silverbox(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, damping, stiffness = p
    return mass_spring_damper(x, u, [mass, stiffness, damping])


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
