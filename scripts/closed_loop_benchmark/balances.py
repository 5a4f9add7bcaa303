"""Systems that store charge, heat or substance: circuits, rooms, tanks, a body."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, Values, make_run


def cell_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Charge of the cell, and of the capacitor with the lagging voltage."""
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


def circuit_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Kirchhoff's laws for the loop and for the node."""
    (current, voltage), (source,), (resistance, inductance, capacitance, load) = x, u, p
    return (
        (source - voltage - resistance * current) / inductance,
        (current - load * voltage) / capacitance,
    )


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


def core_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Heat flows from core to case to the surroundings."""
    (core, case), (power, surroundings) = x, u
    core_capacity, case_capacity, inner, outer = p
    flow = (core - case) / inner
    loss = (case - surroundings) / outer
    return (power - flow) / core_capacity, (flow - loss) / case_capacity


def core_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Heat by up to 15 W in changing surroundings."""

    def run(waveform: str, role: Role, power: Array, warmth: float, start: float) -> Run:
        surroundings = 22.0 + warmth * wave.ramps(time, random, 600.0)
        starts = {"T_core": start, "T_case": start}
        return make_run(waveform, role, [power, surroundings], starts)

    return [
        run("held steps", "train", 7.5 + 7.5 * wave.held(time, random, 300.0), 6.0, 25.0),
        run("binary", "train", 4.0 + 3.0 * wave.binary(time, random, 150.0), 4.0, 30.0),
        run("multisine", "train", 8.0 + 4.0 * wave.multisine(time, random, 3e-4, 8e-3), 6.0, 20.0),
        run("ramps", "train", 6.0 + 6.0 * wave.ramps(time, random, 400.0), 8.0, 25.0),
        run("triangle", "test", 7.0 + 6.0 * wave.triangle(time, 900.0), 5.0, 25.0),
        run("gentle steps", "test", 5.0 + 4.0 * wave.held(time, random, 200.0), 6.0, 28.0),
    ]


def room_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Heat flows from room to wall to outdoors."""
    (room, wall), (power, outdoors) = x, u
    room_capacity, wall_capacity, inner, outer = p
    into_wall = (room - wall) / inner
    out_of_wall = (wall - outdoors) / outer
    return (power - into_wall) / room_capacity, (into_wall - out_of_wall) / wall_capacity


def room_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Heat for four days of changing weather; the sun is measured, but no input of the model."""

    def run(waveform: str, role: Role, power: Array, mean: float, wall: float) -> Run:
        day = 4.0 * np.sin(2.0 * np.pi * (time / 86400.0 - 0.35))
        weather = 4.0 * wave.ramps(time, random, 30000.0)
        sun = 600.0 * wave.daylight(time, random)
        starts = {"T_room": wall + 4.0, "T_wall": wall}
        return make_run(waveform, role, [power, mean + day + weather], starts, [sun])

    return [
        run("binary", "train", 1700.0 + 1300.0 * wave.binary(time, random, 7200.0), 4.0, 13.0),
        run("held steps", "train", 1800.0 + 1800.0 * wave.held(time, random, 14400.0), 2.0, 14.0),
        run("ramps", "train", 1200.0 + 900.0 * wave.ramps(time, random, 10800.0), 8.0, 15.0),
        run("off and on", "train", 1100.0 * (1.0 + wave.binary(time, random, 21600.0)), 6.0, 16.0),
        run("triangle", "test", 1500.0 + 1200.0 * wave.triangle(time, 50000.0), 5.0, 14.0),
        run("gentle steps", "test", 1300.0 + 800.0 * wave.held(time, random, 9000.0), 7.0, 15.0),
    ]


def kiln_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of heat of the plate and of the charge."""
    (plate, charge), (power, ambient) = x, u
    plate_capacity, charge_capacity, between, plate_loss, charge_loss = p
    passed = between * (plate - charge)
    return (
        (power - passed - plate_loss * (plate - ambient)) / plate_capacity,
        (passed - charge_loss * (charge - ambient)) / charge_capacity,
    )


def kiln_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Heat up, hold and cool down, in a hall with a varying temperature."""

    def run(waveform: str, role: Role, power: Array, start: float) -> Run:
        ambient = 293.0 + 6.0 * wave.ramps(time, random, 900.0)
        return make_run(waveform, role, [power, ambient], {"T_plate": start, "T_charge": start})

    return [
        run("held steps", "train", 950.0 + 900.0 * wave.held(time, random, 300.0), 293.0),
        run("binary", "train", 800.0 + 700.0 * wave.binary(time, random, 200.0), 293.0),
        run("ramps", "train", 1000.0 + 950.0 * wave.ramps(time, random, 400.0), 400.0),
        run("pulses", "train", 500.0 + 480.0 * wave.binary(time, random, 350.0), 600.0),
        run("triangle", "test", 900.0 + 850.0 * wave.triangle(time, 1700.0), 293.0),
        run("noise", "test", 900.0 + 450.0 * wave.noise(time, random, 1.5e-3), 350.0),
    ]


