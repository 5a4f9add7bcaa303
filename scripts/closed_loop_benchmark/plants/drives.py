"""DC motor with a stiff load, DC motor with a belt, and two inertias on an elastic shaft."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Run, System, Values, make_run


def motor_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Kirchhoff's law for the armature, Newton's for the rotor."""
    (current, speed), (voltage,), (resistance, inductance, constant, inertia, friction) = x, u, p
    back_emf = constant * speed
    return (
        (voltage - resistance * current - back_emf) / inductance,
        (constant * current - friction * speed) / inertia,
    )


def motor_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the current and the speed."""
    return x[0], x[1]


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


DC_MOTOR = System(
    name="dc_motor",
    interface="model_exchange",
    split="tune",
    states=("i", "w"),
    inputs=("V",),
    outputs=("current", "speed"),
    parameters={"R": 1.1, "L": 0.012, "K": 0.055, "J": 4.5e-4, "b": 2.5e-4},
    rates=motor_rates,
    readings=motor_readings,
    interval=4e-3,
    samples=500,
    excitation=motor_runs,
    drives=(("V", "i"),),
)


def belt_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Motor and load, each pulling at the belt."""
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


def belt_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the current and both speeds."""
    return x[0], x[1], x[3]


def belt_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive and brake at once."""
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


DC_MOTOR_BELT = System(
    name="dc_motor_belt",
    interface="model_exchange",
    split="tune",
    states=("i", "w_motor", "twist", "w_load"),
    inputs=("V", "T_load"),
    outputs=("current", "speed", "load_speed"),
    parameters={
        "R": 1.1,
        "L": 6e-3,
        "K": 0.055,
        "J_motor": 1.1e-4,
        "b_motor": 1e-4,
        "k_belt": 1.8,
        "d_belt": 6e-3,
        "J_load": 4.5e-4,
        "b_load": 4e-4,
    },
    rates=belt_rates,
    readings=belt_readings,
    interval=4e-3,
    samples=500,
    excitation=belt_runs,
    drives=(("V", "i"), ("T_load", "w_load")),
)


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


def shaft_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure both speeds."""
    return x[1], x[2]


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


TWO_MASS_DRIVE = System(
    name="two_mass_drive",
    interface="model_exchange",
    split="report",
    states=("twist", "w_motor", "w_load"),
    inputs=("torque",),
    outputs=("motor_speed", "load_speed"),
    parameters={
        "J_motor": 0.022,
        "J_load": 0.045,
        "k_shaft": 22.0,
        "d_shaft": 0.06,
        "b_motor": 0.015,
        "b_load": 0.045,
    },
    rates=shaft_rates,
    readings=shaft_readings,
    interval=0.01,
    samples=500,
    excitation=shaft_runs,
    drives=(("torque", "w_motor"),),
)
