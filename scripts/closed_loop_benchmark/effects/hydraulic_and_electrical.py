"""Effects for the hydraulic cylinder and the resonant circuit, from textbooks of both fields.

Leakage, overlap, saturating valves and air in oil after H. E. Merritt, Hydraulic Control Systems;
the voltage that an inverter's dead time takes after S.-G. Jeong, M.-H. Park, IEEE Trans. Ind.
Electron. 38 (1991) 108-114, doi:10.1109/41.88903; dielectric absorption, varistors and saturating
cores after P. Horowitz, W. Hill, The Art of Electronics.
"""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect

TEXTBOOK: dict[str, tuple[Effect, ...]] = {
    "hydraulic_cylinder": (
        Effect("laminar_leak", "linear", "der(p)", (-6.0,), "p"),
        Effect("orifice_leak", "leak", "der(p)", (-6.0,), "p"),
        Effect("relief_valve", "hinge", "der(p)", (-40.0, 0.7), "p"),
        Effect("seal_friction", "coulomb", "der(v)", (-2.5, 5e-4), "v"),
        Effect("breakaway", "stribeck", "der(v)", (-1.5, 5e-4, 0.05, 1.5), "v"),
        Effect("pressed_seals", "pressed_friction", "der(v)", (-2.5, 5e-4), "v", "p"),
        Effect("end_cushion", "contact", "der(v)", (-1.5e4, 0.01), "x"),
        Effect("weight", "bias", "input F_load", (150.0,)),
        Effect("air_in_oil", "inverse", "parameter E", (-0.5, 0.5), "p"),
        Effect("hardening_spring", "square", "parameter k", (250.0, 4e-4), "x"),
        Effect("overlap", "dead_zone", "input u", (0.06,)),
        Effect("servo_valve", "mode", "input u", (1.0, 20.0, 0.6)),
        Effect("pilot_stage", "rate_limit", "input u", (12.0,)),
        Effect("shaped_ports", "cubic", "input u", (0.3,)),
        Effect("pressure_line", "lag", "output pressure", (6e-3,)),
        Effect("bent_scale", "square", "output position", (3.0,)),
    ),
    "resonant_circuit": (
        Effect("dead_time", "coulomb", "input e", (-0.7, 5e-3), "i"),
        Effect("crossover", "dead_zone", "input e", (0.4,)),
        Effect("pulse_width", "delay", "input e", (3e-4,)),
        Effect("slew_rate", "rate_limit", "input e", (1.2e4,)),
        Effect("core_saturates", "saturating_square", "parameter L", (-0.5, 8.0), "i"),
        Effect("ceramic", "saturating_square", "parameter C", (-0.4, 9.0), "u"),
        Effect("lamp", "heating", "parameter R", (0.02, 0.02, 12.0), "i"),
        Effect("hot_winding", "drift", "parameter R", (3.0, 0.05)),
        Effect("clamp", "hinge", "der(u)", (-800.0, 5.0), "u"),
        Effect("diode", "exponential", "der(u)", (-15.0, 1.6, 0.0), "u"),
        Effect("varistor", "power", "der(u)", (-0.02, 5.0), "u"),
        Effect("converter", "constant_power", "der(u)", (-6000.0, 2.0), "u"),
        Effect("arc", "quadratic", "der(i)", (-12.0,), "i"),
        Effect("dielectric_absorption", "lagged", "der(u)", (-120.0, 8e-3), "u"),
        Effect("current_probe", "lag", "output current", (2e-4,)),
        Effect("amplifier_clips", "saturation", "output voltage", (7.0,)),
    ),
}
