"""The systems of the benchmark by name: their tables (`systems.toml`), each with its equations."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from closed_loop_benchmark import balances, mechanical
from closed_loop_benchmark.system import Equations, Excitation, System, measured

PHYSICS: dict[str, tuple[Equations, Excitation]] = {
    "mass_spring_damper": (mechanical.spring_rates, mechanical.spring_runs),
    "pendulum": (mechanical.pendulum_rates, mechanical.pendulum_runs),
    "dc_motor": (mechanical.motor_rates, mechanical.motor_runs),
    "dc_motor_belt": (mechanical.belt_rates, mechanical.belt_runs),
    "cascaded_tanks": (balances.tank_rates, balances.tank_runs),
    "room": (balances.room_rates, balances.room_runs),
    "battery": (balances.cell_rates, balances.cell_runs),
    "quarter_car": (mechanical.car_rates, mechanical.car_runs),
    "two_mass_drive": (mechanical.shaft_rates, mechanical.shaft_runs),
    "stirred_tank_reactor": (balances.reactor_rates, balances.reactor_runs),
    "thermal_two_node": (balances.core_rates, balances.core_runs),
    "gantry_crane": (mechanical.crane_rates, mechanical.crane_runs),
    "kiln": (balances.kiln_rates, balances.kiln_runs),
    "pharmacokinetics": (balances.body_rates, balances.body_runs),
    "chemostat": (balances.chemostat_rates, balances.chemostat_runs),
    "hydraulic_cylinder": (mechanical.cylinder_rates, mechanical.cylinder_runs),
    "resonant_circuit": (balances.circuit_rates, balances.circuit_runs),
}
"""The rates of the states, and the functions that make the runs."""

READINGS = {
    "battery": balances.cell_readings,
    "quarter_car": mechanical.car_readings,
    "pharmacokinetics": balances.body_readings,
}
"""Equations of sensors that measure more than states."""


def _system(name: str, given: dict[str, Any]) -> System:
    rates, excitation = PHYSICS[name]
    shown = [given["states"].index(state) for state in given.pop("measured", ())]
    entries: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in given.items()
    }
    entries["drives"] = tuple(given.get("drives", {}).items())
    readings = READINGS.get(name) or measured(*shown)
    return System(name, rates=rates, readings=readings, excitation=excitation, **entries)


SYSTEMS: dict[str, System] = {
    name: _system(name, given)
    for name, given in tomllib.loads(
        Path(__file__).with_name("systems.toml").read_text(encoding="utf-8")
    ).items()
}
