"""Forms of effects as functions over whole signals, for looking at many candidates at once.

A worker makes byte code of an effect before it simulates with it. To rank hundreds of candidates
nothing is simulated: their equations are evaluated along signals that are already there.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import sympy as sp

from cluster_est.closed_loop.candidates.own_states import Function, OwnStates, own_states_of
from workers.effects.expression import parse
from workers.effects.forms import EffectForm
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.messages import FloatArray

_ARGUMENTS = ("t", "s", "v", "w")


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
    _states: OwnStates

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
            own = self._states.follow(signals.arrays, tuple(values.values()))
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
    """Return by how much an equation changes with a strength, with all of them at 0."""
    slope = sp.diff(equation, strength)
    return slope.subs(dict.fromkeys(strengths, 0)) if slope.has(*strengths) else slope


def _has_kinks(equation: sp.Expr, strengths: Collection[sp.Symbol]) -> bool:
    """Return whether an equation has a kink in a strength."""
    kinks = equation.atoms(sp.Piecewise, sp.Min, sp.Max, sp.Abs)
    return any(kink.free_symbols & set(strengths) for kink in kinks)
