"""Mass-spring-damper, pendulum and quarter car."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Run, System, Values, make_run


def spring_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for a mass on a spring and a damper."""
    (position, velocity), (force,), (mass, stiffness, damping) = x, u, p
    return velocity, (force - stiffness * position - damping * velocity) / mass


def first_state(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the first state."""
    return (x[0],)


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


MASS_SPRING_DAMPER = System(
    name="mass_spring_damper",
    interface="model_exchange",
    split="tune",
    states=("x", "v"),
    inputs=("F",),
    outputs=("y",),
    parameters={"m": 1.2, "k": 30.0, "c": 0.6},
    rates=spring_rates,
    readings=first_state,
    interval=0.02,
    samples=500,
    excitation=spring_runs,
    drives=(("F", "v"),),
)


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


PENDULUM = System(
    name="pendulum",
    interface="model_exchange",
    split="tune",
    states=("angle", "speed"),
    inputs=("torque",),
    outputs=("y",),
    parameters={"J": 0.11, "G": 2.1, "b": 0.05},
    rates=pendulum_rates,
    readings=first_state,
    interval=0.04,
    samples=400,
    excitation=pendulum_runs,
    drives=(("torque", "speed"),),
)


def car_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for body and wheel; `lift` is what the suspension does to the body."""
    body, body_speed, wheel, wheel_speed = x
    wheel_mass, spring, damper, tyre, body_mass = p
    lift = spring * (wheel - body) + damper * (wheel_speed - body_speed)
    grip = tyre * (u[0] - wheel)
    return body_speed, lift / body_mass, wheel_speed, (grip - lift) / wheel_mass


def car_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the velocity of the body and the travel of the suspension."""
    return x[1], x[0] - x[2]


def car_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive over roads with bumps of centimetres, up to the wheel's hop at 10 Hz."""
    rest = dict.fromkeys(("z_body", "v_body", "z_wheel", "v_wheel"), 0.0)
    return [
        make_run("multisine", "train", [0.03 * wave.multisine(time, random, 0.4, 8.0, 20)], rest),
        make_run("ramps", "train", [0.06 * wave.ramps(time, random, 0.12)], rest),
        make_run("chirp", "train", [0.012 * wave.chirp(time, 0.5, 12.0)], rest),
        make_run("noise", "train", [0.05 * wave.noise(time, random, 2.0)], rest),
        make_run("triangle", "test", [0.05 * wave.triangle(time, 0.7)], rest),
        make_run("gentle noise", "test", [0.03 * wave.noise(time, random, 3.0)], rest),
    ]


QUARTER_CAR = System(
    name="quarter_car",
    interface="model_exchange",
    split="report",
    states=("z_body", "v_body", "z_wheel", "v_wheel"),
    inputs=("road",),
    outputs=("velocity", "travel"),
    parameters={"m_wheel": 36.0, "k_spring": 1.8e4, "c_damper": 1.4e3, "k_tyre": 1.7e5},
    constants={"m_body": 300.0},
    rates=car_rates,
    readings=car_readings,
    interval=0.01,
    samples=500,
    excitation=car_runs,
    drives=(("road", "v_wheel"),),
)
