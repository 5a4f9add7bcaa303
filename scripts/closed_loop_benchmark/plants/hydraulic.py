"""A hydraulic cylinder with a servo valve."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def cylinder_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Newton's law for the mass, and the oil's compression; pressures in MPa."""
    (position, speed, pressure), (opening, load) = x, u
    mass, friction, spring, oil, gain, area, supply = p
    flow = gain * opening * np.sqrt(np.maximum(supply - np.sign(opening) * pressure, 0.0))
    force = 1e6 * area * pressure - load - friction * speed - spring * position
    return speed, force / mass, oil * (flow - area * speed)


def cylinder_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure position and pressure."""
    return x[0], x[2]


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


HYDRAULIC_CYLINDER = System(
    name="hydraulic_cylinder",
    interface="model_exchange",
    split="report",
    states=("x", "v", "p"),
    inputs=("u", "F_load"),
    outputs=("position", "pressure"),
    parameters={"mass": 50.0, "b": 800.0, "k": 2e4, "E": 1.25e5, "q": 1.4e-4},
    constants={"area": 1.2e-3, "p_supply": 7.0},
    rates=cylinder_rates,
    readings=cylinder_readings,
    interval=5e-3,
    samples=500,
    excitation=cylinder_runs,
    drives=(("F_load", "v"),),
    substeps=20,
)
