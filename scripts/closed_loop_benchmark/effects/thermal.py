"""Effects for the heated core and the room."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect

SINGLE: dict[str, tuple[Effect, ...]] = {
    "thermal_two_node": (
        Effect("self_heating", "bias", "input P", (0.8,)),
        Effect("saturation", "saturation", "input P", (9.0,)),
        Effect("heater_lag", "lag", "input P", (40.0,)),
        Effect("heater_delay", "delay", "input P", (30.0,)),
        Effect("warm_corner", "lag", "input T_ambient", (300.0,)),
        Effect(
            "convection",
            "linear",
            "parameter R_case_ambient",
            (-0.01, 40.0),
            "T_case",
        ),
        Effect("dust", "drift", "parameter R_case_ambient", (8e-5, 2000.0)),
        Effect("paste_dries", "drift", "parameter R_core_case", (8e-5, 2000.0)),
        Effect("core_sensor_lag", "lag", "output y_core", (20.0,)),
        Effect("case_sensor_bias", "bias", "output y_case", (1.0,)),
        Effect("case_sensor_gain", "gain", "output y_case", (0.03,)),
    ),
    "room": (
        Effect("sun", "linear", "der(T_room)", (3e-7,), "sun"),
        Effect("sun_on_floor", "lagged", "der(T_room)", (3e-7, 7200.0), "sun"),
        Effect("sun_on_wall", "linear", "der(T_wall)", (1.5e-7,), "sun"),
        Effect("people", "constant", "der(T_room)", (6e-5,)),
        Effect("window_opens", "hinge", "der(T_room)", (-1.2e-4, 21.5), "T_room"),
        Effect("habits", "sine", "der(T_room)", (4e-5, 1.0 / 86400.0, 0.5)),
        Effect("infiltration", "linear", "der(T_room)", (6e-6,), "T_out"),
        Effect("saturation", "saturation", "input P", (2000.0,)),
        Effect("heater_lag", "lag", "input P", (2400.0,)),
        Effect("heater_delay", "delay", "input P", (1200.0,)),
        Effect("sensor_lag", "lag", "output y", (1200.0,)),
        Effect("sensor_drift", "drift", "output y", (3e-6,)),
        Effect("damp_wall", "drift", "parameter R_wall_out", (-1.5e-6, 180000.0)),
        Effect("convection", "linear", "parameter R_room_wall", (-0.04, 20.0), "T_room"),
    ),
}

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "thermal_two_node": (("self_heating", "core_sensor_lag"), ("convection", "heater_delay")),
    "room": (("sun", "heater_lag"), ("people", "sensor_lag"), ("window_opens", "saturation")),
}

OUTSIDE: dict[str, tuple[Effect, ...]] = {
    "thermal_two_node": (
        Effect("door_opens", "switch", "parameter R_case_ambient", (-0.2, 1800.0)),
        Effect("slow_logger", "sample_hold", "output y_core", (60.0,)),
    ),
    "room": (
        Effect("thermostat", "wave", "der(T_room)", (6e-5, 2.5), "T_room"),
        Effect("coarse_sensor", "quantisation", "output y", (1.0,)),
        Effect("blinds", "magnet", "der(T_room)", (6e-7, 250.0), "sun"),
    ),
}
