"""Disturbances that nobody measures: no function of inputs or states explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from closed_loop_benchmark import waveforms
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.truth import Push


@dataclass(frozen=True)
class Disturbance:
    """A random push on the rate of a state, another one in every run.

    Attributes
    ----------
    label
        Short name, unique in a system.
    state
        Its rate is pushed.
    size
        Of the push, in units of the rate.
    shape
        A few short "kicks", smooth "gusts", long stretches of "presence" and absence, or "white"
        noise, held for a sample.
    """

    label: str
    state: str
    size: float
    shape: Literal["kicks", "gusts", "presence", "white"]


DISTURBANCES: dict[str, tuple[Disturbance, ...]] = {
    "mass_spring_damper": (
        Disturbance("kicks", "v", 1.5, "kicks"),
        Disturbance("gusts", "v", 0.5, "gusts"),
    ),
    "pendulum": (Disturbance("kicks", "speed", 2.0, "kicks"),),
    "quarter_car": (Disturbance("side_wind", "v_body", 0.3, "gusts"),),
    "dc_motor": (Disturbance("work_pieces", "w", 60.0, "presence"),),
    "dc_motor_belt": (Disturbance("kicks", "w_load", 80.0, "kicks"),),
    "two_mass_drive": (
        Disturbance("kicks", "w_load", 6.0, "kicks"),
        Disturbance("work_pieces", "w_load", 4.0, "presence"),
    ),
    "cascaded_tanks": (
        Disturbance("buckets", "h1", 0.03, "kicks"),
        Disturbance("rain", "h2", 0.01, "gusts"),
    ),
    "room": (
        Disturbance("occupancy", "T_room", 8e-5, "presence"),
        Disturbance("wind", "T_room", 3e-5, "gusts"),
    ),
    "battery": (Disturbance("hidden_consumer", "soc", -2e-5, "presence"),),
    "stirred_tank_reactor": (Disturbance("steam", "T", 0.03, "gusts"),),
    "thermal_two_node": (Disturbance("draught", "T_case", 0.01, "gusts"),),
    "gantry_crane": (Disturbance("wind", "w", 1.0, "gusts"),),
    "kiln": (Disturbance("opened_door", "T_charge", -0.15, "presence"),),
    "pharmacokinetics": (Disturbance("meals", "gut", 4e-3, "presence"),),
    "chemostat": (Disturbance("contamination", "X", -1e-5, "gusts"),),
    "hydraulic_cylinder": (Disturbance("stick", "v", 3.0, "kicks"),),
    "resonant_circuit": (Disturbance("consumer", "u", 1500.0, "presence"),),
}

PROCESS_NOISE: dict[str, Disturbance] = {
    "mass_spring_damper": Disturbance("process", "v", 0.15, "white"),
    "pendulum": Disturbance("process", "speed", 0.3, "white"),
    "quarter_car": Disturbance("process", "v_body", 0.1, "white"),
    "dc_motor": Disturbance("process", "w", 12.0, "white"),
    "dc_motor_belt": Disturbance("process", "w_load", 12.0, "white"),
    "two_mass_drive": Disturbance("process", "w_load", 1.0, "white"),
    "cascaded_tanks": Disturbance("process", "h1", 4e-3, "white"),
    "room": Disturbance("process", "T_room", 1.5e-5, "white"),
    "battery": Disturbance("process", "v1", 2e-5, "white"),
    "stirred_tank_reactor": Disturbance("process", "T", 0.02, "white"),
    "thermal_two_node": Disturbance("process", "T_case", 5e-3, "white"),
    "gantry_crane": Disturbance("process", "v", 0.25, "white"),
    "kiln": Disturbance("process", "T_charge", 0.05, "white"),
    "pharmacokinetics": Disturbance("process", "central", 5e-4, "white"),
    "chemostat": Disturbance("process", "X", 4e-6, "white"),
    "hydraulic_cylinder": Disturbance("process", "v", 0.8, "white"),
    "resonant_circuit": Disturbance("process", "u", 250.0, "white"),
}
"""A random walk in a state: some two or three times the noise of the sensors, at the outputs."""


def push(
    disturbance: Disturbance, system: System, runs: Sequence[Run], random: np.random.Generator
) -> Push:
    """Draw a disturbance for every run of a system."""
    shapes = {"kicks": _kicks, "gusts": _gusts, "presence": _presence, "white": _white}
    columns = [shapes[disturbance.shape](system.times, random) for _ in runs]
    return Push(disturbance.state, disturbance.size * np.column_stack(columns))


def _kicks(time: Array, random: np.random.Generator) -> Array:
    """Return five rectangular pulses of random strength and sign."""
    found, duration = np.zeros_like(time), time[-1]
    for _ in range(5):
        start = random.uniform(0.05, 0.9) * duration
        end = start + random.uniform(0.01, 0.06) * duration
        strength = random.choice([-1.0, 1.0]) * random.uniform(0.5, 1.2)
        found += strength * ((time >= start) & (time < end))
    return found


def _gusts(time: Array, random: np.random.Generator) -> Array:
    """Return smooth noise of about fifteen swings a run."""
    return waveforms.noise(time, random, 15.0 / time[-1])


def _presence(time: Array, random: np.random.Generator) -> Array:
    """Return about eight stretches of either one or zero."""
    return np.asarray(waveforms.binary(time, random, time[-1] / 8.0) > 0, dtype=float)


def _white(time: Array, random: np.random.Generator) -> Array:
    """Return independent normal values."""
    return random.normal(size=time.size)
