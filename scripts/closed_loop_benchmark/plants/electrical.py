"""A battery cell, and a resonant circuit."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def cell_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Charge of the cell, and of the capacitor that lags behind the current."""
    (_, lagging), (current,), (capacity, _, resistance, capacitance) = x, u, p
    return -current / capacity, (current - lagging / resistance) / capacitance


def cell_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the voltage at the terminals."""
    (charge, lagging), (current,), ohms = x, u, p[1]
    fall = 0.35 * np.exp(-18.0 * charge)
    return (3.45 + charge * (0.45 + 0.25 * charge**2) - fall - ohms * current - lagging,)


def cell_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Discharge and charge between about 20 % and 90 %."""

    def run(waveform: str, role: Role, current: Array, soc: float) -> Run:
        return make_run(waveform, role, [current], {"soc": soc, "v1": 0.0})

    return [
        run("held steps", "train", 0.5 + 1.6 * wave.held(time, random, 200.0), 0.85),
        run("binary", "train", 0.2 + 0.6 * wave.binary(time, random, 120.0), 0.7),
        run("ramps", "train", -0.3 + 1.2 * wave.ramps(time, random, 150.0), 0.4),
        run("pulses", "train", 0.7 + 1.1 * wave.binary(time, random, 100.0), 0.9),
        run("triangle", "test", 0.3 + 1.6 * wave.triangle(time, 700.0), 0.75),
        run("noise", "test", 0.1 + 0.8 * wave.noise(time, random, 2e-3), 0.6),
    ]


BATTERY = System(
    name="battery",
    interface="co_simulation",
    split="tune",
    states=("soc", "v1"),
    inputs=("current",),
    outputs=("voltage",),
    parameters={"Q": 6800.0, "R0": 0.055, "R1": 0.035, "C1": 2800.0},
    rates=cell_rates,
    readings=cell_readings,
    interval=10.0,
    samples=400,
    excitation=cell_runs,
    unknown_starts=("soc",),
    start_error=0.05,
)


def circuit_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Kirchhoff's laws for the loop and for the node."""
    (current, voltage), (source,), (resistance, inductance, capacitance, load) = x, u, p
    return (
        (source - voltage - resistance * current) / inductance,
        (current - load * voltage) / capacitance,
    )


def circuit_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure current and voltage."""
    return x[0], x[1]


def circuit_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Drive below and around the resonance at 160 Hz."""
    rest = {"i": 0.0, "u": 0.0}
    return [
        make_run("multisine", "train", [10.0 * wave.multisine(time, random, 20.0, 250.0)], rest),
        make_run("held steps", "train", [11.0 * wave.held(time, random, 6e-3)], rest),
        make_run("binary", "train", [5.0 * wave.binary(time, random, 2e-3)], rest),
        make_run("noise", "train", [9.0 * wave.noise(time, random, 100.0)], rest),
        make_run("triangle", "test", [11.0 * wave.triangle(time, 0.023)], rest),
        make_run("chirp", "test", [7.0 * wave.chirp(time, 20.0, 250.0)], rest),
    ]


RESONANT_CIRCUIT = System(
    name="resonant_circuit",
    interface="model_exchange",
    split="report",
    states=("i", "u"),
    inputs=("e",),
    outputs=("current", "voltage"),
    parameters={"R": 0.8, "L": 2e-3, "C": 5e-4, "G": 0.15},
    rates=circuit_rates,
    readings=circuit_readings,
    interval=2e-4,
    samples=500,
    excitation=circuit_runs,
    drives=(("e", "i"),),
)
