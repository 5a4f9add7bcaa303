"""What each form of the library is, written down again: as terms of the springs' equations.

Without an effect |x| stays below 0.19 and |v| below 0.97; the coefficients keep the motion bounded.
A form that is not in one of the tables has a test of its own, which `OWN_TESTS` names.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np
from support.truth.springs_with_effects import (
    FORCE,
    START,
    TIMES,
    C,
    M,
    Slope,
    late_states,
    plain,
    pushed,
    solve,
)

TABLE = (1.0, 0.8, 0.9, -0.1, -0.6, -0.5, -1.2)
"""Seven values of a curve."""
CURVES = {"": TABLE} | {f"_{n}": tuple(np.cos(0.4 * np.arange(n)).tolist()) for n in (13, 25)}
"""Ends of their names and values."""


def curve(v: Any, low: float, high: float, values: tuple[float, ...]) -> Any:
    """Return straight lines between values at equal steps, constant beyond."""
    return np.interp(v, np.linspace(low, high, len(values)), values)


def _table(v: Any, *c: float) -> Any:
    return curve(v, c[-2], c[-1], c[:-2])


def _pinned(s: Any, t: Any, *c: float) -> Any:
    """A signal with a curve added that is 0 at its ends."""
    return s + curve(s, c[-2], c[-1], (0.0, *c[:-2], 0.0))


def _stribeck(v: Any, k: float, peak: float, vs: float, width: float) -> Any:
    return -(k + peak * np.exp(-((v / vs) ** 2))) * np.tanh(v / width)


def _asymmetric(v: Any, forward: float, backward: float, width: float) -> Any:
    return -np.where(v > 0.0, forward, backward) * np.tanh(v / width)


def _contact(v: Any, k: float, at: float, n: float, ref: float) -> Any:
    return k * (np.maximum(v - at, 0.0) / ref) ** n


def _gap(v: Any, k: float, at: float) -> Any:
    return -k * (np.maximum(v - at, 0.0) - np.maximum(-v - at, 0.0))


def _sigmoid(v: Any, half: float, n: float) -> Any:
    """Of Hill: nothing at values that are no amounts."""
    return 1.0 / (1.0 + (half / np.maximum(v, 1e-30)) ** n)


def _cut(s: Any, t: Any, k: float, width: float) -> Any:
    return s / (1.0 + np.exp(-2.0 * (abs(s) - k) / width))


def _powers(v: Any, w: Any, k: float, m: float, n: float, ref: float, other: float) -> Any:
    return k * np.sign(v) * abs(v / ref) ** m * abs(w / other) ** n


def _activated(v: Any, k: float, energy: float, at: float, zero: float) -> Any:
    return k * np.exp(energy / (at + zero)) / np.exp(energy / (v + zero))


def _fourth_powers(v: Any, w: Any, k: float, zero: float) -> Any:
    return -k * ((v + zero) ** 4 - (w + zero) ** 4)


DERIVATIVE: dict[str, tuple[tuple[float, ...], str, Callable[..., Any]]] = {
    "constant": ((0.5,), "t", lambda t, k: k),
    "drift": ((0.2,), "t", lambda t, k: k * t),
    "sine": ((0.3, 0.2, 7.0), "t", lambda t, a, b, f: a * np.sin(f * t) + b * np.cos(f * t)),
    "periodic": ((0.3, 0.2, 40.0), "x", lambda v, a, b, n: a * np.sin(n * v) + b * np.cos(n * v)),
    "viscous": ((0.5,), "", lambda v, k: -k * v),
    "quadratic": ((0.7,), "", lambda v, k: -k * v * abs(v)),
    "cubic": ((0.7,), "", lambda v, k: -k * v**3),
    "power": ((0.5, 1.4, 0.9), "", lambda v, k, n, ref: -k * np.sign(v) * (abs(v) / ref) ** n),
    "radiation": ((0.05, 0.3), "v F", _fourth_powers),
    "exponential": ((0.4, 0.2, 0.1), "x", lambda v, k, at, width: k * np.exp((v - at) / width)),
    "contact": ((-2.0, 0.05, 1.5, 0.1), "x", _contact),
    "coulomb": ((0.5, 0.05), "", lambda v, k, w: -k * np.tanh(v / w)),
    "load_dependent_coulomb": ((4.0, 0.05), "v x", lambda v, p, k, w: -k * abs(p) * np.tanh(v / w)),
    "stribeck": ((0.5, 0.4, 0.1, 0.05), "", _stribeck),
    "asymmetric_coulomb": ((0.5, 0.2, 0.05), "", _asymmetric),
    "linear": ((-4.0,), "x", lambda v, k: k * v),
    "saturating": ((-2.0, 0.05), "x", lambda v, k, half: k * v / (half + abs(v))),
    "hill_power": ((-0.5, 0.05, 3.0), "x", lambda v, k, *c: k * _sigmoid(v, *c)),
    "switch": ((0.4, 0.02), "x", lambda v, k, width: k * np.tanh(v / width)),
    "square": ((9.0,), "x", lambda v, k: k * v**2),
    "product": ((0.1,), "x F", lambda v, w, k: k * v * w),
    "power_product": ((-2.0, 1.4, 1.2, 0.1, 3.0), "x F", _powers),
    "arrhenius": ((0.5, 0.9, 0.1, 3.0), "x", _activated),
    "hinge": ((-50.0, 0.05), "x", lambda v, k, at: k * np.maximum(v - at, 0.0)),
    "hinge_below": ((50.0, 0.02), "x", lambda v, k, at: k * np.maximum(at - v, 0.0)),
    "gap": ((40.0, 0.04), "x", _gap),
    "square_root": ((0.5,), "x", lambda v, k: -k * np.sqrt(np.maximum(v, 0.0))),
    "signed_root": ((0.5,), "F", lambda v, k: -k * np.sign(v) * np.sqrt(abs(v))),
    **{f"table{end}": ((*values, -0.2, 0.3), "", _table) for end, values in CURVES.items()},
    **{
        f"coulomb_table{end}": (
            (*values, -0.05, 0.1, 0.05),
            "v x",
            lambda v, w, *c: -_table(w, *c[:-1]) * np.tanh(v / c[-1]),
        )
        for end, values in CURVES.items()
    },
}
"""At der(v): coefficients, variables ("t" where there are none, "" where it is v without being
named), and what is added as a function of variables and coefficients."""

_TABLES = [f"table{end}" for end in CURVES]
FORCES = [
    *("viscous", "quadratic", "power", "coulomb", "stribeck", "asymmetric_coulomb", "linear"),
    *("product", "periodic", "hinge", "contact", "hinge_below", "gap", "signed_root", *_TABLES),
]
"""Those that are forces at the input F too."""

TERMS = dict.fromkeys(["product", "exponential", "hinge", "hinge_below", *_TABLES], 1.0)
TERMS |= dict.fromkeys(["quadratic", "power", "coulomb", "stribeck", "asymmetric_coulomb"], -1.0)
TERMS |= {"signed_root": -1.0}
"""Those that are added to the output y too, and their sign there."""

_Change = tuple[tuple[float, ...], tuple[float, ...], Callable[..., Any]]
CHANGES: dict[str, _Change] = {
    "bias": ((0.5,), (0.02,), lambda s, t, k: s + k),
    "drift": ((0.2,), (0.02,), lambda s, t, k: s + k * t),
    "gain": ((0.2,), (0.1,), lambda s, t, k: s * (1.0 + k)),
    "square": ((0.1,), (2.0,), lambda s, t, k: s + k * s**2),
    "cubic": ((0.05,), (9.0,), lambda s, t, k: s + k * s**3),
    "power_characteristic": (
        (1.4, 2.0),
        (1.4, 0.1),
        lambda s, t, n, ref: ref * np.sign(s) * (abs(s) / ref) ** n,
    ),
    "saturating": ((0.2,), (2.0,), lambda s, t, k: s / (1.0 + k * abs(s))),
    "asymmetry": ((0.3,), (0.3,), lambda s, t, k: s + k * np.maximum(s, 0.0)),
    "saturation": ((2.0,), (0.1,), lambda s, t, limit: np.clip(s, -limit, limit)),
    "clip_above": ((), (0.04,), lambda s, t, limit: np.minimum(s, limit)),
    "clip_below": ((), (-0.03,), lambda s, t, limit: np.maximum(s, limit)),
    "dead_zone": ((1.0,), (0.03,), lambda s, t, k: np.where(abs(s) > k, s - k * np.sign(s), 0.0)),
    "cut_off": ((1.0, 0.2), (0.03, 0.002), _cut),
    "periodic": (
        (),
        (0.01, 0.02, 40.0),
        lambda s, t, a, b, n: s + np.hypot(a, b) * np.sin(n * s + np.arctan2(b, a)),
    ),
    "absolute": ((), (0.3,), lambda s, t, k: s + k * abs(s)),
    "hum": ((), (0.03, 0.02, 7.0), lambda s, t, *c: s + DERIVATIVE["sine"][2](t, *c)),
    **{
        f"characteristic{end}": ((*values[1:-1], -4.0, 3.0), (*values[1:-1], -0.2, 0.3), _pinned)
        for end, values in CURVES.items()
    },
}
"""Of the input F or the output y: coefficients at the one and the other (none where it is no form
there), and what takes the place of the signal, of it, the time and the coefficients."""

PARAMETER: dict[str, tuple[tuple[float, ...], str, Callable[..., Any]]] = {
    "drift": ((0.8, 2.0), "t", lambda t, v: 0.8 * (t - 2.0)),
    "sine": ((0.4, -0.2, 3.0), "t", lambda t, v: 0.4 * np.sin(3.0 * t) - 0.2 * np.cos(3.0 * t)),
    "linear": ((0.9, 0.1), "v", lambda t, v: 0.9 * (v - 0.1)),
    "magnitude": ((0.9, 0.1), "v", lambda t, v: 0.9 * (abs(v) - 0.1)),
    "square": ((3.0, 0.02), "v", lambda t, v: 3.0 * (v**2 - 0.02)),
    "inverse": ((0.5, 0.1), "v", lambda t, v: 1.0 / (1.0 + 0.5 * (v - 0.1)) - 1.0),
    "inverse_square": ((3.0, 0.02), "v", lambda t, v: 1.0 / (1.0 + 3.0 * (v**2 - 0.02)) - 1.0),
    "power": ((0.5, 0.1), "v", lambda t, v: (abs(v) / 0.1) ** 0.5 - 1.0),
    "offset_power": ((0.8, 1.5, 0.1), "v", lambda t, v: 0.8 * ((abs(v) / 0.1) ** 1.5 - 1.0)),
    "exponential": ((1.5, 0.1), "v", lambda t, v: np.exp(1.5 * (v - 0.1)) - 1.0),
    "saturating": ((0.8, 0.1), "v", lambda t, v: -0.8 * abs(v) / (0.1 + abs(v))),
    "hill_power": ((0.8, 0.1, 3.0), "v", lambda t, v: -0.8 * _sigmoid(v, 0.1, 3.0)),
    "arrhenius": (
        (0.9, 0.1, 3.0),
        "v",
        lambda t, v: np.exp(0.9 / 3.1) / np.exp(0.9 / (v + 3.0)) - 1.0,
    ),
    "hill": ((0.8, 0.1), "v", lambda t, v: -0.8 * (v / 0.1) ** 2 / (1.0 + (v / 0.1) ** 2)),
} | {
    f"table{end}": (
        (*h[: len(h) // 2], *h[len(h) // 2 + 1 :], -0.2, 0.3),
        "v",
        lambda t, v, h=h: curve(v, -0.2, 0.3, (*h[: len(h) // 2], 0.0, *h[len(h) // 2 + 1 :])),
    )
    for end, h in CURVES.items()
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
    "power": ((0.02, 0.15, 1.4, 0.05), TRAVEL, lambda v: np.sign(v) * (abs(v) / 0.05) ** 1.4),
    "radiation": (
        (3e3, 2e4, 0.2),
        ("z_body", "z_wheel"),
        lambda v: (v[0] + 0.2) ** 4 - (v[1] + 0.2) ** 4,
    ),
    "power_times": (
        (2.0, 15.0, 1.4, 0.5),
        (*TRAVEL, "v_wheel"),
        lambda v: v[0] * (abs(v[1]) / 0.5) ** 1.4,
    ),
    "coulomb": ((0.3, 2.2, 0.05), (), lambda v: np.tanh(v / 0.05)),
    "leak": ((1.0, 7.5), ("v_wheel",), lambda v: np.sign(v) * np.sqrt(abs(v))),
}
"""Between the masses of a quarter car: coefficients, variables, and the law of the force."""

_CURVE_TEST = "test_a_curve_between_two_states_acts_on_both_in_proportion"
OWN_TESTS = {
    **{("pair", f"table{end}"): _CURVE_TEST for end in CURVES},
    ("input", "backlash"): "test_backlash_at_an_input",
    ("output", "backlash"): "test_backlash_at_an_output",
    ("input", "hysteresis"): "test_hysteresis_of_an_actuator",
    ("input", "rate_limit"): "test_a_limited_rate_of_an_input",
    ("input", "rate_limit_from_rest"): "test_a_limited_rate_of_an_input",
    ("output", "hysteresis"): "test_hysteresis_of_a_sensor",
    ("pair", "store"): "test_a_spring_and_a_damper_in_series_between_two_states",
    ("pair", "store_between"): "test_a_wall_between_two_states",
}
"""Forms that need more than a truth below: their tests in `tests/integration/effects`."""


@dataclass(frozen=True)
class FormTruth:
    """The output of the springs with a form of an effect: how it is asked for, and what it is.

    `bar` is how far a simulation may be from it, `in_steps` the same of one in co-simulation, whose
    changed input counts as linear between communication points; 0 where it is not tried.
    """

    kind: str
    form: str
    coefficients: tuple[float, ...]
    variables: tuple[str, ...]
    solved: Callable[[], np.ndarray]
    bar: float
    in_steps: float = 0.0

    @cached_property
    def output(self) -> np.ndarray:
        return self.solved()


@cache
def base() -> np.ndarray:
    """States without an effect, (times, states)."""
    return solve(plain)


def _term(form: str) -> Callable[[Any, Any, Any], Any]:
    """What a form adds to a derivative, of time, states and force."""
    coefficients, of, law = DERIVATIVE[form]

    def added(t: Any, x: Any, f: Any) -> Any:
        known = {"t": t, "x": x[0], "v": x[1], "F": f}
        return law(*(known[name] for name in (of or "v").split()), *coefficients)

    return added


def _names(form: str) -> tuple[str, ...]:
    """The variables of a form where all are named."""
    return tuple((DERIVATIVE[form][1] or "v").split())


def _forced(term: Callable[..., Any]) -> np.ndarray:
    """The position where a term is added to the force."""
    return solve(lambda t, x, f: plain(t, x, f + term(t, x, f)))[:, 0]


def _changed(law: Callable[..., Any], c: tuple[float, ...]) -> np.ndarray:
    """The position where something takes the place of the force."""
    return solve(lambda t, x, f: plain(t, x, law(f, t, *c)))[:, 0]


def _varied(share: Callable[..., Any]) -> np.ndarray:
    """The position where the damping varies by a share of itself."""
    return solve(pushed(lambda t, x, f: -C / M * share(t, x[1]) * x[1]))[:, 0]


def _functions() -> Iterator[FormTruth]:
    """Forms without a memory."""
    for form, (c, of, _) in DERIVATIVE.items():
        slope = pushed(_term(form))
        variables = tuple(of.replace("t", "").split())
        # a kink of an effect is not on the grid, so the tolerance only holds step by step
        yield FormTruth("derivative", form, c, variables, partial(_first, slope), 1e-7)
    for form in FORCES:
        force = partial(_forced, _term(form))
        variables = ("x",) if form == "product" else _names(form)
        yield FormTruth("input", form, DERIVATIVE[form][0], variables, force, 2e-7)
    for form, sign in TERMS.items():
        yield _shown(form, DERIVATIVE[form][0], _names(form), sign, _term(form))
    yield _shown("square_feed_through", (9.0,), ("x",), 1.0, _term("square"))
    yield _shown("cubic_feed_through", (0.7,), ("v",), -1.0, _term("cubic"))
    yield _shown("feed_through", (0.01,), ("F",), 0.01, lambda t, x, f: f)
    yield _shown("feed_through", (0.01,), ("v",), 0.01, lambda t, x, f: x[1])
    for form, (here, there, law) in CHANGES.items():
        if here:
            yield FormTruth("input", form, here, (), partial(_changed, law, here), 2e-7, 1e-3)
        if there:
            shown = partial(lambda law, c: law(base()[:, 0], TIMES, *c), law, there)
            yield FormTruth("output", form, there, (), shown, 1e-8, 1e-8)
    for form, (c, of, share) in PARAMETER.items():
        bar = 1e-6 if form.startswith("table") else 2e-8
        in_steps = 1e-4 if form == "drift" else 0.0  # it is set at the communication points
        variables = tuple(of.replace("t", "").split())
        yield FormTruth("parameter", form, c, variables, partial(_varied, share), bar, in_steps)


def _first(slope: Slope, *starts: float) -> np.ndarray:
    """The position, of equations with further states that start so."""
    return solve(slope, (*START, *starts))[:, 0]


def _shown(
    form: str, c: tuple[float, ...], names: tuple[str, ...], sign: float, term: Callable[..., Any]
) -> FormTruth:
    def shown() -> np.ndarray:
        return base()[:, 0] + sign * term(TIMES, base().T, FORCE)

    return FormTruth("output", form, c, names, shown, 1e-8, 1e-8)


def _dahl(v: float, z: float) -> float:
    return (v - abs(v) * z) / 0.02


def _rubbed(t: float, x: np.ndarray, f: float) -> list[float]:
    v, dv = plain(t, x, f)
    return [v, dv - 0.5 * x[2], _dahl(v, x[2])]


def _pulled(t: float, x: np.ndarray, f: float) -> list[float]:
    v, dv = plain(t, x, f)
    return [v, dv - 6.0 * x[2], (x[0] - x[2]) / 0.3]


def _pulled_twice(t: float, x: np.ndarray, f: float) -> list[float]:
    v, dv = plain(t, x, f)
    return [v, dv - 6.0 * x[2] + 4.0 * x[3], (x[0] - x[2]) / 0.1, (x[0] - x[3]) / 0.9]


def _shaken(t: float, x: np.ndarray, f: float) -> list[float]:
    """By a mast that swings with the force."""
    v, dv = plain(t, x, f)
    return [v, dv + 0.4 * x[2] - 0.3 * x[3] / 12.0, x[3], _swing(f, x[2], x[3], 12.0, 0.3)]


def _lagged(t: float, x: np.ndarray, f: float) -> list[float]:
    return [*plain(t, x, x[2]), (f - x[2]) / 0.1]


def _swing(u: float, z: float, rate: float, f: float, d: float) -> float:
    """Of the second-order equation z'' = f^2 (u - z) - 2 d f z'."""
    return f**2 * (u - z) - 2.0 * d * f * rate


