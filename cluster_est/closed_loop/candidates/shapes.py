"""Forms of effects as functions over whole signals, for looking at many candidates at once.

A worker compiles an effect before it simulates with it. To rank hundreds of candidates nothing is
simulated: their equations are evaluated along signals that are already there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import sympy as sp
from scipy.integrate import cumulative_trapezoid

from workers.effects.expression import parse
from workers.effects.forms import EffectForm
from workers.effects.memory import MEMORIES, SampledSignal
from workers.messages import FloatArray

_ARGUMENTS = ("t", "s", "v", "w")
Function = Callable[..., Any]


@dataclass(frozen=True)
class FormArguments:
    """Arguments of a form: time, the signal at the site, and its variables; all (n,)."""

    t: FloatArray
    s: FloatArray
    v: FloatArray
    w: FloatArray

    @property
    def arrays(self) -> tuple[FloatArray, ...]:
        return self.t, self.s, self.v, self.w


@dataclass(frozen=True)
class _OwnState:
    """z' = drive - rate * z, both functions of signals and coefficients."""

    drive: Function
    rate: Function
    start: Function


@dataclass(frozen=True)
class ArrayForm:
    """A form made ready for numpy.

    Attributes
    ----------
    form
        Of the library.
    strengths
        Coefficients that the equation is linear in and that switch the effect off at 0; empty
        where the effect can only be switched on by a finite amount, like a dead zone.
    mirrored
        At a pair: each strength acts on both derivatives.
    """

    form: EffectForm
    strengths: tuple[str, ...]
    mirrored: bool
    _change: tuple[Function, ...]
    _back: tuple[Function, ...]
    _states: tuple[_OwnState, ...]

    def directions(self, signals: FormArguments, values: Mapping[str, float]) -> FloatArray:
        """(n, d): what is added per unit of each strength, or the whole finite change.

        At a pair a strength acts on one of the derivatives, if it is not `mirrored`.
        """
        if self.form.memory:
            amount = next(iter(values.values()))
            given = SampledSignal(signals.t, signals.s)
            changed = MEMORIES[self.form.memory](given, amount)
            return (np.interp(signals.t, changed.times, changed.values) - signals.s)[:, None]
        return self._columns(self._change, signals, values)

    def reactions(self, signals: FormArguments, values: Mapping[str, float]) -> FloatArray:
        """(n, d): what each strength of a `mirrored` form adds to the second derivative."""
        return self._columns(self._back, signals, values)

    def _columns(
        self, functions: Sequence[Function], signals: FormArguments, values: Mapping[str, float]
    ) -> FloatArray:
        with np.errstate(all="ignore"):
            own = [_follow(state, signals, values) for state in self._states]
            columns = [f(*signals.arrays, *own, *values.values()) for f in functions]
        size = len(signals.t)
        return np.column_stack([np.broadcast_to(np.asarray(c, float), size) for c in columns])


@cache
def shape_of(form: EffectForm) -> ArrayForm:
    """The numpy functions of a form of the library."""
    names = [*_ARGUMENTS, *(z.name for z in form.states), *(c.name for c in form.coefficients)]
    symbols = {name: sp.Symbol(name, real=True) for name in names}
    where = f"form {form.name}"
    equation = parse(form.equation, symbols, where)
    reaction = parse(form.reaction or "0", symbols, where)
    neutral = [symbols[c.name] for c in form.coefficients if c.neutral == 0.0]
    order = [symbols[name] for name in names]
    mirrored = any(reaction.has(k) and equation.has(k) for k in neutral)
    added = equation if mirrored else equation + reaction  # then no strength is in both
    linear = bool(neutral) and all(_linear_in(added, k, neutral) for k in neutral)
    changes = [sp.diff(added, k) for k in neutral] if linear else [equation - symbols["s"]]
    backs = [sp.diff(reaction, k) for k in neutral] if mirrored else []
    return ArrayForm(
        form=form,
        strengths=tuple(str(k) for k in neutral) if linear else (),
        mirrored=mirrored,
        _change=tuple(sp.lambdify(order, change, "numpy") for change in changes),
        _back=tuple(sp.lambdify(order, back, "numpy") for back in backs),
        _states=tuple(_own_state(z, form, symbols, where) for z in form.states),
    )


def _linear_in(equation: sp.Expr, strength: sp.Symbol, others: list[sp.Symbol]) -> bool:
    """Return whether the derivative by a strength has none of the strengths left in it."""
    if equation.has(sp.Piecewise, sp.Min, sp.Max, sp.Abs):
        inside = equation.atoms(sp.Piecewise, sp.Min, sp.Max, sp.Abs)
        if any(a.free_symbols & set(others) for a in inside):
            return False
    slope = sp.diff(equation, strength)
    return slope != 0 and not (slope.free_symbols & set(others))


def _own_state(
    state: Any, form: EffectForm, symbols: Mapping[str, sp.Symbol], where: str
) -> _OwnState:
    """Split an own state's derivative into drive and rate; those of the library are linear."""
    derivative = parse(state.derivative, symbols, where)
    z = symbols[state.name]
    rate = -sp.diff(derivative, z)
    drive = sp.expand(derivative + rate * z)
    names = [*_ARGUMENTS, *(c.name for c in form.coefficients)]
    order = [symbols[name] for name in names]
    start = parse(state.start, symbols, where)
    return _OwnState(*(sp.lambdify(order, sp.simplify(e), "numpy") for e in (drive, rate, start)))


def _follow(state: _OwnState, signals: FormArguments, values: Mapping[str, float]) -> FloatArray:
    """Integrate an own state: exact where the drive is linear and the rate constant in a step."""
    size = len(signals.t)
    numbers = tuple(values.values())
    drive = np.broadcast_to(np.asarray(state.drive(*signals.arrays, *numbers), float), size)
    rate = np.broadcast_to(np.asarray(state.rate(*signals.arrays, *numbers), float), size)
    start = np.broadcast_to(np.asarray(state.start(*signals.arrays, *numbers), float), size)
    if not rate.any():
        return np.asarray(start[0] + cumulative_trapezoid(drive, signals.t, initial=0))
    h = np.diff(signals.t)
    b = 0.5 * (rate[1:] + rate[:-1])
    bh = np.maximum(b * h, 1e-9)
    decay = np.exp(-bh)
    settled = -np.expm1(-bh) / bh  # mean of the decay over the step
    first = h * (settled - (1.0 - settled) / bh)
    last = h * (1.0 - settled) / bh
    pushed = first * drive[:-1] + last * drive[1:]
    z = np.empty(size)
    z[0] = value = float(start[0])
    for n, (keep, push) in enumerate(zip(decay.tolist(), pushed.tolist(), strict=True)):
        value = keep * value + push
        z[n + 1] = value
    return z
