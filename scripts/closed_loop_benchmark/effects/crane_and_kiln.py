"""Effects for the gantry crane and the kiln, from textbooks of mechanics and of heat transfer.

Friction, contact and play after J. Awrejcewicz, P. Olejnik, Appl. Mech. Rev. 58 (2005) 389-411,
doi:10.1115/1.2048687; radiation, natural convection and capacities that depend on the temperature
after T. L. Bergman et al., Fundamentals of Heat and Mass Transfer.
"""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect, Name

STEFAN_BOLTZMANN = 5.67e-8

TEXTBOOK: dict[str, tuple[Effect, ...]] = {
    "gantry_crane": (
        # At the driven port: one force on the trolley, which moves the load too.
        Effect("rail_friction", "coulomb", "input F", (-4.0, 1.5e-3), "v"),
        Effect("uneven_rail_friction", "two_levels", "input F", (-3.0, 1.5e-3, 1.8), "v"),
        Effect(
            "motor_drag",
            "quadratic",
            "input F",
            (-5.0,),
            "v",
            also=(Name("magnitude", "parameter b_trolley", "v"),),
        ),
        Effect("sloping_rail", "bias", "input F", (2.5,)),
        Effect("wavy_rail", "periodic", "input F", (3.0, 9.0, 0.4), "x"),
        Effect("buffer", "contact", "input F", (-250.0, 0.1), "x"),
        Effect("weak_motor", "saturation", "input F", (10.0,)),
        Effect("torque_loop", "mode", "input F", (1.0, 4.0, 0.4)),
        Effect("command_delay", "delay", "input F", (0.05,)),
        Effect("stiff_brushes", "dead_zone", "input F", (1.2,)),
        Effect("wind_on_load", "quadratic", "der(w)", (-0.25,), "w"),
        Effect("dry_pivot", "inverse", "parameter d_pivot", (0.8, 0.25), "w"),
        Effect("leaking_load", "drift", "parameter m_load", (-0.04, 5.0)),
        Effect("angle_filter", "mode", "output angle", (1.0, 3.0, 0.7)),
        Effect("angle_lens", "cubic", "output angle", (0.8,)),
    ),
    "kiln": (
        Effect(
            "radiation",
            "fourth_powers",
            "der(T_plate)",
            (-0.05 * STEFAN_BOLTZMANN / 400.0,),
            "T_plate",
            "T_ambient",
        ),
        Effect(
            "radiation_between",
            "fourth_powers",
            "pair T_plate,T_charge",
            (-0.04 * STEFAN_BOLTZMANN,),
            "T_plate",
            "T_charge",
            weights=(1.0 / 400.0, -1.0 / 900.0),
        ),
        Effect(
            "natural_convection", "power", "der(T_charge)", (-1.5e-4, 1.25), "T_charge-T_ambient"
        ),
        Effect("drying", "exponential", "der(T_charge)", (-0.02, 80.0, 293.0), "T_charge"),
        Effect("ventilator", "hinge", "der(T_charge)", (-4e-3, 430.0), "T_charge"),
        Effect("capacity_rises", "linear", "parameter C_charge", (8e-4, 400.0), "T_charge"),
        Effect("phase_change", "bell", "parameter C_charge", (2.0, 430.0, 25.0), "T_charge"),
        Effect("capacity_saturates", "saturating", "parameter C_plate", (0.9, 300.0), "T_plate"),
        Effect("gas_conducts", "linear", "parameter G_between", (6e-4, 450.0), "T_plate"),
        Effect("insulation_ages", "drift", "parameter G_plate", (8e-5, 2000.0)),
        Effect("element_resistance", "product", "input power", (-2e-4,), "T_plate"),
        Effect("power_control", "power", "input power", (0.12, 1000.0)),
        Effect("weak_mains", "saturation", "input power", (1350.0,)),
        Effect("thick_thermocouple", "lag", "output charge", (45.0,)),
        Effect("sheath_radiation", "feed_through", "output charge", (0.03,), "T_plate"),
    ),
}
