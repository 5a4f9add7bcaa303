"""The systems of the benchmark by name.

Those with ``interface="co_simulation"`` (the battery and the two-node thermal model) are to be
used in co-simulation only: on them a method has inputs, outputs and parameters to work with.
"""

from __future__ import annotations

from closed_loop_benchmark.plants.biological import CHEMOSTAT, PHARMACOKINETICS
from closed_loop_benchmark.plants.crane import GANTRY_CRANE
from closed_loop_benchmark.plants.drives import DC_MOTOR, DC_MOTOR_BELT, TWO_MASS_DRIVE
from closed_loop_benchmark.plants.electrical import BATTERY, RESONANT_CIRCUIT
from closed_loop_benchmark.plants.hydraulic import HYDRAULIC_CYLINDER
from closed_loop_benchmark.plants.kiln import KILN
from closed_loop_benchmark.plants.mechanical import MASS_SPRING_DAMPER, PENDULUM, QUARTER_CAR
from closed_loop_benchmark.plants.process import CASCADED_TANKS, STIRRED_TANK_REACTOR
from closed_loop_benchmark.plants.thermal import ROOM, THERMAL_TWO_NODE
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