def _swinging(t: float, x: np.ndarray, f: float) -> list[float]:
    return [*plain(t, x, x[2]), x[3], _swing(f, x[2], x[3], 12.0, 0.3)]


def _ripple(t: float, x: np.ndarray, f: float) -> float:
    """Of the way travelled, which begins at nought."""
    way = x[0] - START[0]
    return 0.3 * np.sin(40.0 * way) + 0.2 * np.cos(40.0 * way)


def _lagged_damping(t: float, x: np.ndarray, f: float) -> list[float]:
    v, dv = plain(t, x, f)
    return [v, dv - C / M * 0.9 * (x[2] - 0.02) * v, (v - x[2]) / 0.3]


def _recycled() -> np.ndarray:
    """The position with a spring to where the body was 0.1 s ago, exactly."""
    return late_states(lambda x, late: [0.0, -4.0 * late[0]], 0.1)


def _late_damping() -> np.ndarray:
    """The position with a damping that depends on the speed 0.1 s ago, exactly."""
    return late_states(lambda x, late: [0.0, -C / M * 0.9 * (late[1] - 0.02) * x[1]], 0.1)


def _heated(t: float, x: np.ndarray, f: float) -> list[float]:
    v, dv = plain(t, x, f)
    return [v, dv - C / M * 0.9 * (x[2] - 0.02) * v, (v**2 - x[2]) / 0.6]


