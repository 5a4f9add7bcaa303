"""Systems that move: masses and a pendulum, drives, a crane, a hydraulic cylinder."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, Values, make_run


def spring_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for a mass on a spring and a damper."""
    (position, velocity), (force,), (mass, stiffness, damping) = x, u, p
    return velocity, (force - stiffness * position - damping * velocity) / mass


def spring_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Excite around the resonance at 0.8 Hz, strongly and gently."""
    rest = {"x": 0.0, "v": 0.0}
    return [
        make_run("multisine", "train", [6.0 * wave.multisine(time, random, 0.1, 2.0)], rest),
        make_run("held steps", "train", [4.0 * wave.held(time, random, 1.0)], rest),
        make_run("chirp", "train", [2.0 * wave.chirp(time, 0.1, 2.0)], rest),
        make_run("binary", "train", [5.0 * wave.binary(time, random, 0.4)], rest),
        make_run("triangle", "test", [5.0 * wave.triangle(time, 1.7)], rest),
        make_run("noise", "test", [4.0 * wave.noise(time, random, 1.0)], rest),
    ]


def pendulum_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Angular momentum about the pivot."""
    (angle, speed), (torque,), (inertia, gravity, friction) = x, u, p
    return speed, (torque - gravity * np.sin(angle) - friction * speed) / inertia


def pendulum_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Excite around the swing at 0.7 Hz, up to about one radian."""
    rest, swung = {"angle": 0.0, "speed": 0.0}, {"angle": 0.5, "speed": 0.0}
    return [
        make_run("multisine", "train", [0.45 * wave.multisine(time, random, 0.1, 1.5)], rest),
        make_run("held steps", "train", [0.9 * wave.held(time, random, 1.2)], rest),
        make_run("chirp", "train", [0.3 * wave.chirp(time, 0.1, 1.5)], swung),
        make_run("binary", "train", [0.25 * wave.binary(time, random, 0.3)], rest),
        make_run("triangle", "test", [0.6 * wave.triangle(time, 2.9)], rest),
        make_run("noise", "test", [0.35 * wave.noise(time, random, 0.9)], swung),
    ]


def car_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for body and wheel; `lift` is the force of the suspension on the body."""
    body, body_speed, wheel, wheel_speed = x
    wheel_mass, spring, damper, tyre, body_mass = p
    lift = spring * (wheel - body) + damper * (wheel_speed - body_speed)
    grip = tyre * (u[0] - wheel)
    return body_speed, lift / body_mass, wheel_speed, (grip - lift) / wheel_mass


def car_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the velocity of the body and the travel of the suspension."""
    return x[1], x[0] - x[2]


def car_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive over bumps of some centimetres, up to the wheel resonance at 10 Hz."""
    rest = dict.fromkeys(("z_body", "v_body", "z_wheel", "v_wheel"), 0.0)
    return [
        make_run("multisine", "train", [0.03 * wave.multisine(time, random, 0.4, 8.0, 20)], rest),
        make_run("ramps", "train", [0.06 * wave.ramps(time, random, 0.12)], rest),
        make_run("chirp", "train", [0.012 * wave.chirp(time, 0.5, 12.0)], rest),
        make_run("noise", "train", [0.05 * wave.noise(time, random, 2.0)], rest),
        make_run("triangle", "test", [0.05 * wave.triangle(time, 0.7)], rest),
        make_run("gentle noise", "test", [0.03 * wave.noise(time, random, 3.0)], rest),
    ]


def motor_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Kirchhoff's law for the armature, Newton's for the rotor."""
    (current, speed), (voltage,), (resistance, inductance, constant, inertia, friction) = x, u, p
    back_emf = constant * speed
    return (
        (voltage - resistance * current - back_emf) / inductance,
        (constant * current - friction * speed) / inertia,
    )


def motor_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Reverse the motor often, at large and small voltages."""
    rest = {"i": 0.0, "w": 0.0}
    return [
        make_run("multisine", "train", [7.0 * wave.multisine(time, random, 0.5, 10.0)], rest),
        make_run("held steps", "train", [10.0 * wave.held(time, random, 0.15)], rest),
        make_run("binary", "train", [3.0 * wave.binary(time, random, 0.06)], rest),
        make_run("noise", "train", [6.0 * wave.noise(time, random, 4.0)], rest),
        make_run("triangle", "test", [8.0 * wave.triangle(time, 0.5)], rest),
        make_run("chirp", "test", [5.0 * wave.chirp(time, 0.5, 8.0)], rest),
    ]


