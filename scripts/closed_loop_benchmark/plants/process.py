"""Two tanks in cascade, and an exothermic reaction in a stirred tank."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def tank_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Torricelli's law: an outflow goes with the root of its level."""
    (upper, lower), (pump,), (outlet_1, outlet_2, gain) = x, u, p
    between = outlet_1 * np.sqrt(np.maximum(upper, 0.0))
    away = outlet_2 * np.sqrt(np.maximum(lower, 0.0))
    return gain * pump - between, between - away


def tank_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the lower level."""
    return (x[1],)


def tank_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Pump between nothing and 4 V."""

    def run(waveform: str, role: Role, mean: float, size: float, shape: Array) -> Run:
        pump = np.clip(mean + size * shape, 0.0, 5.0)
        levels = {"h1": float(random.uniform(2.0, 5.0)), "h2": float(random.uniform(2.0, 5.0))}
        return make_run(waveform, role, [pump], levels)

    return [
        run("held steps", "train", 2.0, 2.0, wave.held(time, random, 80.0)),
        run("multisine", "train", 1.9, 1.4, wave.multisine(time, random, 1e-3, 1.2e-2)),
        run("binary", "train", 1.4, 0.7, wave.binary(time, random, 60.0)),
        run("ramps", "train", 2.0, 1.8, wave.ramps(time, random, 120.0)),
        run("triangle", "test", 1.9, 1.5, wave.triangle(time, 300.0)),
        run("gentle steps", "test", 1.7, 1.0, wave.held(time, random, 100.0)),
    ]


CASCADED_TANKS = System(
    name="cascaded_tanks",
    interface="model_exchange",
    split="tune",
    states=("h1", "h2"),
    inputs=("u",),
    outputs=("y",),
    parameters={"k1": 0.055, "k2": 0.048, "kp": 0.052},
    rates=tank_rates,
    readings=tank_readings,
    interval=4.0,
    samples=400,
    excitation=tank_runs,
    unknown_starts=("h1", "h2"),
    drives=(("u", "h1"),),
)


def reactor_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of substance and of heat, the reaction by Arrhenius."""
    (c, temperature), (flow, coolant) = x, u
    speed_350, activation, c_feed, t_feed, rise, cooling, volume = p
    turned = speed_350 * np.exp(activation / 350.0 - activation / temperature) * c
    renewal = flow / volume
    return (
        renewal * (c_feed - c) - turned,
        renewal * (t_feed - temperature) + rise * turned + cooling * (coolant - temperature),
    )


def reactor_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure concentration and temperature."""
    return x[0], x[1]


def reactor_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Change feed and coolant around a stable point of operation."""

    def run(role: Role, names: str, feed: Array, coolant: Array, start: float) -> Run:
        inputs = [1.6e-3 + 4e-4 * feed, 326.0 + coolant]
        return make_run(names, role, inputs, {"c": start, "T": 345.0})

    def steps(hold: float) -> Array:
        return wave.held(time, random, hold)

    def binary(hold: float) -> Array:
        return wave.binary(time, random, hold)

    return [
        run("train", "held steps", steps(150.0), 5.0 * steps(200.0), 500.0),
        run("train", "binary", 0.5 * binary(80.0), 3.0 * binary(110.0), 550.0),
        run("train", "ramps", wave.ramps(time, random, 150.0), 2.0 * steps(120.0), 450.0),
        run(
            "train", "steps, ramps", 0.4 * steps(60.0), 6.0 * wave.ramps(time, random, 100.0), 500.0
        ),
        run(
            "test", "triangles", wave.triangle(time, 350.0), 4.0 * wave.triangle(time, 450.0), 500.0
        ),
        run("test", "noises", 0.5 * wave.noise(time, random, 4e-3), 3.0 * binary(170.0), 520.0),
    ]


STIRRED_TANK_REACTOR = System(
    name="stirred_tank_reactor",
    interface="model_exchange",
    split="report",
    states=("c", "T"),
    inputs=("flow", "T_coolant"),
    outputs=("concentration", "temperature"),
    parameters={
        "k_350": 0.0145,
        "E_R": 8500.0,
        "c_feed": 980.0,
        "T_feed": 344.0,
        "rise": 0.095,
        "cooling": 0.032,
    },
    constants={"volume": 0.1},
    spreads={"k_350": 0.1, "E_R": 0.05, "c_feed": 0.1, "T_feed": 0.01, "rise": 0.1},
    rates=reactor_rates,
    readings=reactor_readings,
    interval=5.0,
    samples=400,
    excitation=reactor_runs,
    drives=(("T_coolant", "T"),),
)