def _sensor(f: float, d: float) -> np.ndarray:
    """What a sensor shows that swings; it sees the output between the measured times too."""

    def slope(t: float, x: np.ndarray, force: float) -> list[float]:
        return [*plain(t, x, force), x[3], _swing(x[0], x[2], x[3], f, d)]

    return solve(slope, (*START, START[0], 0.0))[:, 2]


def _relaxing(*rates: tuple[float, float]) -> Slope:
    """With springs, each in series with a damper: their forces are the further states."""

    def slope(t: float, x: np.ndarray, f: float) -> list[float]:
        v, dv = plain(t, x, f)
        forces = [k * v - p / tau for p, (k, tau) in zip(x[2:], rates, strict=True)]
        return [v, dv - sum(x[2:]), *forces]

    return slope


def _carrying(t: float, x: np.ndarray, f: float) -> list[float]:
    """With a mass of 0.2 of its own on a spring and a damper."""
    v, dv = plain(t, x, f)
    pulled = 9.0**2 * (x[0] - x[2]) + 2.0 * 0.1 * 9.0 * (v - x[3])
    return [v, dv - 0.2 * pulled, x[3], pulled]


def _led(t: float, x: np.ndarray, f: float) -> list[float]:
    return [*plain(t, x, f + 0.5 * (f - x[2])), (f - x[2]) / 0.1]


