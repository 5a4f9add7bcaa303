"""Forms of effects as numpy functions over whole signals, to evaluate many candidates at once.

A worker compiles an effect to byte code before it simulates with it. But the ranking of hundreds of
candidates needs no simulation: their equations are evaluated along signals that are already known,
and the internal states of a form are integrated along the same signals.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import sympy as sp
from scipy.integrate import cumulative_trapezoid

from cluster_est.closed_loop.candidates.trajectory import StepMatrices, propagate, step_matrices
from workers.effects.expression import parse
from workers.effects.forms import EffectForm
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.messages import FloatArray

EQUAL_STEPS = 1e-9
"""To find equal step lengths, they are rounded to this share of the power of ten below them."""

Function = Callable[..., Any]
"""A function of the arguments of a form, each (n,), followed by its coefficients."""


@dataclass(frozen=True)
class _SingleState:
    """z' = drive - rate * z, where drive and rate are functions of signals and coefficients.

    States before it count as signals.
    """

    drive: Function
    rate: Function
    start: Function


@dataclass(frozen=True)
class _CoupledStates:
    """z' = M z + drives, where M depends only on the coefficients."""

    matrix: Function
    drives: tuple[Function, ...]
    starts: tuple[Function, ...]


@dataclass(frozen=True)
class OwnStates:
    """The internal states of a form: one after the other, or coupled if they act on each other."""

    _single: tuple[_SingleState, ...]
    _coupled: _CoupledStates | None

    def follow(
        self, arguments: Sequence[FloatArray], coefficients: Sequence[float]
    ) -> list[FloatArray]:
        """Return each state along the arguments; the first argument is the time."""
        if self._coupled is not None:
            return list(_follow_coupled(self._coupled, arguments, coefficients))
        found: list[FloatArray] = []
        for state in self._single:
            found.append(_follow(state, [*arguments, *found], coefficients))
        return found


def own_states_of(
    form: EffectForm, arguments: Sequence[str], symbols: Mapping[str, sp.Symbol], where: str
) -> OwnStates:
    """Make the internal states of a library form; each equation is linear in its own state."""
    own = [symbols[z.name] for z in form.states]
    derivatives = [parse(z.derivative, symbols, where) for z in form.states]
    starts = [parse(z.start, symbols, where) for z in form.states]
    coefficients = [symbols[c.name] for c in form.coefficients]
    order = [*(symbols[name] for name in arguments), *coefficients]
    others = [set(own) - {z} for z in own]
    coupled = any(d.free_symbols & rest for d, rest in zip(derivatives, others, strict=True))
    matrix = sp.Matrix(derivatives).jacobian(own) if coupled else sp.Matrix()
    if coupled and matrix.free_symbols <= set(coefficients):
        drives = sp.simplify(sp.Matrix(derivatives) - matrix * sp.Matrix(own))
        states = _CoupledStates(
            sp.lambdify(coefficients, matrix, "numpy"),
            tuple(sp.lambdify(order, drive, "numpy") for drive in drives),
            tuple(sp.lambdify(order, start, "numpy") for start in starts),
        )
        return OwnStates((), states)
    single = []
    for i, (z, derivative, start) in enumerate(zip(own, derivatives, starts, strict=True)):
        rate = -sp.diff(derivative, z)
        drive = sp.expand(derivative + rate * z)
        known = [*(symbols[name] for name in arguments), *own[:i], *coefficients]
        parts = (sp.lambdify(known, sp.simplify(e), "numpy") for e in (drive, rate, start))
        single.append(_SingleState(*parts))
    return OwnStates(tuple(single), None)


def _follow(
    state: _SingleState, arguments: Sequence[FloatArray], coefficients: Sequence[float]
) -> FloatArray:
    """Integrate one state; exact if the drive is linear and the rate constant within a step."""
    times = arguments[0]
    drive, rate, start = (
        _along(function, arguments, coefficients)
        for function in (state.drive, state.rate, state.start)
    )
    if not rate.any():
        return np.asarray(start[0] + cumulative_trapezoid(drive, times, initial=0))
    h = np.diff(times)
    b = 0.5 * (rate[1:] + rate[:-1])
    bh = np.maximum(b * h, 1e-9)
    decay = np.exp(-bh)
    settled = -np.expm1(-bh) / bh  # mean of the decay over the step
    first = h * (settled - (1.0 - settled) / bh)
    last = h * (1.0 - settled) / bh
    pushed = first * drive[:-1] + last * drive[1:]
    (z,) = _recursion(decay[:, None, None], pushed[:, None], start[:1])
    return np.asarray(z)


