"""Effects that act at once, by their labels in a system."""

from __future__ import annotations

TEXTBOOK_PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    "gantry_crane": (
        ("rail_friction", "wind_on_load"),
        ("motor_drag", "command_delay"),
        ("wavy_rail", "angle_lens"),
    ),
    "kiln": (("radiation", "thick_thermocouple"), ("drying", "weak_mains")),
    "pharmacokinetics": (
        ("saturable_elimination", "lag_time"),
        ("self_inhibition", "assay_blank"),
        ("recirculation", "stomach"),
    ),
    "chemostat": (
        ("substrate_inhibits", "maintenance"),
        ("decay", "probe_lag"),
        ("crowding", "optical_density"),
    ),
    "hydraulic_cylinder": (
        ("laminar_leak", "seal_friction"),
        ("overlap", "pressure_line"),
        ("weight", "hardening_spring"),
    ),
    "resonant_circuit": (
        ("dead_time", "ceramic"),
        ("clamp", "current_probe"),
        ("core_saturates", "dielectric_absorption"),
    ),
}

TRIPLES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "mass_spring_damper": (("coulomb", "stiffening", "sensor_lag"), ("load", "end_stop", "delay")),
    "pendulum": (("coulomb", "end_stop", "sensor_bias"),),
    "dc_motor": (("coulomb", "current_bias", "delay"), ("fan", "dead_zone", "speed_lag")),
    "dc_motor_belt": (("load_coulomb", "saturation", "speed_bias"),),
    "cascaded_tanks": (("overflow", "dead_zone", "sensor_lag"),),
    "room": (("sun", "people", "sensor_lag"),),
    "battery": (("hysteresis", "voltage_bias", "R0_of_charge"),),
    "quarter_car": (("bump_stop", "velocity_lag", "travel_bias"),),
    "two_mass_drive": (("load_coulomb", "shaft_stops", "delay"),),
    "stirred_tank_reactor": (("heat_loss", "flow_delay", "concentration_bias"),),
    "gantry_crane": (("rail_friction", "command_delay", "angle_lens"),),
    "kiln": (("radiation", "drying", "thick_thermocouple"),),
    "pharmacokinetics": (("saturable_elimination", "lag_time", "assay_blank"),),
    "chemostat": (("substrate_inhibits", "maintenance", "probe_lag"),),
    "hydraulic_cylinder": (("laminar_leak", "seal_friction", "overlap"),),
    "resonant_circuit": (("dead_time", "ceramic", "current_probe"),),
}