def belt_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Rates of motor and load, which are coupled by the belt."""
    current, motor, twist, load = x
    voltage, brake = u
    resistance, inductance, constant, rotor, rotor_friction, spring, damper, mass, friction = p
    pull = spring * twist + damper * (motor - load)
    return (
        (voltage - resistance * current - constant * motor) / inductance,
        (constant * current - rotor_friction * motor - pull) / rotor,
        motor - load,
        (pull - friction * load - brake) / mass,
    )


def belt_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive and brake at the same time."""
    rest = dict.fromkeys(("i", "w_motor", "twist", "w_load"), 0.0)
    brake = 0.08 * wave.held(time, random, 0.25)
    stir = 0.05 * wave.multisine(time, random, 0.5, 15.0)
    return [
        make_run(
            "multisine", "train", [7.0 * wave.multisine(time, random, 0.5, 25.0, 20), brake], rest
        ),
        make_run("held steps", "train", [9.0 * wave.held(time, random, 0.15), stir], rest),
        make_run("binary", "train", [3.0 * wave.binary(time, random, 0.05), brake[::-1]], rest),
        make_run("noise", "train", [6.0 * wave.noise(time, random, 5.0), stir[::-1]], rest),
        make_run("triangle", "test", [8.0 * wave.triangle(time, 0.4), 0.5 * brake], rest),
        make_run("chirp", "test", [5.0 * wave.chirp(time, 0.5, 12.0), stir - brake], rest),
    ]


def shaft_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Two inertias that twist a shaft."""
    (twist, motor, load), (torque,) = x, u
    motor_inertia, load_inertia, spring, damper, motor_friction, load_friction = p
    slip = motor - load
    through = spring * twist + damper * slip
    return (
        slip,
        (torque - motor_friction * motor - through) / motor_inertia,
        (through - load_friction * load) / load_inertia,
    )


def shaft_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Excite up to the torsional resonance at 6 Hz."""
    rest = {"twist": 0.0, "w_motor": 0.0, "w_load": 0.0}
    return [
        make_run("multisine", "train", [3.0 * wave.multisine(time, random, 0.3, 8.0, 20)], rest),
        make_run("held steps", "train", [4.0 * wave.held(time, random, 0.3)], rest),
        make_run("binary", "train", [1.2 * wave.binary(time, random, 0.1)], rest),
        make_run("noise", "train", [3.0 * wave.noise(time, random, 2.0)], rest),
        make_run("triangle", "test", [3.5 * wave.triangle(time, 0.9)], rest),
        make_run("chirp", "test", [2.0 * wave.chirp(time, 0.3, 6.0)], rest),
    ]


GRAVITY = 9.81


def crane_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for the trolley and, along the rope's normal, for the load."""
    (_, speed, angle, turning), (force,) = x, u
    trolley, load, rope, friction, damping = p
    sine, cosine = np.sin(angle), np.cos(angle)
    joint = damping * turning / rope
    driven = (
        force
        - friction * speed
        + load * rope * turning**2 * sine
        + load * GRAVITY * sine * cosine
        + joint * cosine
    )
    acceleration = driven / (trolley + load * sine**2)
    swing = -(acceleration * cosine + GRAVITY * sine + joint / load) / rope
    return speed, acceleration, turning, swing


def crane_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive to and fro, slowly and near the frequency of the swing, 0.6 Hz."""
    rest = dict.fromkeys(("x", "v", "phi", "w"), 0.0)

    def run(waveform: str, role: Role, force: Array, angle: float = 0.0) -> Run:
        # without a mean, so that the trolley stays on the rail
        return make_run(waveform, role, [force - force.mean()], {**rest, "phi": angle})

    return [
        run("multisine", "train", 14.0 * wave.multisine(time, random, 0.1, 2.0)),
        run("held steps", "train", 16.0 * wave.held(time, random, 0.8)),
        run("binary", "train", 8.0 * wave.binary(time, random, 0.4), 0.25),
        run("noise", "train", 12.0 * wave.noise(time, random, 1.0)),
        run("triangle", "test", 14.0 * wave.triangle(time, 2.7), 0.25),
        run("chirp", "test", 12.0 * wave.chirp(time, 0.1, 2.0)),
    ]


def cylinder_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for the mass, and the oil's compression; pressures in MPa."""
    (position, speed, pressure), (opening, load) = x, u
    mass, friction, spring, oil, gain, area, supply = p
    flow = gain * opening * np.sqrt(np.maximum(supply - np.sign(opening) * pressure, 0.0))
    force = 1e6 * area * pressure - load - friction * speed - spring * position
    return speed, force / mass, oil * (flow - area * speed)


def cylinder_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Move the valve slowly and quickly, against a force that changes."""
    rest = dict.fromkeys(("x", "v", "p"), 0.0)

    def run(waveform: str, role: Role, opening: Array) -> Run:
        return make_run(waveform, role, [opening, 400.0 * wave.held(time, random, 0.4)], rest)

    return [
        run("multisine", "train", 0.6 * wave.multisine(time, random, 0.5, 8.0)),
        run("held steps", "train", 0.9 * wave.held(time, random, 0.12)),
        run("binary", "train", 0.45 * wave.binary(time, random, 0.08)),
        run("noise", "train", 0.6 * wave.noise(time, random, 3.0)),
        run("triangle", "test", 0.8 * wave.triangle(time, 0.45)),
        run("chirp", "test", 0.6 * wave.chirp(time, 0.5, 8.0)),
    ]