def _follow_coupled(
    states: _CoupledStates, arguments: Sequence[FloatArray], coefficients: Sequence[float]
) -> FloatArray:
    """Integrate coupled states, (states, n); exact if the drives are linear within a step.

    Steps of the same length share their matrices. All matrices are computed at once.
    """
    times = arguments[0]
    matrix = np.asarray(states.matrix(*coefficients), float)
    drives = np.array([_along(f, arguments, coefficients) for f in states.drives])
    start = np.array([_along(f, arguments, coefficients)[0] for f in states.starts])
    lengths = np.diff(times)
    # differences between equally spaced times differ in their last bits
    unit = 10.0 ** np.floor(np.log10(lengths)) * EQUAL_STEPS
    steps, which = np.unique(np.rint(lengths / unit) * unit, return_inverse=True)
    by = step_matrices(matrix, steps)
    forced = np.matmul(by.from_first[which], drives.T[:-1, :, None])
    forced += np.matmul(by.from_last[which], drives.T[1:, :, None])
    return _recursion(by.keep[which], forced[:, :, 0], start)


def _recursion(keep: FloatArray, pushed: FloatArray, start: FloatArray) -> FloatArray:
    """(x, n): solve z' = keep z + pushed in the core, with (n - 1, x, x) and (n - 1, x) arrays.

    The core starts from 0, so an extra first step sets the start as its second value.
    """
    count, x = pushed.shape
    first = np.zeros((count + 1, x, x))
    first[1:] = keep
    values = np.zeros((count + 2, x, 1))
    values[:-1, :, 0] = np.vstack([start, pushed])
    unit = np.broadcast_to(np.eye(x), first.shape)
    found = propagate(StepMatrices(first, unit, np.zeros_like(first)), values)
    return np.ascontiguousarray(found[1:, :, 0].T)


def _along(
    function: Function, arguments: Sequence[FloatArray], coefficients: Sequence[float]
) -> FloatArray:
    """Evaluate a function at all times, even if its result is constant."""
    value = np.asarray(function(*arguments, *coefficients), float)
    return np.broadcast_to(value, len(arguments[0]))


_ARGUMENTS = ("t", "s", "v", "w")


class FormArguments(NamedTuple):
    """Arguments of a form: time, the signal at the site, and its variables; all (n,)."""

    t: FloatArray
    s: FloatArray
    v: FloatArray
    w: FloatArray


@dataclass(frozen=True)
class ArrayForm:
    """A form of the library as numpy functions.

    Attributes
    ----------
    strengths
        Coefficients that switch the effect off at 0 and in which the equation is smooth there.
        Empty if the effect, such as a dead zone, can only be switched on by a finite amount.
    mirrored
        At a pair of derivatives, each strength acts on both.
    """

    form: EffectForm
    strengths: tuple[str, ...]
    mirrored: bool
    _change: tuple[Function, ...]
    _back: tuple[Function, ...]
    _states: OwnStates

    def directions(self, signals: FormArguments, values: Mapping[str, float]) -> FloatArray:
        """(n, d): the added term per unit of each strength, or the whole finite change.

        At a pair, a strength acts on only one of the derivatives unless the form is `mirrored`.
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
            own = self._states.follow(signals, tuple(values.values()))
            columns = [f(*signals, *own, *values.values()) for f in functions]
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
    neutral = [symbols[c.name] for c in form.coefficients if c.neutral == 0.0 and not c.scale]
    order = [symbols[name] for name in names]
    mirrored = any(reaction.has(k) and equation.has(k) for k in neutral)
    added = equation if mirrored else equation + reaction  # otherwise no strength is in both
    slopes = [_slope(added, k, neutral) for k in neutral]
    smooth = bool(slopes) and not _has_kinks(added, neutral) and all(s != 0 for s in slopes)
    changes = slopes if smooth else [equation - symbols["s"]]
    backs = [_slope(reaction, k, neutral) for k in neutral] if mirrored else []
    return ArrayForm(
        form=form,
        strengths=tuple(str(k) for k in neutral) if smooth else (),
        mirrored=mirrored,
        _change=tuple(sp.lambdify(order, change, "numpy") for change in changes),
        _back=tuple(sp.lambdify(order, back, "numpy") for back in backs),
        _states=own_states_of(form, _ARGUMENTS, symbols, where),
    )


def _slope(equation: sp.Expr, strength: sp.Symbol, strengths: Collection[sp.Symbol]) -> sp.Expr:
    """Return the derivative of an equation with respect to a strength, at zero strengths."""
    slope = sp.diff(equation, strength)
    return slope.subs(dict.fromkeys(strengths, 0)) if slope.has(*strengths) else slope


def _has_kinks(equation: sp.Expr, strengths: Collection[sp.Symbol]) -> bool:
    """Return whether an equation has a kink in a strength."""
    kinks = equation.atoms(sp.Piecewise, sp.Min, sp.Max, sp.Abs)
    return any(kink.free_symbols & set(strengths) for kink in kinks)