def _with_a_second_mode() -> np.ndarray:
    def slope(t: float, x: np.ndarray, f: float) -> list[float]:
        return [*plain(t, x, f), x[3], _swing(f, x[2], x[3], 12.0, 0.3)]

    found = solve(slope, (*START, 0.0, 0.0))
    return found[:, 0] + 0.01 * found[:, 2] - 0.004 * found[:, 3] / 12.0


def _leading() -> np.ndarray:
    shown = base()[:, 0]
    return shown + 0.5 * (shown - _slow(0.05))


def _from_nought() -> np.ndarray:
    """What a slow sensor shows that stood at zero: what began elsewhere decays."""
    return _slow(0.3) - START[0] * np.exp(-TIMES / 0.3)


def _slow(tau: float, of: int = 0) -> np.ndarray:
    """What a sensor shows that lags behind the position, or behind the force from nought."""

    def slope(t: float, x: np.ndarray, force: float) -> list[float]:
        return [*plain(t, x, force), ((x[0], force)[of] - x[2]) / tau]

    found = solve(slope, (*START, (START[0], 0.0)[of]))
    return found[:, 0] + 0.05 * found[:, 2] if of else found[:, 2]


def _late_input() -> np.ndarray:
    times = np.union1d(TIMES, TIMES + 0.013)
    times = times[times <= TIMES[-1]]
    late = solve(plain, times=times, force=np.interp(times - 0.013, TIMES, FORCE))[:, 0]
    return late[np.searchsorted(times, TIMES)]


