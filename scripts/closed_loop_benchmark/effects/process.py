"""Effects for the cascaded tanks, the stirred tank and the battery."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect, Name

SINGLE: dict[str, tuple[Effect, ...]] = {
    "cascaded_tanks": (
        Effect("overflow", "hinge", "der(h1)", (-0.03, 5.0), "h1"),
        Effect("lower_overflow", "hinge", "der(h2)", (-0.03, 5.5), "h2"),
        Effect("seepage", "linear", "der(h2)", (-0.0015,), "h2"),
        Effect("spill_over", "product", "der(h2)", (0.001,), "h1", "u"),
        Effect("spring", "constant", "der(h2)", (0.015,)),
        Effect("dead_zone", "dead_zone", "input u", (0.4,)),
        Effect("saturation", "saturation", "input u", (2.6,)),
        Effect("pump_lag", "lag", "input u", (16.0,)),
        Effect("pump_delay", "delay", "input u", (10.0,)),
        Effect(
            "pump_curve", "square", "input u", (0.06,), also=(Name("linear", "parameter kp", "u"),)
        ),
        Effect("sensor_lag", "lag", "output y", (16.0,)),
        Effect("sensor_clips", "saturation", "output y", (6.0,)),
        Effect("clogging", "drift", "parameter k2", (-2e-4, 800.0)),
    ),
    "stirred_tank_reactor": (
        Effect("heat_loss", "linear", "der(T)", (-2e-4,), "T"),
        Effect("side_reaction", "square", "der(c)", (-3e-6,), "c"),
        Effect("fouling", "drift", "parameter cooling", (-1.5e-4, 1000.0)),
        Effect("catalyst_decays", "drift", "parameter k_350", (-1e-4, 1000.0)),
        Effect("better_stirred", "linear", "parameter cooling", (250.0, 1.6e-3), "flow"),
        Effect("flow_delay", "delay", "input flow", (12.0,)),
        Effect("flow_lag", "lag", "input flow", (15.0,)),
        Effect("flow_backlash", "backlash", "input flow", (8e-5,)),
        Effect("coolant_lag", "lag", "input T_coolant", (25.0,)),
        Effect("temperature_lag", "lag", "output temperature", (15.0,)),
        Effect("concentration_bias", "bias", "output concentration", (15.0,)),
        Effect("analyser_delay", "delay", "output concentration", (20.0,)),
    ),
    "battery": (
        Effect(
            "current_bias",
            "bias",
            "input current",
            (0.05,),
        ),
        Effect("charging_loss", "asymmetry", "input current", (0.06,)),
        Effect("saturation", "saturation", "input current", (1.3,)),
        Effect("logger_delay", "delay", "input current", (12.0,)),
        Effect("slow_branch", "lagged_feed_through", "output voltage", (-0.02, 400.0), "current"),
        Effect("hysteresis", "hysteresis", "output voltage", (-0.012, 250.0), "current"),
        Effect("voltage_bias", "bias", "output voltage", (0.04,)),
        Effect("voltage_drift", "drift", "output voltage", (8e-6,)),
        Effect("R0_of_charge", "linear", "parameter R0", (-0.8, 0.6), "soc"),
        Effect("R0_heats", "heating", "parameter R0", (-0.2, 500.0, 1.0), "current"),
        Effect("R1_of_current", "magnitude", "parameter R1", (-0.3, 1.0), "current"),
        Effect("tired", "drift", "parameter R0", (6e-5, 2000.0)),
    ),
}

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "cascaded_tanks": (
        ("overflow", "dead_zone"),
        ("seepage", "pump_delay"),
        ("spring", "saturation"),
    ),
    "stirred_tank_reactor": (("fouling", "concentration_bias"), ("heat_loss", "flow_delay")),
    "battery": (("hysteresis", "voltage_bias"), ("R0_of_charge", "logger_delay")),
}

OUTSIDE: dict[str, tuple[Effect, ...]] = {
    "cascaded_tanks": (
        Effect("slew", "rate_limit", "input u", (0.02,)),
        Effect("coarse_level", "quantisation", "output y", (0.8,)),
        Effect("valve_jumps", "switch", "parameter k2", (-0.12, 600.0)),
    ),
    "stirred_tank_reactor": (
        Effect("hot_spots", "wave", "der(T)", (0.06, 1.1), "T"),
        Effect("chromatograph", "sample_hold", "output concentration", (60.0,)),
    ),
    "battery": (
        Effect("warburg", "warburg", "output voltage", (-0.012, 60.0), "current"),
        Effect("slew", "rate_limit", "input current", (0.02,)),
        Effect("ocv_steps", "wave", "output voltage", (0.015, 40.0), "soc"),
    ),
}
