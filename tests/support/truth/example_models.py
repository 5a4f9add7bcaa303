"""The example models' equations, written down again, and a solver that is slow but accurate.

Nothing of the project is used but its data classes.
"""

from __future__ import annotations

from collections.abc import Callable
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
        dx/dt of (x, inputs, parameters), all in the order in which they stand here.
    inputs
        Mean and amplitude of each.
    outputs
        The state that each shows, or how to compute it.
    seconds
        How long an experiment takes.
    step
        Short enough for the classic Runge-Kutta method to reach a relative error of 1e-8; of
        the models that every loop is tried on.
    timed
        The equations depend on time, and get it behind the inputs.
    """

    rates: Rates
    parameters: dict[str, float]
    states: dict[str, float]
    inputs: dict[str, tuple[float, float]]
    outputs: dict[str, int | Reading]
    seconds: float
    step: float | None = None
    timed: bool = False

    @property
    def starts(self) -> dict[str, float]:
        """All that an experiment sets."""
        return {**self.parameters, **self.states}

    def driven_by(self, time: float, inputs: Values) -> Values:
        """What the equations get beside states and parameters."""
        return [*inputs, time] if self.timed else inputs


def mass_spring_damper(x: FloatArray, u: Values, p: Values) -> list[float]:
    (mass, stiffness, damping), (force,) = p, u
    return [x[1], (force - stiffness * x[0] - damping * x[1]) / mass]


def cascaded_tanks(x: FloatArray, u: Values, p: Values) -> list[float]:
    (k1, k2, kp), root = p, np.sqrt(np.maximum(x, 0.0))
    return [kp * u[0] - k1 * root[0], k1 * root[0] - k2 * root[1]]


def dc_motor_belt(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, motor, twist, load), (voltage, load_torque) = x, u
    r, ind, k, j_motor, b_motor, k_belt, d_belt, j_load, b_load = p
    belt = k_belt * twist + d_belt * (motor - load)
    return [
        (voltage - r * current - k * motor) / ind,
        (k * current - b_motor * motor - belt) / j_motor,
        motor - load,
        (belt - b_load * load - load_torque) / j_load,
    ]


def thermal_two_node(x: FloatArray, u: Values, p: Values) -> list[float]:
    (core, case), (power, ambient) = x, u
    c_core, c_case, r_inner, r_outer = p
    inner, outer = (core - case) / r_inner, (case - ambient) / r_outer
    return [(power - inner) / c_core, (inner - outer) / c_case]


def pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (angle, speed), (inertia, gravity, friction) = x, p
    return [speed, (u[0] - gravity * np.sin(angle) - friction * speed) / inertia]


def dc_motor(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, speed), (r, ind, k, inertia, friction) = x, p
    return [(u[0] - r * current - k * speed) / ind, (k * current - friction * speed) / inertia]


def two_mass_drive(x: FloatArray, u: Values, p: Values) -> list[float]:
    (twist, motor, load), (j_motor, j_load, stiffness, damping, b_motor, b_load) = x, p
    shaft = stiffness * twist + damping * (motor - load)
    return [
        motor - load,
        (u[0] - shaft - b_motor * motor) / j_motor,
        (shaft - b_load * load) / j_load,
    ]


def quarter_car(x: FloatArray, u: Values, p: Values) -> list[float]:
    (body, v_body, wheel, v_wheel), (m_body, m_wheel, spring, damper, tyre) = x, p
    upward = spring * (wheel - body) + damper * (v_wheel - v_body)
    return [v_body, upward / m_body, v_wheel, (tyre * (u[0] - wheel) - upward) / m_wheel]


def suspension_travel(x: FloatArray, u: Values, p: Values) -> float:
    return float(x[0] - x[2])


def room(x: FloatArray, u: Values, p: Values) -> list[float]:
    (air, wall), (power, outdoors) = x, u
    c_air, c_wall, r_inner, r_outer = p
    inner, outer = (air - wall) / r_inner, (wall - outdoors) / r_outer
    return [(power - inner) / c_air, (inner - outer) / c_wall]


def battery(x: FloatArray, u: Values, p: Values) -> list[float]:
    capacity, _, r1, c1 = p
    return [-u[0] / capacity, u[0] / c1 - x[1] / (r1 * c1)]


def terminal_voltage(x: FloatArray, u: Values, p: Values) -> float:
    (soc, v1), r0 = x, p[1]
    at_rest = 3.45 + 0.45 * soc + 0.25 * soc**3 - 0.35 * np.exp(-18.0 * soc)
    return float(at_rest - r0 * u[0] - v1)


def stirred_tank_reactor(x: FloatArray, u: Values, p: Values) -> list[float]:
    (c, temperature), (flow, coolant) = x, u
    volume, k_350, activation, c_feed, t_feed, rise, cooling = p
    rate = k_350 * c * np.exp(activation / 350.0 - activation / temperature)
    exchange = cooling * (coolant - temperature)
    return [
        flow / volume * (c_feed - c) - rate,
        flow / volume * (t_feed - temperature) + rise * rate + exchange,
    ]


def gantry_crane(x: FloatArray, u: Values, p: Values) -> list[float]:
    (_, v, phi, w), (trolley, load, rope, friction, damping) = x, p
    sine, cosine = np.sin(phi), np.cos(phi)
    # both accelerations at once, from Lagrange's equations
    inertia = np.array(
        [[trolley + load, load * rope * cosine], [load * rope * cosine, load * rope**2]]
    )
    forces = [
        u[0] - friction * v + load * rope * w**2 * sine,
        -damping * w - load * 9.81 * rope * sine,
    ]
    trolley_rate, rope_rate = np.linalg.solve(inertia, forces)
    return [v, float(trolley_rate), w, float(rope_rate)]


def double_pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (one, other, one_speed, other_speed), (m1, m2, l1, l2, g) = x, p
    # both accelerations at once, from Lagrange's equations
    mixed = m2 * l1 * l2 * np.cos(one - other)
    turned = m2 * l1 * l2 * np.sin(one - other)
    inertia = np.array([[(m1 + m2) * l1**2, mixed], [mixed, m2 * l2**2]])
    forces = [
        -turned * other_speed**2 - (m1 + m2) * g * l1 * np.sin(one),
        turned * one_speed**2 - m2 * g * l2 * np.sin(other),
    ]
    first, second = np.linalg.solve(inertia, forces)
    return [one_speed, other_speed, float(first), float(second)]


def chua_circuit(x: FloatArray, u: Values, p: Values) -> list[float]:
    (voltage, second, current), (alpha, beta, inner, outer) = x, p
    bent = np.clip(voltage, -1.0, 1.0)
    resistor = inner * bent + outer * (voltage - bent)
    return [alpha * (second - voltage - resistor), voltage - second + current, -beta * second]


def cart_pendulum(x: FloatArray, u: Values, p: Values) -> list[float]:
    (_, angle, velocity, speed), (cart, rod, length, friction, damping, g) = x, p
    # both accelerations at once, from Lagrange's equations
    mixed = rod * length * np.cos(angle)
    inertia = np.array([[cart + rod, mixed], [mixed, rod * length**2]])
    forces = [
        u[0] - friction * velocity + rod * length * speed**2 * np.sin(angle),
        rod * g * length * np.sin(angle) - damping * speed,
    ]
    first, second = np.linalg.solve(inertia, forces)
    return [velocity, speed, float(first), float(second)]


def kiln(x: FloatArray, u: Values, p: Values) -> list[float]:
    (plate, charge), (power, ambient) = x, u
    c_plate, c_charge, between, to_plate, to_charge = p
    heat = power - to_plate * (plate - ambient), to_charge * (ambient - charge)
    passed = between * (plate - charge)
    return [(heat[0] - passed) / c_plate, (heat[1] + passed) / c_charge]


def pharmacokinetics(x: FloatArray, u: Values, p: Values) -> list[float]:
    k_a, k_e, k_12, k_21, _, _ = p
    exchange = np.array([[-k_a, 0.0, 0.0], [k_a, -k_e - k_12, k_21], [0.0, k_12, -k_21]])
    return (exchange @ x + np.array([u[0], u[1], 0.0])).tolist()


def plasma_level(x: FloatArray, u: Values, p: Values) -> float:
    return float(x[1] / p[4])


def tissue_level(x: FloatArray, u: Values, p: Values) -> float:
    return float(x[2] / p[5])


def hydraulic_cylinder(x: FloatArray, u: Values, p: Values) -> list[float]:
    (position, v, pressure), (opening, load) = x, u
    mass, friction, spring, oil, gain, area, supply = p
    drop = supply - pressure if opening > 0.0 else supply + pressure
    return [
        v,
        (area * pressure * 1e6 - friction * v - spring * position - load) / mass,
        oil * (gain * opening * np.sqrt(drop) - area * v),
    ]


def chemostat(x: FloatArray, u: Values, p: Values) -> list[float]:
    (biomass, substrate), (dilution, feed), (fastest, half, gained) = x, u, p
    rate = fastest / (half / substrate + 1.0)
    return [
        biomass * (rate - dilution),
        dilution * (feed - substrate) - biomass * rate / gained,
    ]


def resonant_circuit(x: FloatArray, u: Values, p: Values) -> list[float]:
    (current, voltage), (r, inductance, c, g) = x, p
    return [(u[0] - r * current - voltage) / inductance, (current - g * voltage) / c]


def silverbox(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, damping, stiffness = p
    return [x[1], (u[0] - damping * x[1] - stiffness * x[0]) / mass]


def emps(x: FloatArray, u: Values, p: Values) -> list[float]:
    mass, friction, offset, _, _, gain, lag_speed, lag_drive = p
    (_, v, known, volts), asked = x, controller_force(x, u, p) / gain
    push = gain * volts - friction * v - offset
    return [v, push / mass, (v - known) / lag_speed, (asked - volts) / lag_drive]


def controller_force(x: FloatArray, u: Values, p: Values) -> float:
    kp, kv, gain = p[3:6]
    return float(gain * (kv * (kp * (u[0] - x[0]) - x[2]) + u[1]))


def wen_bouc_spring(x: FloatArray, u: Values, p: Values) -> list[float]:
    (w,), (time,), (amplitude, omega, _, _, rho, sigma, n) = x, u, p
    velocity, size = amplitude * omega * np.cos(omega * time), np.abs(w)
    hysteresis = sigma * np.abs(velocity) * size ** (n - 1.0) * w
    return [rho * (velocity - hysteresis + (sigma - 1.0) * velocity * size**n)]


def spring_displacement(x: FloatArray, u: Values, p: Values) -> float:
    amplitude, omega = p[:2]
    return float(amplitude * np.sin(omega * u[0]))


def spring_force(x: FloatArray, u: Values, p: Values) -> float:
    k_x, k_w = p[2:4]
    return float(k_x * spring_displacement(x, u, p) + k_w * x[0])


REFERENCES = {
    "mass_spring_damper": Reference(
        mass_spring_damper,
        {"m": 1.3, "k": 31.0, "c": 0.7},
        {"x": 0.1, "v": -0.2},
        {"F": (1.0, 4.0)},
        {"y": 0},
        3.0,
        step=2e-3,
    ),
    "cascaded_tanks": Reference(
        cascaded_tanks,
        {"k1": 0.06, "k2": 0.045, "kp": 0.055},
        {"h1": 3.0, "h2": 5.0},
        {"u": (3.0, 2.0)},
        {"y": 1},
        300.0,
        step=0.2,
    ),
    "dc_motor_belt": Reference(
        dc_motor_belt,
        {
            "R": 1.2, "L": 6e-3, "K": 0.06, "J_motor": 1.2e-4, "b_motor": 3e-5, "k_belt": 2.4,
            "d_belt": 4e-3, "J_load": 6e-4, "b_load": 2e-4,
        },
        {"i": 0.5, "w_motor": 20.0, "twist": 0.01, "w_load": 18.0},
        {"V": (6.0, 6.0), "T_load": (0.05, 0.02)},
        {"load_speed": 3, "current": 0, "speed": 1},
        0.2,
        step=5e-5,
    ),
    "thermal_two_node": Reference(
        thermal_two_node,
        {"C_core": 70.0, "C_case": 180.0, "R_core_case": 1.7, "R_case_ambient": 3.5},
        {"T_core": 40.0, "T_case": 30.0},
        {"P": (8.0, 5.0), "T_ambient": (20.0, 5.0)},
        {"y_core": 0, "y_case": 1},
        600.0,
        step=0.5,
    ),
    "pendulum": Reference(
        pendulum,
        {"J": 0.12, "G": 1.8, "b": 0.05},
        {"angle": 0.4, "speed": -1.0},
        {"torque": (0.2, 0.8)},
        {"y": 0},
        2.4,
    ),
    "dc_motor": Reference(
        dc_motor,
        {"R": 1.2, "L": 8e-3, "K": 0.06, "J": 6e-4, "b": 3e-4},
        {"i": 0.3, "w": 20.0},
        {"V": (2.0, 5.0)},
        {"current": 0, "speed": 1},
        0.24,
    ),
    "two_mass_drive": Reference(
        two_mass_drive,
        {
            "J_motor": 0.025, "J_load": 0.04, "k_shaft": 25.0, "d_shaft": 0.04, "b_motor": 0.02,
            "b_load": 0.03,
        },
        {"twist": 0.02, "w_motor": 5.0, "w_load": 4.0},
        {"torque": (0.3, 2.0)},
        {"motor_speed": 1, "load_speed": 2},
        0.6,
    ),
    "quarter_car": Reference(
        quarter_car,
        {"m_body": 320.0, "m_wheel": 35.0, "k_spring": 1.8e4, "c_damper": 1.2e3, "k_tyre": 1.8e5},
        {"z_body": 0.02, "v_body": -0.1, "z_wheel": 0.01, "v_wheel": 0.05},
        {"road": (0.0, 0.04)},
        {"velocity": 1, "travel": suspension_travel},
        1.2,
    ),
    "room": Reference(
        room,
        {"C_room": 5e6, "C_wall": 2.5e7, "R_room_wall": 5e-3, "R_wall_out": 7e-3},
        {"T_room": 18.0, "T_wall": 12.0},
        {"P": (1500.0, 1000.0), "T_out": (3.0, 6.0)},
        {"y": 0},
        54000.0,
    ),
    "battery": Reference(
        battery,
        {"Q": 7000.0, "R0": 0.06, "R1": 0.025, "C1": 3500.0},
        {"soc": 0.7, "v1": 0.01},
        {"current": (0.5, 1.5)},
        {"voltage": terminal_voltage},
        600.0,
    ),
    "stirred_tank_reactor": Reference(
        stirred_tank_reactor,
        {
            "volume": 0.11, "k_350": 0.013, "E_R": 8600.0, "c_feed": 950.0, "T_feed": 347.0,
            "rise": 0.09, "cooling": 0.033,
        },
        {"c": 480.0, "T": 343.0},
        {"flow": (1.6e-3, 4e-4), "T_coolant": (324.0, 5.0)},
        {"concentration": 0, "temperature": 1},
        300.0,
    ),
    "gantry_crane": Reference(
        gantry_crane,
        {"m_trolley": 7.0, "m_load": 3.0, "l_rope": 0.9, "b_trolley": 6.0, "d_pivot": 0.1},
        {"x": 0.1, "v": -0.2, "phi": 0.3, "w": 0.5},
        {"F": (2.0, 12.0)},
        {"position": 0, "angle": 2},
        1.2,
    ),
    "double_pendulum": Reference(
        double_pendulum,
        {"m1": 1.2, "m2": 0.7, "l1": 0.9, "l2": 0.6, "g": 9.8},
        {"angle1": 1.2, "angle2": -0.8, "speed1": 0.5, "speed2": -1.0},
        {},
        {"y1": 0, "y2": 1},
        0.6,
    ),
    "chua_circuit": Reference(
        chua_circuit,
        {"alpha": 15.0, "beta": 27.0, "a": -1.15, "b": -0.7},
        {"x": 0.4, "y": -0.1, "z": 0.3},
        {},
        {"v1": 0, "v2": 1},
        0.3,  # the resistor's kink is not reached: fixed steps lose their order there
    ),
    "cart_pendulum": Reference(
        cart_pendulum,
        {"m_cart": 1.1, "m_rod": 0.25, "l": 0.6, "b": 0.4, "d": 0.02, "g": 9.8},
        {"position": 0.1, "angle": 2.5, "velocity": -0.2, "speed": 0.3},
        {"F": (0.5, 2.0)},
        {"y1": 0, "y2": 1},
        1.2,
    ),
    "kiln": Reference(
        kiln,
        {"C_plate": 350.0, "C_charge": 1000.0, "G_between": 5.0, "G_plate": 3.0, "G_charge": 1.5},
        {"T_plate": 350.0, "T_charge": 320.0},
        {"power": (900.0, 600.0), "T_ambient": (295.0, 4.0)},
        {"plate": 0, "charge": 1},
        600.0,
    ),
    "pharmacokinetics": Reference(
        pharmacokinetics,
        {
            "k_a": 2.5e-4, "k_e": 9e-5, "k_12": 1.2e-4, "k_21": 8e-5, "volume": 18.0,
            "tissue_volume": 35.0,
        },
        {"gut": 40.0, "central": 20.0, "tissue": 10.0},
        {"oral": (0.02, 0.02), "infusion": (0.01, 0.005)},
        {"plasma_level": plasma_level, "tissue_level": tissue_level},
        21600.0,
    ),
    "hydraulic_cylinder": Reference(
        hydraulic_cylinder,
        {
            "mass": 45.0, "b": 900.0, "k": 1.5e4, "E": 1.1e5, "q": 1.6e-4, "area": 1.1e-3,
            "p_supply": 8.0,
        },
        {"x": 0.01, "v": 0.05, "p": 0.4},
        {"u": (0.3, 0.2), "F_load": (100.0, 200.0)},
        {"position": 0, "pressure": 2},
        0.3,
    ),
    "chemostat": Reference(
        chemostat,
        {"mu_max": 1.4e-4, "K_s": 0.5, "yield": 0.45},
        {"X": 2.5, "S": 0.8},
        {"D": (6e-5, 3e-5), "S_in": (8.0, 3.0)},
        {"biomass": 0, "substrate": 1},
        21600.0,
    ),
    "resonant_circuit": Reference(
        resonant_circuit,
        {"R": 0.9, "L": 2.5e-3, "C": 4e-4, "G": 0.1},
        {"i": 1.0, "u": 3.0},
        {"e": (2.0, 8.0)},
        {"current": 0, "voltage": 1},
        0.012,
    ),
    "silverbox": Reference(
        silverbox,
        {"m": 5.2e-6, "d": 2.5e-4, "k": 1.05},
        {"y": 0.05, "v": 10.0},
        {"V1": (0.01, 0.1)},
        {"V2": 0},
        0.098304,
    ),
    "emps": Reference(
        emps,
        {
            "M": 90.0, "Fv": 230.0, "offset": -3.0, "kp": 150.0, "kv": 260.0, "gtau": 34.0,
            "lag_speed": 1.2e-3, "lag_drive": 6e-4,
        },
        {"q": 0.05, "v": 0.02, "speed": 0.01, "u": -1.0},
        {"qg": (0.05, 1e-3), "pulses": (0.5, 2.0)},
        {"force": controller_force, "position": 0},
        0.06,
    ),
    "wen_bouc_spring": Reference(
        wen_bouc_spring,
        {"Amp": 1.05, "omega": 0.8, "k_x": 190.0, "k_w": 260.0, "rho": 2.1, "sigma": 1.4, "n": 1.6},
        {"W": -0.35},
        {},
        {"Displacement": spring_displacement, "Force": spring_force},
        18.0,
        timed=True,
    ),
}  # fmt: skip


def sampled_experiment(
    reference: Reference, interpolation: Interpolation, seed: int = 0, start: float | None = None
) -> Experiment:
    """Every input and every output at irregular times of its own, in `reference.seconds`."""
    generator = np.random.default_rng(seed)
    length = reference.seconds
    start = 0.4 * length if start is None else start
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
    return Experiment(
        "sampled",
        start,
        start + length,
        tuple(inputs),
        tuple(outputs),
        tuple(reference.starts.items()),
    )


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
            return reference.rates(x, reference.driven_by(t, u), parameters)

        times = np.unique([*at[inside], last])
        result = solve_ivp(rates, (first, last), x, "DOP853", times, rtol=1e-12, atol=1e-13)
        found[inside] = result.y[:, : inside.sum()].T
        x = result.y[:, -1]
    columns: list[FloatArray] = []
    for how in reference.outputs.values():
        if isinstance(how, int):
            columns.append(found[:, how])
            continue
        given = ([signal(g, t, t) for g in experiment.inputs] for t in at.tolist())
        driven = map(reference.driven_by, at.tolist(), given)
        column = [how(x, u, parameters) for x, u in zip(found, driven, strict=True)]
        columns.append(np.array(column))
    return np.column_stack(columns)


def signal(given: Input, at: float, since: float) -> float:
    """An input at a time; of one that is held the value since the last kink."""
    if given.interpolation == "linear":
        return float(np.interp(at, given.times, given.values))
    before = given.values[given.times <= since]
    return float(before[-1] if len(before) else given.values[0])