def _late_output() -> np.ndarray:
    """It shows what was between the measured times."""
    seen = np.union1d(TIMES, TIMES[2:] - 0.033)
    late = solve(plain, times=seen, force=np.interp(seen, TIMES, FORCE))[:, 0]
    return np.where(TIMES > 0.033, late[np.searchsorted(seen, TIMES - 0.033)], START[0])


def _rubbed_input(t: float, x: np.ndarray, f: float) -> list[float]:
    return [*plain(t, x, f - 0.5 * x[2]), _dahl(x[1], x[2])]


STRENGTHS = (0.8, -0.5, 0.6, 0.3, -0.2)
"""Of the lags of a free filter."""


def _filtered(kind: str, name: str, order: int) -> np.ndarray:
    """What is shown with a filter of the force, the speed or the position that begins half full."""
    k, tau = np.array(STRENGTHS[:order]), 0.1
    exchanges, shown = "dynamics" not in name or "signal" in name, kind == "output"

    def argument(x: np.ndarray, f: float) -> float:
        return x[1] if "exchange" in name else x[0] if shown and exchanges else f

    def added(u: float, z: np.ndarray) -> float:
        return float(k @ (z - u if exchanges else z))

    def slope(t: float, x: np.ndarray, f: float) -> list[float]:
        u, z = argument(x, f), x[2:]
        more = added(u, z)
        v, dv = plain(t, x, f + more if kind == "input" else f)
        before = [u, *z[:-1]]
        return [v, dv + (more if kind == "derivative" else 0.0), *((before - z) / tau)]

    begun = 0.5 * argument(np.array(START), FORCE[0])
    found = solve(slope, (*START, *(order * (begun,))))
    if not shown:
        return found[:, 0]
    return found[:, 0] + [added(argument(x, f), x[2:]) for x, f in zip(found, FORCE, strict=True)]


