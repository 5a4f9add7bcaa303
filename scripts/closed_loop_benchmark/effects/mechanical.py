"""Effects for the mass-spring-damper, the pendulum and the quarter car."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect, Name

SINGLE: dict[str, tuple[Effect, ...]] = {
    "mass_spring_damper": (
        Effect("coulomb", "coulomb", "der(v)", (-0.5, 0.0015), "v"),
        Effect("stribeck", "stribeck", "der(v)", (-0.4, 0.0015, 0.25, 0.8), "v"),
        Effect(
            "drag",
            "quadratic",
            "der(v)",
            (-0.25,),
            "v",
            also=(Name("magnitude", "parameter c", "v"),),
        ),
        Effect(
            "stiffening",
            "cubic",
            "der(v)",
            (-12.0,),
            "x",
            also=(Name("square", "parameter k", "x"),),
        ),
        Effect("end_stop", "end_stop", "der(v)", (-40.0, 0.35), "x"),
        Effect("dahl", "dahl", "der(v)", (-0.7, 0.03), "v"),
        Effect("load", "constant", "der(v)", (0.5,)),
        Effect("engine", "sine", "der(v)", (0.35, 0.55, 0.7)),
        Effect("dead_zone", "dead_zone", "input F", (0.7,)),
        Effect("saturation", "saturation", "input F", (3.6,)),
        Effect("delay", "delay", "input F", (0.05,)),
        Effect("magnet_gap", "product", "input F", (-0.4,), "x"),
        Effect("sensor_lag", "lag", "output y", (0.06,)),
        Effect("sensor_drift", "drift", "output y", (0.003,)),
        Effect("fatigue", "drift", "parameter k", (-0.012, 5.0)),
    ),
    "pendulum": (
        Effect("coulomb", "coulomb", "der(speed)", (-0.5, 0.003), "speed"),
        Effect(
            "drag",
            "quadratic",
            "der(speed)",
            (-0.12,),
            "speed",
            also=(Name("magnitude", "parameter b", "speed"),),
        ),
        Effect("cable", "linear", "der(speed)", (-1.5,), "angle"),
        Effect(
            "cubic_drag",
            "cubic",
            "der(speed)",
            (-0.03,),
            "speed",
            also=(Name("square", "parameter b", "speed"),),
        ),
        Effect("end_stop", "end_stop", "der(speed)", (-40.0, 0.7), "angle"),
        Effect("bump", "hinge", "der(speed)", (-15.0, 0.5), "angle"),
        Effect("unbalance", "constant", "der(speed)", (0.7,)),
        Effect("dead_zone", "dead_zone", "input torque", (0.1,)),
        Effect("saturation", "saturation", "input torque", (0.45,)),
        Effect("backlash", "backlash", "input torque", (0.12,)),
        Effect("delay", "delay", "input torque", (0.05,)),
        Effect("sensor_bias", "bias", "output y", (0.03,)),
        Effect("sensor_lag", "lag", "output y", (0.03,)),
        Effect("sensor_square", "square", "output y", (0.05,)),
    ),
    "quarter_car": (
        Effect(
            "bump_stop",
            "gap",
            "pair v_body,v_wheel",
            (-4e4, 0.03),
            "z_body-z_wheel",
            weights=(1.0 / 300.0, -1.0 / 36.0),
            also=(Name("gap", "pair v_body,v_wheel", "travel"),),
        ),
        Effect("skyhook", "quadratic", "der(v_body)", (-1.5,), "v_body"),
        Effect("guide_friction", "coulomb", "der(v_body)", (-0.25, 3e-4), "v_body"),
        Effect("slow_leak", "drift", "parameter k_tyre", (-0.06, 2.5)),
        Effect("damper_fade", "heating", "parameter c_damper", (-2.0, 1.5, 0.03), "v_body"),
        Effect("camera_delay", "delay", "input road", (0.012,)),
        Effect("road_lag", "lag", "input road", (0.008,)),
        Effect("velocity_lag", "lag", "output velocity", (0.015,)),
        Effect("travel_bias", "bias", "output travel", (0.004,)),
        Effect("travel_clips", "saturation", "output travel", (0.025,)),
        Effect("travel_gain", "gain", "output travel", (0.06,)),
        Effect("travel_kink", "absolute", "output travel", (0.08,)),
    ),
}

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "mass_spring_damper": (("coulomb", "stiffening"), ("drag", "sensor_lag"), ("load", "end_stop")),
    "pendulum": (
        ("coulomb", "sensor_bias"),
        ("coulomb", "drag"),
        ("drag", "delay"),
        ("end_stop", "unbalance"),
    ),
    "quarter_car": (("bump_stop", "velocity_lag"), ("slow_leak", "travel_bias")),
}

OUTSIDE: dict[str, tuple[Effect, ...]] = {
    "mass_spring_damper": (
        Effect("placed_friction", "placed_friction", "der(v)", (-0.5, 0.002, 12.0), "v", "x"),
        Effect("slew", "rate_limit", "input F", (12.0,)),
        Effect("coarse_sensor", "quantisation", "output y", (0.05,)),
        Effect("bristle", "bristle", "der(v)", (-0.5, 0.01, 0.8, 0.3), "v"),
    ),
    "pendulum": (
        Effect("magnet", "magnet", "der(speed)", (-9.0, 0.15), "angle"),
        Effect("slew", "rate_limit", "input torque", (1.0,)),
        Effect("sampled_drive", "sample_hold", "input torque", (0.24,)),
    ),
    "quarter_car": (
        Effect(
            "one_way_damper",
            "one_way",
            "pair v_body,v_wheel",
            (-900.0, 0.15),
            "v_body-v_wheel",
            weights=(1.0 / 300.0, -1.0 / 36.0),
        ),
        Effect("tyre_lifts", "hinge", "der(v_wheel)", (4.7e3, 0.012), "z_wheel-road"),
        Effect("coarse_travel", "quantisation", "output travel", (0.008,)),
    ),
}
