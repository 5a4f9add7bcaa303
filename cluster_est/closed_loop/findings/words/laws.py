"""The law of an equation: how what it adds depends on its variable, read from the equation itself.

Coefficients stand at 1: how a law bends does not depend on how strong it is.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import sympy as sp

from workers.effects.expression import parse, simplified
from workers.effects.forms import EffectForm

Function = Callable[[float], float]


class Law(enum.Enum):
    """A law; the value is what mathematics calls it."""

    CONSTANT = "a constant"
    DRIFT = "a drift in time"
    WAVE = "a sinusoid in time"
    LINEAR = "linear"
    ABSOLUTE = "proportional to the magnitude"
    SQUARE = "quadratic"
    ODD_SQUARE = "quadratic with the sign"
    CUBE = "cubic"
    FOURTH = "of the fourth power"
    FOURTH_DIFFERENCE = "a difference of fourth powers"
    ABOVE_BY_POWER = "a power law above a threshold"
    INVERSE = "inverse"
    INVERSE_SQUARE = "inverse in the square"
    ROOT = "a square root"
    ODD_ROOT = "a square root with the sign"
    POWER = "a power law"
    EXPONENTIAL = "exponential"
    SWITCH = "a switch with the sign"
    SWITCH_WITH_PEAK = "a switch with the sign and a peak near zero"
    TWO_SWITCHES = "a switch with the sign, of two levels"
    SWITCH_BY_MAGNITUDE = "a switch with the sign, times a magnitude"
    SWITCH_BY_CURVE = "a switch with the sign, times a free curve"
    HYSTERESIS = "a hysteresis"
    ABOVE = "linear above a threshold"
    BELOW = "linear below a threshold"
    GAP = "linear beyond a gap"
    CLIPPED = "linear up to a limit"
    SATURATING = "saturating"
    HILL = "saturating in the square"
    INHIBITED = "falling at high values"
    PERIODIC = "periodic"
    PERIODIC_TRAVEL = "periodic in the integral"
    PRODUCT = "a product"
    LAGGED = "lagged"
    LAGGED_SQUARE = "the lagged square"
    CURVE = "a free curve"
    OTHER = "another function"


POWERS = {
    (1.0, -1): Law.LINEAR, (1.0, 1): Law.ABSOLUTE, (2.0, 1): Law.SQUARE,
    (2.0, -1): Law.ODD_SQUARE, (3.0, -1): Law.CUBE, (4.0, 1): Law.FOURTH,
    (0.5, 0): Law.ROOT, (0.5, -1): Law.ODD_ROOT, (0.0, -1): Law.SWITCH,
}  # fmt: skip
"""By the exponent, and by what a change of the sign does: the same, the opposite, or nothing."""


@lru_cache(maxsize=256)
def law_of(form: EffectForm) -> Law:
    """Return the law of a form: of what it adds, or by what share it changes a parameter."""
    if form.free:
        return Law.SWITCH_BY_CURVE if form.variables > 1 else Law.CURVE
    if form.memory:
        return Law.OTHER
    names = ["t", "s", "v", "w", *(c.name for c in form.coefficients)]
    symbols = {
        name: sp.Symbol(name, real=True) for name in [*names, *(z.name for z in form.states)]
    }
    where = f"form {form.name}"
    t, s, v, w = (symbols[name] for name in "tsvw")
    term = simplified(parse(form.equation, symbols, where))
    if form.kinds == ("parameter",):
        term = sp.expand(term / s - 1)
    elif form.kinds[0] in ("input", "output"):
        term = sp.expand(term - s)
    ones = {symbols[c.name]: sp.Integer(1) for c in form.coefficients}
    power = _with_free_exponent(term, set(ones))
    if power is not None:
        return power
    if form.states:
        return _with_state(form, term.subs(ones), symbols, where)
    if term.has(t):
        return Law.WAVE if term.has(sp.sin) else Law.DRIFT
    term = term.subs(ones)
    if not term.has(v, s):
        return Law.CONSTANT
    if term.has(v) and term.has(w if form.variables == 2 else s):
        return _in_two(term, v, w if form.variables == 2 else s)
    return _in_one(term, v if term.has(v) else s)


def _with_free_exponent(term: sp.Expr, coefficients: set[sp.Symbol]) -> Law | None:
    """The law of a power that has a coefficient as its exponent; None where there is none."""
    powers = [p for p in term.atoms(sp.Pow) if p.exp.free_symbols & coefficients]
    bases = [p.base for p in powers if not p.base.is_number]
    if not bases:
        return None
    above = any(base.has(sp.Max) and not base.has(sp.Abs) for base in bases)
    return Law.ABOVE_BY_POWER if above else Law.POWER


def _in_two(term: sp.Expr, v: sp.Symbol, w: sp.Symbol) -> Law:
    """The law of a function of two variables, or of a variable and the signal."""
    laws = {
        Law.PRODUCT: v * w,
        Law.FOURTH_DIFFERENCE: (v + 1) ** 4 - (w + 1) ** 4,
        Law.SWITCH_BY_MAGNITUDE: sp.tanh(v) * sp.Abs(w),
    }
    return next((k for k, own in laws.items() if sp.simplify(term / own).is_number), Law.OTHER)


def _with_state(form: EffectForm, term: sp.Expr, symbols: dict[str, sp.Symbol], where: str) -> Law:
    """The law of a form that brings a state along."""
    if len(form.states) != 1:
        return Law.OTHER
    rate = simplified(parse(form.states[0].derivative, symbols, where))
    z, v = symbols[form.states[0].name], symbols["v"]
    if rate == v:
        return Law.PERIODIC_TRAVEL if _in_one(term, z) is Law.PERIODIC else Law.OTHER
    if rate.has(sp.Abs(v)) and rate.has(z):
        return Law.HYSTERESIS
    drive = sp.expand(rate.subs(z, 0))
    if not drive.has(v):
        return Law.OTHER
    squared = sp.simplify(drive / v**2).has(v)
    return Law.LAGGED if squared else Law.LAGGED_SQUARE


def _in_one(term: sp.Expr, over: sp.Symbol) -> Law:
    """The law of a function of one variable."""
    if term.has(sp.sin) or term.has(sp.cos):
        return Law.PERIODIC
    compiled = sp.lambdify(over, term, "numpy")

    def value(x: float) -> float:
        with np.errstate(all="ignore"):
            return float(compiled(np.float64(x)))

    inverse = {Law.INVERSE: over, Law.INVERSE_SQUARE: over**2}
    for law, own in inverse.items():  # of what a parameter is divided by
        if sp.simplify((term + 1) * own).is_number:
            return law
    if term.has(sp.exp) and not term.has(sp.tanh):
        grows = (sp.simplify(sp.diff(each, over) / each) for each in (term, term + 1))
        return Law.EXPONENTIAL if any(not rate.has(over) for rate in grows) else Law.OTHER
    if term.has(sp.tanh):
        if value(20.0) != value(40.0):
            return Law.OTHER
        if term.has(sp.exp):
            return Law.SWITCH_WITH_PEAK
        return Law.TWO_SWITCHES if term.has(sp.Max) or term.has(sp.Min) else Law.SWITCH
    return _power(value) or _threshold(value) or _rational(value) or Law.OTHER


def _power(value: Function) -> Law | None:
    """The law of c + k z^p on either side of zero."""
    zero = value(0.0)
    right = np.array([value(x) for x in (0.25, 0.5, 1.0, 2.0, 4.0)]) - zero
    left = np.array([value(x) for x in (-0.25, -0.5, -1.0, -2.0, -4.0)]) - zero
    if not np.isfinite([*right, *left]).all() or not np.all(right):
        return None
    exponents = np.log2(np.abs(right[1:] / right[:-1]))
    if np.ptp(exponents) > 1e-6:
        return None
    parity = next((p for p in (-1, 0, 1) if np.allclose(left, p * right, rtol=1e-6)), None)
    if parity is None:
        return None
    return POWERS.get((round(float(exponents.mean()), 3), parity))


def _threshold(value: Function) -> Law | None:
    """The law of what begins, or ends, at a threshold of 1."""
    far = np.array([value(x) for x in (2.0, 3.0)])
    low = np.array([value(x) for x in (-2.0, -3.0)])
    middle = np.array([value(x) for x in (-0.5, 0.0, 0.5)])
    if not np.isfinite([*far, *low, *middle]).all():
        return None
    grows = abs(far[1]) > abs(far[0]) > 0.0
    falls = abs(low[1]) > abs(low[0]) > 0.0
    if not middle.any():
        if grows and falls:
            return Law.GAP
        return Law.ABOVE if grows and not low.any() else None
    if falls and not far.any():
        return Law.BELOW
    flat = far[0] == far[1] != 0.0 and low[0] == low[1] != 0.0
    return Law.CLIPPED if flat and np.isclose(middle[2], 0.5 * far[0]) else None


def _rational(value: Function) -> Law | None:
    """The law of what grows with an amount and then levels off, or falls."""
    small = np.array([value(x) for x in (0.0, 1e-6, 2e-6)])
    large = np.array([value(x) for x in (1e2, 1e4, 1e6)])
    if not np.isfinite([*small, *large]).all() or not large.any():
        return None
    begins = small[0] == 0.0 and small[1] != 0.0
    grows = small[2] / small[1] if begins else np.nan
    starts = bool(np.isclose(grows, 2.0, rtol=1e-3))
    if np.isclose(large[1], large[2], rtol=1e-3):
        if starts:
            return Law.SATURATING
        if np.isclose(grows, 4.0, rtol=1e-3):
            return Law.HILL
    falls = abs(large[0]) > 10.0 * abs(large[1]) > 10.0 * abs(large[2])
    return Law.INHIBITED if falls and (starts or small[0] != 0.0) else None
