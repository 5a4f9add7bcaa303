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
from scipy.linalg import expm

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
class _CoupledStates:
    """z' = M z + drives, with M of the coefficients alone."""

    matrix: Function
    drives: tuple[Function, ...]
    starts: tuple[Function, ...]


@dataclass(frozen=True)
class ArrayForm:
    """A form made ready for numpy.

    Attributes
    ----------
    form
        Of the library.
    strengths
        Coefficients that switch the effect off at 0 and that the equation is smooth in there;
        empty where the effect can only be switched on by a finite amount, like a dead zone.
    mirrored
        At a pair: each strength acts on both derivatives.
    """

    form: EffectForm
    strengths: tuple[str, ...]
    mirrored: bool
    _change: tuple[Function, ...]
    _back: tuple[Function, ...]
    _states: tuple[_OwnState, ...]
    _coupled: _CoupledStates | None

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
            if self._coupled is not None:
                own = list(_follow_coupled(self._coupled, signals, values))
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
    smooth = bool(neutral) and all(_smooth_in(added, k, neutral) for k in neutral)
    off = dict.fromkeys(neutral, 0)
    changes = [equation - symbols["s"]]
    if smooth:
        changes = [sp.diff(added, k).subs(off) for k in neutral]
    backs = [sp.diff(reaction, k).subs(off) for k in neutral] if mirrored else []
    return ArrayForm(
        form=form,
        strengths=tuple(str(k) for k in neutral) if smooth else (),
        mirrored=mirrored,
        _change=tuple(sp.lambdify(order, change, "numpy") for change in changes),
        _back=tuple(sp.lambdify(order, back, "numpy") for back in backs),
        _states=()
        if _are_coupled(form, symbols, where)
        else tuple(_own_state(z, form, symbols, where) for z in form.states),
        _coupled=_coupled_states(form, symbols, where)
        if _are_coupled(form, symbols, where)
        else None,
    )


def _smooth_in(equation: sp.Expr, strength: sp.Symbol, strengths: list[sp.Symbol]) -> bool:
    """Return whether the equation changes with a strength from 0 on, and has no kink in any."""
    kinks = equation.atoms(sp.Piecewise, sp.Min, sp.Max, sp.Abs)
    if any(kink.free_symbols & set(strengths) for kink in kinks):
        return False
    return bool(sp.diff(equation, strength).subs(dict.fromkeys(strengths, 0)) != 0)


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


def _are_coupled(form: EffectForm, symbols: Mapping[str, sp.Symbol], where: str) -> bool:
    """Return whether own states of a form act on each other."""
    names = {symbols[z.name] for z in form.states}
    parsed = [(symbols[z.name], parse(z.derivative, symbols, where)) for z in form.states]
    return any(derivative.free_symbols & (names - {z}) for z, derivative in parsed)


def _coupled_states(
    form: EffectForm, symbols: Mapping[str, sp.Symbol], where: str
) -> _CoupledStates:
    """Split the derivatives of own states into what they do to each other and what drives them."""
    own = [symbols[z.name] for z in form.states]
    derivatives = sp.Matrix([parse(z.derivative, symbols, where) for z in form.states])
    matrix = derivatives.jacobian(own)
    drives = sp.simplify(derivatives - matrix * sp.Matrix(own))
    coefficients = [symbols[c.name] for c in form.coefficients]
    order = [*(symbols[name] for name in _ARGUMENTS), *coefficients]
    starts = [parse(z.start, symbols, where) for z in form.states]
    return _CoupledStates(
        sp.lambdify(coefficients, matrix, "numpy"),
        tuple(sp.lambdify(order, drive, "numpy") for drive in drives),
        tuple(sp.lambdify(order, start, "numpy") for start in starts),
    )


def _follow_coupled(
    states: _CoupledStates, signals: FormArguments, values: Mapping[str, float]
) -> FloatArray:
    """Integrate own states that act on each other, (states, n), exactly for linear drives.

    Between two times z' = M z + b + c t; with a row for 1 and one for t the exponential of one
    matrix takes a step. Steps of one length share it.
    """
    numbers, times = tuple(values.values()), signals.t
    matrix = np.asarray(states.matrix(*numbers), float)
    drives, starts = (
        np.array([np.broadcast_to(f(*signals.arrays, *numbers), len(times)) for f in of], float)
        for of in (states.drives, states.starts)
    )
    count = len(matrix)
    found = np.empty((count, len(times)))
    found[:, 0] = starts[:, 0]
    known: dict[float, tuple[FloatArray, FloatArray, FloatArray]] = {}
    for n, step in enumerate(np.diff(times).tolist()):
        length = float(f"{step:.9e}")
        if length not in known:
            known[length] = _step_of(matrix, length)
        keep, first, last = known[length]
        found[:, n + 1] = keep @ found[:, n] + first @ drives[:, n] + last @ drives[:, n + 1]
    return found


def _step_of(matrix: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a step makes of the states, and of the drives at its start and its end."""
    count = len(matrix)
    one = np.eye(count)
    large = np.zeros((3 * count, 3 * count))
    large[:count, :count] = matrix * step
    large[:count, count : 2 * count] = one * step
    large[count : 2 * count, 2 * count :] = one
    power = expm(large)
    constant, slope = power[:count, count : 2 * count], power[:count, 2 * count :]
    return power[:count, :count], constant - slope, slope
