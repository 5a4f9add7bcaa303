"""Effects for the DC motors and the two-mass drive."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect, Name

BELT_WEIGHTS = (1.0 / 1.1e-4, -1.0 / 4.5e-4)
SHAFT_WEIGHTS = (1.0 / 0.022, -1.0 / 0.045)
"""One over the true inertias of the two ends: a torque between them acts on both."""

SINGLE: dict[str, tuple[Effect, ...]] = {
    "dc_motor": (
        Effect("coulomb", "coulomb", "der(w)", (-40.0, 0.06), "w"),
        Effect("stribeck", "stribeck", "der(w)", (-30.0, 0.06, 6.0, 1.0), "w"),
        Effect(
            "fan",
            "quadratic",
            "der(w)",
            (-0.02,),
            "w",
            also=(Name("magnitude", "parameter b", "w"),),
        ),
        Effect("brushes", "coulomb", "der(i)", (-40.0, 5e-3), "i"),
        Effect("load", "constant", "der(w)", (25.0,)),
        Effect("dead_zone", "dead_zone", "input V", (0.6,)),
        Effect("saturation", "saturation", "input V", (6.0,)),
        Effect("delay", "delay", "input V", (0.008,)),
        Effect("backlash", "backlash", "input V", (0.5,)),
        Effect("speed_lag", "lag", "output speed", (0.012,)),
        Effect("current_bias", "bias", "output current", (0.2,)),
        Effect("crosstalk", "feed_through", "output current", (0.03,), "V"),
        Effect("mains_hum", "hum", "output current", (0.15, 50.0, 0.4)),
        Effect("warm_winding", "heating", "parameter R", (0.02, 1.0, 8.0), "i"),
        Effect("iron_saturates", "square", "parameter K", (-0.003, 10.0), "i"),
    ),
    "dc_motor_belt": (
        Effect("load_coulomb", "coulomb", "der(w_load)", (-60.0, 0.05), "w_load"),
        Effect(
            "load_fan",
            "quadratic",
            "der(w_load)",
            (-0.06,),
            "w_load",
            also=(Name("magnitude", "parameter b_load", "w_load"),),
        ),
        Effect(
            "slack_belt",
            "joint",
            "pair w_motor,w_load",
            (1.8, 0.02),
            "twist",
            weights=BELT_WEIGHTS,
        ),
        Effect(
            "belt_stiffens",
            "cubic",
            "pair w_motor,w_load",
            (-8.0,),
            "twist",
            weights=BELT_WEIGHTS,
            also=(Name("square", "parameter k_belt", "twist"),),
        ),
        Effect("ventilator", "constant", "der(w_load)", (-40.0,)),
        Effect("saturation", "saturation", "input V", (5.5,)),
        Effect("amplifier_lag", "lag", "input V", (0.008,)),
        Effect("brake_gain", "gain", "input T_load", (0.25,)),
        Effect("load_speed_lag", "lag", "output load_speed", (0.01,)),
        Effect("speed_bias", "bias", "output speed", (1.0,)),
        Effect("warm_winding", "heating", "parameter R", (0.02, 1.0, 8.0), "i"),
    ),
    "two_mass_drive": (
        Effect("load_coulomb", "coulomb", "der(w_load)", (-3.0, 0.015), "w_load"),
        Effect("load_stribeck", "stribeck", "der(w_load)", (-2.5, 0.015, 1.5, 1.0), "w_load"),
        Effect(
            "load_drag",
            "quadratic",
            "der(w_load)",
            (-0.08,),
            "w_load",
            also=(Name("magnitude", "parameter b_load", "w_load"),),
        ),
        Effect(
            "shaft_stops",
            "gap",
            "pair w_motor,w_load",
            (-40.0, 0.1),
            "twist",
            weights=SHAFT_WEIGHTS,
        ),
        Effect(
            "loose_coupling",
            "joint",
            "pair w_motor,w_load",
            (22.0, 0.02),
            "twist",
            weights=SHAFT_WEIGHTS,
        ),
        Effect("load_torque", "constant", "der(w_load)", (2.5,)),
        Effect("saturation", "saturation", "input torque", (2.4,)),
        Effect("delay", "delay", "input torque", (0.012,)),
        Effect("backlash", "backlash", "input torque", (0.2,)),
        Effect("load_speed_lag", "lag", "output load_speed", (0.012,)),
        Effect("motor_speed_bias", "bias", "output motor_speed", (0.3,)),
        Effect("warm_bearing", "heating", "parameter b_load", (-0.001, 2.0, 60.0), "w_load"),
        Effect("crack_grows", "drift", "parameter k_shaft", (-0.05, 2.5)),
    ),
}

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "dc_motor": (("coulomb", "current_bias"), ("fan", "delay"), ("dead_zone", "speed_lag")),
    "dc_motor_belt": (("load_coulomb", "belt_stiffens"), ("saturation", "speed_bias")),
    "two_mass_drive": (("load_coulomb", "delay"), ("shaft_stops", "load_torque")),
}

OUTSIDE: dict[str, tuple[Effect, ...]] = {
    "dc_motor": (
        Effect("cogging", "cogging", "der(w)", (250.0, 4.0), "w"),
        Effect("amplifier_ripple", "ripple", "input V", (0.15, 7.3, 0.2)),
        Effect("coarse_speed", "quantisation", "output speed", (6.0,)),
    ),
    "dc_motor_belt": (
        Effect("cogging", "cogging", "der(w_motor)", (900.0, 4.0), "w_motor"),
        Effect("slew", "rate_limit", "input V", (80.0,)),
    ),
    "two_mass_drive": (
        Effect("cogging", "cogging", "der(w_load)", (8.0, 3.0), "w_load"),
        Effect("bristle", "bristle", "der(w_load)", (-3.0, 0.05, 0.8, 2.0), "w_load"),
    ),
}