FILTERS = {
    ("derivative", "hidden_dynamics"): ("F",),
    ("derivative", "hidden_exchange"): (),
    ("output", "hidden_dynamics"): ("F",),
    ("input", "signal_dynamics"): (),
    ("output", "signal_dynamics"): (),
}
"""Free filters, and what they are functions of; each has an order of three and one of five."""

FILTERED = [
    FormTruth(
        kind,
        f"{name}{end}",
        (*STRENGTHS[:order], 0.1, 0.5),
        variables,
        partial(_filtered, kind, name, order),
        1e-8 if kind != "output" else 1e-6 if variables else 2e-5,
    )
    for (kind, name), variables in FILTERS.items()
    for end, order in (("", 3), ("_5", 5))
]

STORED: list[FormTruth] = [
    FormTruth(
        "derivative", "store", (6.0, 0.3), ("x",), partial(_first, _relaxing((6.0, 0.3)), 0.0), 1e-8
    ),
    FormTruth(
        "derivative",
        "store_from_zero",
        (6.0, 0.3),
        ("x",),
        partial(_first, _relaxing((6.0, 0.3)), 6.0 * START[0]),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "store_from_elsewhere",
        (6.0, 0.5, 0.3),
        ("x",),
        partial(_first, _relaxing((6.0, 0.3)), 6.0 * (START[0] - 0.5 / 6.0)),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "two_stores",
        (6.0, 4.0, 0.1, 0.9),
        ("x",),
        partial(_first, _relaxing((6.0, 0.1), (4.0, 0.9)), 0.0, 0.0),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "two_stores_from_zero",
        (6.0, 4.0, 0.1, 0.9),
        ("x",),
        partial(_first, _relaxing((6.0, 0.1), (4.0, 0.9)), 6.0 * START[0], 4.0 * START[0]),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "two_lags",
        (-6.0, 4.0, 0.1, 0.9),
        ("x",),
        partial(_first, _pulled_twice, START[0], START[0]),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "driven_mode",
        (0.4, -0.3, 12.0, 0.3),
        ("F",),
        partial(_first, _shaken, 0.0, 0.0),
        1e-7,
    ),
    FormTruth(
        "input", "store", (6.0, 0.3), ("x",), partial(_first, _relaxing((6.0 / M, 0.3)), 0.0), 1e-8
    ),
    FormTruth(
        "derivative",
        "emptying",
        (0.5, 0.3),
        (),
        partial(_first, pushed(lambda t, x, f: 0.5 * np.exp(-t / 0.3))),
        1e-8,
    ),
    FormTruth(
        "derivative",
        "oscillator",
        (0.2 * 9.0, 9.0, 0.1),
        (),
        partial(_first, _carrying, *START),
        1e-7,
    ),
    FormTruth("input", "lead", (0.5, 0.1), (), partial(_first, _led, FORCE[0]), 1e-8),
    FormTruth("output", "lead", (0.5, 0.05), (), _leading, 2e-5),
    FormTruth("output", "lag_from_rest", (0.3,), (), _from_nought, 2e-5),
    FormTruth(
        "output", "mode_feed_through", (0.01, -0.004, 12.0, 0.3), ("F",), _with_a_second_mode, 1e-6
    ),
]
"""Hidden stores and oscillators, by other equations than those of the library."""

