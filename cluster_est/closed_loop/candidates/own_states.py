"""Own states of forms, followed along signals that are already there."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from scipy.integrate import cumulative_trapezoid

from cluster_est.closed_loop.candidates.step_matrices import (
    StepMatrices,
    propagate,
    step_matrices,
)
from workers.effects.expression import parse
from workers.effects.forms import EffectForm
from workers.messages import FloatArray

RELATIVE = 1e-9
"""Of a power of ten: steps that differ by less are one."""

Function = Callable[..., Any]
"""Of the arguments of a form, each (n,), and then of its coefficients."""


@dataclass(frozen=True)
class _SingleState:
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
class OwnStates:
    """The own states of a form: each by itself, or all together if they act on each other."""

    _single: tuple[_SingleState, ...]
    _coupled: _CoupledStates | None

    def follow(
        self, arguments: Sequence[FloatArray], coefficients: Sequence[float]
    ) -> list[FloatArray]:
        """Return each state along the arguments, of which the first is the time."""
        if self._coupled is not None:
            return list(_follow_coupled(self._coupled, arguments, coefficients))
        return [_follow(state, arguments, coefficients) for state in self._single]


def own_states_of(
    form: EffectForm, arguments: Sequence[str], symbols: Mapping[str, sp.Symbol], where: str
) -> OwnStates:
    """Make the own states of a form of the library, which are linear in themselves.

    Parameters
    ----------
    form
        Of the library.
    arguments
        Names of the arguments of its equation.
    symbols
        By name: of arguments, states and coefficients.
    where
        What a message calls it.
    """
    own = [symbols[z.name] for z in form.states]
    derivatives = [parse(z.derivative, symbols, where) for z in form.states]
    starts = [parse(z.start, symbols, where) for z in form.states]
    coefficients = [symbols[c.name] for c in form.coefficients]
    order = [*(symbols[name] for name in arguments), *coefficients]
    others = [set(own) - {z} for z in own]
    if any(d.free_symbols & rest for d, rest in zip(derivatives, others, strict=True)):
        matrix = sp.Matrix(derivatives).jacobian(own)
        drives = sp.simplify(sp.Matrix(derivatives) - matrix * sp.Matrix(own))
        coupled = _CoupledStates(
            sp.lambdify(coefficients, matrix, "numpy"),
            tuple(sp.lambdify(order, drive, "numpy") for drive in drives),
            tuple(sp.lambdify(order, start, "numpy") for start in starts),
        )
        return OwnStates((), coupled)
    single = []
    for z, derivative, start in zip(own, derivatives, starts, strict=True):
        rate = -sp.diff(derivative, z)
        drive = sp.expand(derivative + rate * z)
        parts = (sp.lambdify(order, sp.simplify(e), "numpy") for e in (drive, rate, start))
        single.append(_SingleState(*parts))
    return OwnStates(tuple(single), None)


def _follow(
    state: _SingleState, arguments: Sequence[FloatArray], coefficients: Sequence[float]
) -> FloatArray:
    """Integrate one state: exact where the drive is linear and the rate constant in a step."""
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
    """Integrate states that act on each other, (states, n); exact where the drives are linear.

    Steps of one length share their matrices, which are made for all lengths at once.
    """
    times = arguments[0]
    matrix = np.asarray(states.matrix(*coefficients), float)
    drives = np.array([_along(f, arguments, coefficients) for f in states.drives])
    start = np.array([_along(f, arguments, coefficients)[0] for f in states.starts])
    lengths = np.diff(times)
    # the differences of equal times differ in their last bits
    unit = 10.0 ** np.floor(np.log10(lengths)) * RELATIVE
    steps, which = np.unique(np.rint(lengths / unit) * unit, return_inverse=True)
    by = step_matrices(matrix, steps)
    forced = np.matmul(by.from_first[which], drives.T[:-1, :, None])
    forced += np.matmul(by.from_last[which], drives.T[1:, :, None])
    return _recursion(by.keep[which], forced[:, :, 0], start)


def _recursion(keep: FloatArray, pushed: FloatArray, start: FloatArray) -> FloatArray:
    """(x, n) of z' = keep z + pushed, for (n - 1, x, x) and (n - 1, x), by the core.

    A step before the first one puts the start where a recursion from 0 has its second value.
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
    """Evaluate a function at all times, also one that is constant."""
    value = np.asarray(function(*arguments, *coefficients), float)
    return np.broadcast_to(value, len(arguments[0]))