def tank_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Torricelli's law: an outflow is proportional to the root of its level."""
    (upper, lower), (pump,), (outlet_1, outlet_2, gain) = x, u, p
    between = outlet_1 * np.sqrt(np.maximum(upper, 0.0))
    away = outlet_2 * np.sqrt(np.maximum(lower, 0.0))
    return gain * pump - between, between - away


def tank_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Pump with voltages from 0 to 4 V."""

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


def reactor_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of substance and of heat, with an Arrhenius reaction."""
    (c, temperature), (flow, coolant) = x, u
    speed_350, activation, c_feed, t_feed, rise, cooling, volume = p
    turned = speed_350 * np.exp(activation / 350.0 - activation / temperature) * c
    renewal = flow / volume
    return (
        renewal * (c_feed - c) - turned,
        renewal * (t_feed - temperature) + rise * turned + cooling * (coolant - temperature),
    )


def reactor_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Change feed and coolant around a stable operating point."""

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


def body_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of three compartments with linear exchange."""
    (gut, central, tissue), (oral, infusion) = x, u
    absorption, elimination, outward, inward, _, _ = p
    return (
        oral - absorption * gut,
        infusion + absorption * gut - (elimination + outward) * central + inward * tissue,
        outward * central - inward * tissue,
    )


def body_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the concentrations in plasma and tissue."""
    return x[1] / p[4], x[2] / p[5]


def body_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Give meals of the drug, infusions, and both."""
    none = dict.fromkeys(("gut", "central", "tissue"), 0.0)

    def run(waveform: str, role: Role, oral: Array, infusion: Array) -> Run:
        return make_run(waveform, role, [oral, infusion], none)

    def doses(size: float, hold: float) -> Array:
        return np.asarray(size * np.maximum(wave.held(time, random, hold) - 0.2, 0.0))

    nothing = np.zeros_like(time)
    slow = 0.006 + 0.006 * wave.ramps(time, random, 14400.0)
    return [
        run("meals", "train", doses(0.06, 3600.0), nothing),
        run("infusions", "train", nothing, 0.01 + 0.01 * wave.binary(time, random, 10800.0)),
        run("both", "train", doses(0.04, 7200.0), doses(0.03, 9000.0)),
        run("slow infusion", "train", doses(0.03, 5400.0), slow),
        run("large meals", "test", doses(0.07, 5400.0), nothing),
        run("mixed", "test", doses(0.03, 3600.0), doses(0.02, 7200.0)),
    ]


def chemostat_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Balances of biomass and substrate, with Monod growth."""
    (biomass, substrate), (dilution, feed) = x, u
    fastest, half, gained = p
    growth = fastest * biomass * substrate / (half + substrate)
    return (
        growth - dilution * biomass,
        dilution * (feed - substrate) - growth / gained,
    )


def chemostat_runs(time: Array, random: np.random.Generator) -> list[Run]:
    """Change the flow and the concentration of the feed, sometimes close to washout."""

    def run(waveform: str, role: Role, flow: Array, feed: Array, start: float) -> Run:
        inputs = [5.5e-5 + 4e-5 * flow, 8.0 + 4.0 * feed]
        return make_run(waveform, role, inputs, {"X": start, "S": 1.0})

    def steps(hold: float) -> Array:
        return wave.held(time, random, hold)

    return [
        run("held steps", "train", steps(9000.0), steps(14400.0), 3.0),
        run("binary", "train", 0.9 * wave.binary(time, random, 10800.0), 0.6 * steps(9000.0), 1.0),
        run("ramps", "train", wave.ramps(time, random, 14400.0), steps(18000.0), 4.0),
        run("strong feed", "train", 0.8 * steps(12000.0), 0.7 + 0.3 * steps(16000.0), 2.0),
        run("triangle", "test", wave.triangle(time, 40000.0), 0.5 * steps(12000.0), 3.0),
        run("noise", "test", 0.6 * wave.noise(time, random, 5e-5), steps(15000.0), 2.0),
    ]
