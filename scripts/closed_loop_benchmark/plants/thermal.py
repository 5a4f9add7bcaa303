"""A heated core in a case, and a heated room behind a wall."""

from __future__ import annotations

import numpy as np

from closed_loop_benchmark import waveforms as wave
from closed_loop_benchmark.system import Array, Role, Run, System, Values, make_run


def core_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Heat flows from core to case to the surroundings."""
    (core, case), (power, surroundings) = x, u
    core_capacity, case_capacity, inner, outer = p
    flow = (core - case) / inner
    loss = (case - surroundings) / outer
    return (power - flow) / core_capacity, (flow - loss) / case_capacity


def core_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure both temperatures."""
    return x[0], x[1]


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


THERMAL_TWO_NODE = System(
    name="thermal_two_node",
    interface="co_simulation",
    split="report",
    states=("T_core", "T_case"),
    inputs=("P", "T_ambient"),
    outputs=("y_core", "y_case"),
    parameters={"C_core": 55.0, "C_case": 170.0, "R_core_case": 1.8, "R_case_ambient": 3.6},
    rates=core_rates,
    readings=core_readings,
    interval=10.0,
    samples=400,
    excitation=core_runs,
    drives=(("P", "T_core"), ("T_ambient", "T_case")),
)


def room_rates(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Heat flows from room to wall to outdoors."""
    (room, wall), (power, outdoors) = x, u
    room_capacity, wall_capacity, inner, outer = p
    into_wall = (room - wall) / inner
    out_of_wall = (wall - outdoors) / outer
    return (power - into_wall) / room_capacity, (into_wall - out_of_wall) / wall_capacity


def room_readings(x: Values, u: Values, p: Values) -> tuple[Array | float, ...]:
    """Measure the air in the room."""
    return (x[0],)


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


ROOM = System(
    name="room",
    interface="model_exchange",
    split="tune",
    states=("T_room", "T_wall"),
    inputs=("P", "T_out"),
    outputs=("y",),
    parameters={"C_room": 4.5e6, "C_wall": 2.6e7, "R_room_wall": 4.4e-3, "R_wall_out": 7.2e-3},
    rates=room_rates,
    readings=room_readings,
    interval=900.0,
    samples=400,
    excitation=room_runs,
    unknown_starts=("T_wall",),
    signals=("sun",),
    drives=(("P", "T_room"), ("T_out", "T_wall")),
)
