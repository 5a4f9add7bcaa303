"""The systems of the benchmark by name.

Those with ``interface="co_simulation"`` (the battery and the two-node thermal model) are to be
used in co-simulation only: on them a method has inputs, outputs and parameters to work with.
"""

from __future__ import annotations

from closed_loop_benchmark.balances import (
    BATTERY,
    CASCADED_TANKS,
    CHEMOSTAT,
    KILN,
    PHARMACOKINETICS,
    RESONANT_CIRCUIT,
    ROOM,
    STIRRED_TANK_REACTOR,
    THERMAL_TWO_NODE,
)
from closed_loop_benchmark.mechanical import (
    DC_MOTOR,
    DC_MOTOR_BELT,
    GANTRY_CRANE,
    HYDRAULIC_CYLINDER,
    MASS_SPRING_DAMPER,
    PENDULUM,
    QUARTER_CAR,
    TWO_MASS_DRIVE,
)
from closed_loop_benchmark.system import Run, System

__all__ = ["SYSTEMS", "Run", "System"]

SYSTEMS: dict[str, System] = {
    system.name: system
    for system in (
        MASS_SPRING_DAMPER,
        PENDULUM,
        DC_MOTOR,
        DC_MOTOR_BELT,
        CASCADED_TANKS,
        ROOM,
        BATTERY,
        QUARTER_CAR,
        TWO_MASS_DRIVE,
        STIRRED_TANK_REACTOR,
        THERMAL_TWO_NODE,
        GANTRY_CRANE,
        KILN,
        PHARMACOKINETICS,
        CHEMOSTAT,
        HYDRAULIC_CYLINDER,
        RESONANT_CIRCUIT,
    )
}
