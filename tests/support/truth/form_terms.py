"""What each form of the library is, written down again: as terms of the springs' equations.

Without an effect |x| stays below 0.19 and |v| below 0.97; the coefficients keep the motion bounded.
A form that is not in one of the tables has a test of its own, which `OWN_TESTS` names.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from support.truth.springs_with_effects import FORCE, TIMES

TABLE = (1.0, 0.8, 0.9, -0.1, -0.6, -0.5, -1.2)
"""Seven values of a curve."""


def heights(values: int) -> tuple[float, ...]:
    """Return the values of a curve of so many."""
    return TABLE if values == 7 else tuple(np.cos(0.4 * np.arange(values)).tolist())


CURVES = {"": 7, "_13": 13, "_25": 25}
"""Ends of their names and number of values."""


def curve(v: float, low: float, high: float, values: tuple[float, ...]) -> float:
    """Return straight lines between values at equal steps, constant beyond."""
    return float(np.interp(v, np.linspace(low, high, len(values)), values))


def _pinned(values: int) -> tuple[float, ...]:
    """Return the values of a curve that is 0 at its ends."""
    return (0.0, *heights(values)[1:-1], 0.0)


def _centred(values: int) -> tuple[float, ...]:
    """Return the values of a curve that is 0 in the middle."""
    own, middle = heights(values), values // 2
    return (*own[:middle], 0.0, *own[middle + 1 :])


DERIVATIVE = (
    {
        "constant": ((0.5,), (), lambda t, x, f: 0.5),
        "drift": ((0.2,), (), lambda t, x, f: 0.2 * t),
        "sine": ((0.3, 0.2, 7.0), (), lambda t, x, f: 0.3 * np.sin(7 * t) + 0.2 * np.cos(7 * t)),
        "viscous": ((0.5,), (), lambda t, x, f: -0.5 * x[1]),
        "quadratic": ((0.7,), (), lambda t, x, f: -0.7 * x[1] * abs(x[1])),
        "cubic": ((0.7,), (), lambda t, x, f: -0.7 * x[1] ** 3),
        "power": (
            (0.5, 1.4, 0.9),
            (),
            lambda t, x, f: -0.5 * np.sign(x[1]) * (abs(x[1]) / 0.9) ** 1.4,
        ),
        "radiation": (
            (0.05, 0.3),
            ("v", "F"),
            lambda t, x, f: -0.05 * ((x[1] + 0.3) ** 4 - (f + 0.3) ** 4),
        ),
        "exponential": (
            (0.4, 0.2, 0.1),
            ("x",),
            lambda t, x, f: 0.4 * np.exp((x[0] - 0.2) / 0.1),
        ),
        "contact": (
            (-2.0, 0.05, 1.5, 0.1),
            ("x",),
            lambda t, x, f: -2.0 * (max(x[0] - 0.05, 0.0) / 0.1) ** 1.5,
        ),
        "coulomb": ((0.5, 0.05), (), lambda t, x, f: -0.5 * np.tanh(x[1] / 0.05)),
        "load_dependent_coulomb": (
            (4.0, 0.05),
            ("v", "x"),
            lambda t, x, f: -4.0 * abs(x[0]) * np.tanh(x[1] / 0.05),
        ),
        "stribeck": (
            (0.5, 0.4, 0.1, 0.05),
            (),
            lambda t, x, f: -(0.5 + 0.4 * np.exp(-((x[1] / 0.1) ** 2))) * np.tanh(x[1] / 0.05),
        ),
        "asymmetric_coulomb": (
            (0.5, 0.2, 0.05),
            (),
            lambda t, x, f: -(0.5 if x[1] > 0.0 else 0.2) * np.tanh(x[1] / 0.05),
        ),
        "periodic": (
            (0.3, 0.2, 40.0),
            ("x",),
            lambda t, x, f: 0.3 * np.sin(40.0 * x[0]) + 0.2 * np.cos(40.0 * x[0]),
        ),
        "linear": ((-4.0,), ("x",), lambda t, x, f: -4.0 * x[0]),
        "saturating": ((-2.0, 0.05), ("x",), lambda t, x, f: -2.0 * x[0] / (0.05 + abs(x[0]))),
        "square": ((9.0,), ("x",), lambda t, x, f: 9.0 * x[0] ** 2),
        "product": ((0.1,), ("x", "F"), lambda t, x, f: 0.1 * x[0] * f),
        "hinge": ((-50.0, 0.05), ("x",), lambda t, x, f: -50.0 * max(x[0] - 0.05, 0.0)),
        "hinge_below": ((50.0, 0.02), ("x",), lambda t, x, f: 50.0 * max(0.02 - x[0], 0.0)),
        "gap": (
            (40.0, 0.04),
            ("x",),
            lambda t, x, f: -40.0 * (max(x[0] - 0.04, 0.0) - max(-x[0] - 0.04, 0.0)),
        ),
        "square_root": ((0.5,), ("x",), lambda t, x, f: -0.5 * np.sqrt(max(x[0], 0.0))),
        "signed_root": ((0.5,), ("F",), lambda t, x, f: -0.5 * np.sign(f) * np.sqrt(abs(f))),
    }
    | {
        f"table{end}": (
            (*heights(n), -0.2, 0.3),
            (),
            lambda t, x, f, n=n: curve(x[1], -0.2, 0.3, heights(n)),
        )
        for end, n in CURVES.items()
    }
    | {
        f"coulomb_table{end}": (
            (*heights(n), -0.05, 0.1, 0.05),
            ("v", "x"),
            lambda t, x, f, n=n: -curve(x[0], -0.05, 0.1, heights(n)) * np.tanh(x[1] / 0.05),
        )
        for end, n in CURVES.items()
    }
)
"""At der(v): coefficients, variables, and the term as a function of time, states and force."""


INPUT = {
    "bias": ((0.5,), lambda t, f: f + 0.5),
    "drift": ((0.2,), lambda t, f: f + 0.2 * t),
    "gain": ((0.2,), lambda t, f: 1.2 * f),
    "square": ((0.1,), lambda t, f: f + 0.1 * f**2),
    "cubic": ((0.05,), lambda t, f: f + 0.05 * f**3),
    "power_characteristic": (
        (1.4, 2.0),
        lambda t, f: 2.0 * np.sign(f) * (abs(f) / 2.0) ** 1.4,
    ),
    "saturating": ((0.2,), lambda t, f: f / (1.0 + 0.2 * abs(f))),
    "asymmetry": ((0.3,), lambda t, f: f + 0.3 * max(f, 0.0)),
    "saturation": ((2.0,), lambda t, f: min(max(f, -2.0), 2.0)),
    "dead_zone": ((1.0,), lambda t, f: f - np.sign(f) if abs(f) > 1.0 else 0.0),
} | {
    f"characteristic{end}": (
        (*heights(n)[1:-1], -4.0, 3.0),
        lambda t, f, n=n: f + curve(f, -4.0, 3.0, _pinned(n)),
    )
    for end, n in CURVES.items()
}
"""At the input F: coefficients, and what takes its place at a time."""


FORCES = {
    "viscous": ((0.5,), "v", lambda x, f: -0.5 * x[1]),
    "quadratic": ((0.7,), "v", lambda x, f: -0.7 * x[1] * abs(x[1])),
    "power": (
        (0.5, 1.4, 0.9),
        "v",
        lambda x, f: -0.5 * np.sign(x[1]) * (abs(x[1]) / 0.9) ** 1.4,
    ),
    "coulomb": ((0.5, 0.05), "v", lambda x, f: -0.5 * np.tanh(x[1] / 0.05)),
    "stribeck": (
        (0.5, 0.4, 0.1, 0.05),
        "v",
        lambda x, f: -(0.5 + 0.4 * np.exp(-((x[1] / 0.1) ** 2))) * np.tanh(x[1] / 0.05),
    ),
    "asymmetric_coulomb": (
        (0.5, 0.2, 0.05),
        "v",
        lambda x, f: -(0.5 if x[1] > 0.0 else 0.2) * np.tanh(x[1] / 0.05),
    ),
    "linear": ((-4.0,), "x", lambda x, f: -4.0 * x[0]),
    "product": ((0.8,), "x", lambda x, f: 0.8 * f * x[0]),
    "periodic": (
        (0.3, 0.2, 40.0),
        "x",
        lambda x, f: 0.3 * np.sin(40.0 * x[0]) + 0.2 * np.cos(40.0 * x[0]),
    ),
    "hinge": ((-50.0, 0.05), "x", lambda x, f: -50.0 * max(x[0] - 0.05, 0.0)),
    "contact": (
        (-2.0, 0.05, 1.5, 0.1),
        "x",
        lambda x, f: -2.0 * (max(x[0] - 0.05, 0.0) / 0.1) ** 1.5,
    ),
    "hinge_below": ((50.0, 0.02), "x", lambda x, f: 50.0 * max(0.02 - x[0], 0.0)),
    "gap": (
        (40.0, 0.04),
        "x",
        lambda x, f: -40.0 * (max(x[0] - 0.04, 0.0) - max(-x[0] - 0.04, 0.0)),
    ),
    "signed_root": ((0.5,), "F", lambda x, f: -0.5 * np.sign(f) * np.sqrt(abs(f))),
} | {
    f"table{end}": (
        (*heights(n), -0.2, 0.3),
        "x",
        lambda x, f, n=n: curve(x[0], -0.2, 0.3, heights(n)),
    )
    for end, n in CURVES.items()
}
"""At the input F: coefficients, the variable, and what is added to it."""


OUTPUT = {
    "bias": ((0.02,), (), lambda y, v: y + 0.02),
    "drift": ((0.02,), (), lambda y, v: y + 0.02 * TIMES),
    "gain": ((0.1,), (), lambda y, v: 1.1 * y),
    "square": ((2.0,), (), lambda y, v: y + 2.0 * y**2),
    "cubic": ((9.0,), (), lambda y, v: y + 9.0 * y**3),
    "power_characteristic": (
        (1.4, 0.1),
        (),
        lambda y, v: 0.1 * np.sign(y) * (abs(y) / 0.1) ** 1.4,
    ),
    "saturating": ((2.0,), (), lambda y, v: y / (1.0 + 2.0 * abs(y))),
    "saturation": ((0.1,), (), lambda y, v: np.clip(y, -0.1, 0.1)),
    "clip_above": ((0.04,), (), lambda y, v: np.minimum(y, 0.04)),
    "clip_below": ((-0.03,), (), lambda y, v: np.maximum(y, -0.03)),
    "absolute": ((0.3,), (), lambda y, v: y + 0.3 * abs(y)),
    "quadratic": ((0.4,), ("v",), lambda y, v: y + 0.4 * v * abs(v)),
    "power": ((0.4, 1.4, 0.9), ("v",), lambda y, v: y + 0.4 * np.sign(v) * (abs(v) / 0.9) ** 1.4),
    "coulomb": ((0.4, 0.05), ("v",), lambda y, v: y + 0.4 * np.tanh(v / 0.05)),
    "stribeck": (
        (0.5, 0.4, 0.1, 0.05),
        ("v",),
        lambda y, v: y + (0.5 + 0.4 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.05),
    ),
    "asymmetric_coulomb": (
        (0.5, 0.2, 0.05),
        ("v",),
        lambda y, v: y + np.where(v > 0.0, 0.5, 0.2) * np.tanh(v / 0.05),
    ),
    "product": ((0.8,), ("v", "v"), lambda y, v: y + 0.8 * v * v),
    "exponential": ((0.3, 0.1, 0.2), ("v",), lambda y, v: y + 0.3 * np.exp((v - 0.1) / 0.2)),
    "hinge": ((0.7, 0.05), ("v",), lambda y, v: y + 0.7 * np.maximum(v - 0.05, 0.0)),
    "hinge_below": ((0.7, 0.05), ("v",), lambda y, v: y + 0.7 * np.maximum(0.05 - v, 0.0)),
    "signed_root": ((0.5,), ("v",), lambda y, v: y + 0.5 * np.sign(v) * np.sqrt(abs(v))),
    "square_feed_through": ((0.6,), ("v",), lambda y, v: y + 0.6 * v**2),
    "cubic_feed_through": ((0.6,), ("v",), lambda y, v: y + 0.6 * v**3),
    "hum": (
        (0.03, 0.02, 7.0),
        (),
        lambda y, v: y + 0.03 * np.sin(7.0 * TIMES) + 0.02 * np.cos(7.0 * TIMES),
    ),
} | {
    f"{name}{end}": law
    for end, n in CURVES.items()
    for name, law in {
        "characteristic": (
            (*heights(n)[1:-1], -0.2, 0.3),
            (),
            lambda y, v, n=n: y + np.interp(y, np.linspace(-0.2, 0.3, n), _pinned(n)),
        ),
        "table": (
            (*heights(n), -0.2, 0.3),
            ("v",),
            lambda y, v, n=n: y + np.interp(v, np.linspace(-0.2, 0.3, n), heights(n)),
        ),
    }.items()
}
"""At the output y: coefficients, variables, and what is shown of y and v."""

OUTPUT_OF_OTHERS = {
    "F": ((0.01,), ("F",), lambda y, v: y + 0.01 * FORCE),
    "v": ((0.01,), ("v",), lambda y, v: y + 0.01 * v),
}
"""`feed_through` of an input and of a state."""


PARAMETER = {
    "drift": ((0.8, 2.0), (), lambda t, v: 0.8 * (t - 2.0)),
    "sine": ((0.4, -0.2, 3.0), (), lambda t, v: 0.4 * np.sin(3.0 * t) - 0.2 * np.cos(3.0 * t)),
    "linear": ((0.9, 0.1), ("v",), lambda t, v: 0.9 * (v - 0.1)),
    "magnitude": ((0.9, 0.1), ("v",), lambda t, v: 0.9 * (abs(v) - 0.1)),
    "square": ((3.0, 0.02), ("v",), lambda t, v: 3.0 * (v**2 - 0.02)),
    "inverse": ((0.5, 0.1), ("v",), lambda t, v: 1.0 / (1.0 + 0.5 * (v - 0.1)) - 1.0),
    "inverse_square": (
        (3.0, 0.02),
        ("v",),
        lambda t, v: 1.0 / (1.0 + 3.0 * (v**2 - 0.02)) - 1.0,
    ),
    "power": ((0.5, 0.1), ("v",), lambda t, v: (abs(v) / 0.1) ** 0.5 - 1.0),
    "exponential": ((1.5, 0.1), ("v",), lambda t, v: np.exp(1.5 * (v - 0.1)) - 1.0),
    "saturating": ((0.8, 0.1), ("v",), lambda t, v: -0.8 * abs(v) / (0.1 + abs(v))),
    "hill": ((0.8, 0.1), ("v",), lambda t, v: -0.8 * (v / 0.1) ** 2 / (1.0 + (v / 0.1) ** 2)),
} | {
    f"table{end}": (
        (*heights(n)[: n // 2], *heights(n)[n // 2 + 1 :], -0.2, 0.3),
        ("v",),
        lambda t, v, n=n: curve(v, -0.2, 0.3, _centred(n)),
    )
    for end, n in CURVES.items()
}
"""At the parameter c: coefficients, variables, and the share of itself that is added to it."""

TRAVEL = ("z_body - z_wheel",)
PAIR = {
    "joint": ((30.0, 220.0, 0.01), TRAVEL, lambda v: np.clip(v, -0.01, 0.01)),
    "gap": ((30.0, 220.0, 0.01), TRAVEL, lambda v: v - np.clip(v, -0.01, 0.01)),
    "hinge": ((30.0, 220.0, 0.005), TRAVEL, lambda v: max(v - 0.005, 0.0)),
    "hinge_below": ((30.0, 220.0, -0.005), TRAVEL, lambda v: min(v + 0.005, 0.0)),
    "overflow": ((30.0, 220.0, 0.01), TRAVEL, lambda v: max(v - 0.01, 0.0)),
    "linear": ((2.0, 15.0), (), lambda v: v),
    "quadratic": ((2.0, 15.0), (), lambda v: v * abs(v)),
    "cubic": ((2e3, 15e3), TRAVEL, lambda v: v**3),
    "power": (
        (0.02, 0.15, 1.4, 0.05),
        TRAVEL,
        lambda v: np.sign(v) * (abs(v) / 0.05) ** 1.4,
    ),
    "radiation": (
        (3e3, 2e4, 0.2),
        ("z_body", "z_wheel"),
        lambda v: (v[0] + 0.2) ** 4 - (v[1] + 0.2) ** 4,
    ),
    "coulomb": ((0.3, 2.2, 0.05), (), lambda v: np.tanh(v / 0.05)),
    "leak": ((1.0, 7.5), ("v_wheel",), lambda v: np.sign(v) * np.sqrt(abs(v))),
}
"""Between the masses of a quarter car: coefficients, variables, and the law of the force."""

OWN_TESTS = {
    ("derivative", "dahl"): "test_dahl_friction_has_a_state_of_its_own",
    ("derivative", "lagged"): "test_a_lagged_coupling_has_a_state_of_its_own",
    ("derivative", "periodic_travel"): "test_a_ripple_of_the_way_travelled_begins_at_nought",
    ("pair", "table"): "test_a_curve_between_two_states_acts_on_both_in_proportion",
    ("pair", "table_13"): "test_a_curve_between_two_states_acts_on_both_in_proportion",
    ("pair", "table_25"): "test_a_curve_between_two_states_acts_on_both_in_proportion",
    ("input", "dahl"): "test_dahl_friction_at_an_input",
    ("input", "lag"): "test_a_lag_of_an_input",
    ("input", "mode"): "test_an_actuator_that_swings",
    ("input", "lag_from_rest"): "test_actuators_that_begin_at_rest",
    ("input", "mode_from_rest"): "test_actuators_that_begin_at_rest",
    ("output", "mode"): "test_a_sensor_that_swings",
    ("input", "delay"): "test_a_delay_of_an_input",
    ("output", "delay"): "test_a_delay_of_an_output",
    ("input", "backlash"): "test_backlash_at_an_input",
    ("input", "rate_limit"): "test_a_limited_rate_of_an_input",
    ("input", "rate_limit_from_rest"): "test_a_limited_rate_of_an_input",
    ("output", "lag"): "test_a_lag_of_an_output",
    ("output", "lagged_feed_through"): "test_an_output_that_shows_a_lagged_state",
    ("output", "hysteresis"): "test_hysteresis_of_a_sensor",
    ("parameter", "heating"): "test_a_parameter_that_heats_up",
}
"""Forms with memory, or that need more than a term: their tests in `tests/integration/effects`."""


def forms_with_a_truth() -> set[tuple[str, str]]:
    """Return kind and name of every form that a table or a test of its own has."""
    tables: dict[str, tuple[Iterable[str], ...]] = {
        "derivative": (DERIVATIVE,),
        "pair": (PAIR,),
        "input": (INPUT, FORCES),
        "output": (OUTPUT, ("feed_through",)),
        "parameter": (PARAMETER,),
    }
    listed = {(kind, form) for kind, all_of in tables.items() for table in all_of for form in table}
    return listed | set(OWN_TESTS)
