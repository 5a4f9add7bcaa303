"""What a form is made of: its equation, its coefficients, and what a search must know of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

SiteKind = Literal["derivative", "pair", "input", "output", "parameter"]


@dataclass(frozen=True)
class FormCoefficient:
    """A parameter of a form.

    Attributes
    ----------
    name
        As in the equation.
    neutral
        The value at which the effect does nothing, whatever the shape parameters are. None for a
        shape parameter: a threshold, a width, a frequency.
    positive
        Whether physics wants it positive.
    if_own
        That it must be positive holds only where the form's variable is the state at whose
        derivative it acts: a drag on oneself takes energy out, one by another may push.
    scale
        What the entries of `grid` are multiples of, on the data at hand. "" for a strength, which
        needs no grid. "rms v", "max v" (of the absolute value), "mean v", "mean |v|", "mean v^2",
        "travel v" (rms of the integral of v about its mean), "quantile v" (entries are
        quantiles), "low v" and "high v" (its 1 % and 99 % quantiles) of the form's variable;
        "rms s", "max s", "range s" (entries are parts of the way from min s to max s) of the
        signal; "step" (the sampling interval), "middle t" (of the experiment), "spectrum" (angular
        frequency of a peak in the residual's spectrum).
    grid
        Multiples of that scale that a search tries.
    held
        Whether it stays at its value of the grid when the effect is fitted.
    unit
        In the words that `workers.effects.units` knows, such as "site / v^2".
    """

    name: str
    neutral: float | None = 0.0
    positive: bool = False
    if_own: bool = False
    scale: str = ""
    grid: tuple[float, ...] = ()
    held: bool = False
    unit: str = ""


@dataclass(frozen=True)
class OwnState:
    """A state that a form brings along: its derivative and its value at the start."""

    name: str
    derivative: str
    start: str


@dataclass(frozen=True)
class EffectForm:
    """One physically named effect.

    Attributes
    ----------
    name, family
        "coulomb", "friction".
    kinds
        Sites at which it makes sense.
    equation
        See `workers.effects.forms`.
    coefficients
        Its own parameters.
    variables
        How many variables it is a function of: 0, 1 or 2.
    states
        Its own states.
    reaction
        At a pair of derivatives: what is added to the second.
    memory
        Name of what it does to the signal as a whole, see `workers.effects.memory`, with its first
        coefficient; the equation then is "s".
    when
        Words that say on which data a search should try it: "oscillates" (its variable, or the
        signal where it has none, clearly takes both signs), "positive" (never negative), "own"
        (its variable is the state at whose derivative it acts), "first" (its variable is the first
        state of the pair), "driven" (its variable is an input or a measured signal).
        All must hold; "" always does.
    order
        Which name wins where data do not tell two apart: the lower.
    """

    name: str
    family: str
    kinds: tuple[SiteKind, ...]
    equation: str
    coefficients: tuple[FormCoefficient, ...]
    variables: int = 0
    states: tuple[OwnState, ...] = ()
    reaction: str = ""
    memory: str = ""
    when: str = ""
    order: float = 0.0


def positive(coefficient: FormCoefficient, *, own: bool) -> bool:
    """Whether physics wants a coefficient positive.

    Parameters
    ----------
    coefficient
        Of a form.
    own
        Whether the form's variable is the state at whose derivative the effect acts.
    """
    return coefficient.positive and (own or not coefficient.if_own)