WITH_MEMORY = [
    FormTruth("derivative", "dahl", (0.5, 0.02), (), partial(_first, _rubbed, 0.0), 1e-8),
    FormTruth("derivative", "delayed", (-4.0, 0.1), ("x",), _recycled, 2e-6),
    FormTruth("derivative", "lagged", (-6.0, 0.3), ("x",), partial(_first, _pulled, 0.1), 1e-8),
    FormTruth(
        "derivative",
        "periodic_travel",
        (0.3, 0.2, 40.0),
        (),
        partial(_first, pushed(_ripple)),
        1e-7,
    ),
    FormTruth("input", "dahl", (0.5, 0.02), ("v",), partial(_first, _rubbed_input, 0.0), 1e-8),
    FormTruth("input", "lag", (0.1,), (), partial(_first, _lagged, FORCE[0]), 1e-9, 1e-5),
    FormTruth("input", "lag_from_rest", (0.1,), (), partial(_first, _lagged, 0.0), 1e-8),
    FormTruth(
        "input", "mode", (12.0, 0.3), (), partial(_first, _swinging, FORCE[0], 0.0), 1e-7, 1e-3
    ),
    FormTruth(
        "input", "mode_from_rest", (12.0, 0.3), (), partial(_first, _swinging, 0.0, 0.0), 1e-7
    ),
    FormTruth("input", "delay", (0.013,), (), _late_input, 1e-9, 2e-8),
    *(
        FormTruth("output", "mode", (f, d), (), partial(_sensor, f, d), 2e-5)
        for f, d in ((30.0, 0.1), (5.0, 0.7))
    ),
    *(
        FormTruth("output", "lag", (tau,), (), partial(_slow, tau), 2e-5)
        for tau in (0.0005, 0.05, 1.0)
    ),
    FormTruth("output", "lagged_feed_through", (0.05, 0.3), ("F",), partial(_slow, 0.3, 1), 1e-6),
    FormTruth("output", "delay", (0.033,), (), _late_output, 6e-5, 6e-5),
    FormTruth("parameter", "delayed", (0.9, 0.02, 0.1), ("v",), _late_damping, 2e-5),
    FormTruth(
        "parameter", "lagged", (0.9, 0.02, 0.3), ("v",), partial(_first, _lagged_damping, 0.0), 2e-8
    ),
    FormTruth(
        "parameter", "heating", (0.9, 0.02, 0.6), ("v",), partial(_first, _heated, 0.0), 2e-8
    ),
]
"""Forms with states of their own, and those that need values of another time."""

TRUTHS = [*_functions(), *WITH_MEMORY, *STORED, *FILTERED]
"""Of every form at the springs but for those of `OWN_TESTS`."""


def forms_with_a_truth() -> set[tuple[str, str]]:
    """Return kind and name of every form that a table or a test of its own has."""
    return {(t.kind, t.form) for t in TRUTHS} | {("pair", form) for form in PAIR} | set(OWN_TESTS)
