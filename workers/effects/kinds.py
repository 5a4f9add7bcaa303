"""The parts of a form: its equation, its coefficients, and the information that a search needs."""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass
from typing import Literal

from workers.effects.laws import Law

SiteKind = Literal["derivative", "pair", "input", "output", "parameter"]


class GridScale(enum.Enum):
    """The unit of the entries of a coefficient's grid, on the data at hand.

    v is the form's variable, or the signal at the site where it has none; s is that signal.
    """

    RMS_V = "rms v"
    MAX_V = "max v"
    """Largest absolute value."""
    MEAN_V = "mean v"
    MEAN_ABSOLUTE_V = "mean |v|"
    MEAN_SQUARE_V = "mean v^2"
    TRAVEL_V = "travel v"
    """Root mean square of the integral of v about its mean."""
    WAVES_V = "waves v"
    """Entries are how often a wave repeats within the range of v; small whole numbers are tried too
    where v is an angle of several turns."""
    WAVES_TRAVEL_V = "waves travel v"
    """Entries are how often a wave repeats within the range of the integral of v from the start of
    each experiment."""
    QUANTILE_V = "quantile v"
    """Entries are quantiles of v."""
    LOW_V = "low v"
    """1 % quantile."""
    HIGH_V = "high v"
    """99 % quantile."""
    LOW_W = "low w"
    """1 % quantile of the form's second variable."""
    HIGH_W = "high w"
    """99 % quantile of it."""
    MAX_W = "max w"
    """Largest absolute value of it."""
    COUPLING = "coupling"
    """How much more than on the first state of a pair what is between the two acts on the second:
    by the derivatives of their rates by each other, 1 where these say nothing."""
    MAX_S = "max s"
    """Largest absolute value."""
    FASTEST_S = "fastest s"
    """Largest rate of change; a jump counts as one from one sample to the next."""
    RANGE_S = "range s"
    """Entries are parts of the way from min s to max s."""
    STEP = "step"
    """The sampling interval."""
    PER_STEP = "1 / step"
    """Multiples of 1 over the sampling interval."""
    MIDDLE_T = "middle t"
    """The middle of the experiment."""
    ABSOLUTE_ZERO = "absolute zero"
    """How far the zero of v's unit lies above absolute zero; for temperatures in K or degC."""
    EXPONENT = "exponent"
    """Entries are exponents of a power law, whatever the data are."""
    NUMBER = "number"
    """Entries are the values themselves, of a coefficient without a unit."""
    SHARE = "share"
    """The same, of shares: between 0 and 1."""
    KELVIN = "kelvin"
    """Entries are in kelvin."""
    DAMPING = "damping"
    """Entries are ratios of damping of what swings: below 1."""
    SPECTRUM = "spectrum"
    """Angular frequency of a peak in the residual's spectrum."""


class FormCondition(enum.Enum):
    """A condition on the data, or on a form's variable, under which a search tries the form."""

    OSCILLATES = "oscillates"
    """Its variable, or the signal where it has none, clearly takes both signs."""
    POSITIVE = "positive"
    """Its variable, or the signal where it has none, is never negative."""
    AMOUNT = "amount"
    """Its variable, or the signal where it has none, is never negative, and no temperature: where
    it is zero there is nothing."""
    OWN = "own"
    """Its variable, the first where it has two, is the state at whose derivative it acts, at an
    input one that this acts on."""
    DIFFERENCE = "difference"
    """Its variable is a difference of two signals."""
    OTHER = "other"
    """Its variable, the first where it has two, is no state that it pushes."""
    FIRST = "first"
    """Its variable is the first state of the pair."""
    FORCE = "force"
    """It acts at an input that acts on the derivatives of several states; its variable is a state.

    Where an input acts on one derivative alone, the same form at that derivative says the same. In
    co-simulation, where derivatives are closed, its variable is what the FMU shows.
    """
    POSITION = "position"
    """Its variable is the integral, but for a factor, of a state that the effect pushes."""
    NO_POSITION = "no position"
    """Its variable is the derivative of no state, and a rate where its unit is known."""
    AROUND = "around"
    """Its two variables are the state at whose derivative it acts and an input of its unit that
    acts on it, such as an ambient temperature; at a pair, its two states if they have one unit."""
    EXCHANGE = "exchange"
    """Its first variable is the difference of a pair's two states, of one unit."""
    FROM_REST = "from rest"
    """The signal at its site is not zero at the start of every experiment: it may have begun then,
    or have been there before."""
    STATE = "state"
    """Its variable is a state, and no difference."""
    DRIVEN = "driven"
    """Its variable is an input or a measured signal."""
    FEEDS = "feeds"
    """Its variables are inputs that act on the output at once, and not by way of states."""


FREE_FAMILY = "table"
"""The family of free curves."""
DYNAMICS_FAMILY = "hidden dynamics"
"""The family of free filters."""
FREE_FAMILIES = (FREE_FAMILY, DYNAMICS_FAMILY)
"""Families of what is a place and no law."""
NOISE_FAMILY = "process noise"
"""The family of noise that acts on states."""


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
        Physics wants it positive.
    if_own
        That it must be positive holds only where the form's variable is the state at whose
        derivative it acts: a drag on oneself takes energy out, one by another may push. At an
        input, where its variable is a state that the input pushes the same way.
    scale
        The unit of the entries of `grid`; None for a strength, which needs no grid.
    grid
        Multiples of that scale that a search tries.
    held
        It stays at its value of the grid when the effect is fitted.
    each
        It has a value of its own in each experiment: what was there when that began.
    unit
        In the words that `workers.effects.definition` knows, such as "site / v^2".
    """

    name: str
    neutral: float | None = 0.0
    positive: bool = False
    if_own: bool = False
    scale: GridScale | None = None
    grid: tuple[float, ...] = ()
    held: bool = False
    each: bool = False
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
    law
        How it depends on its variable: from this, with the units of the site, it has its name.
    kinds
        Sites at which it makes sense.
    equation
        See `workers.effects.forms`.
    coefficients
        Its own parameters.
    variables
        Number of variables that it is a function of: 0, 1 or 2.
    states
        Its own states.
    reaction
        At a pair of derivatives: what is added to the second.
    memory
        Name of what it does to the signal as a whole, see `workers.effects.signal_memory`, with its
        first coefficient; the equation then is "s".
    when
        Conditions under which a search should try it; all must hold.
    order
        The form of lower order is taken where the data do not tell two apart.
    differences
        At a derivative its variable may also be the difference of two states of one unit; others
        are looked for at pairs.
    later
        A search looks at it only where another function of its argument leads, from which it
        differs little: it counts as looked at there alone.
    values
        Of a free curve: the number of points that it is made of.
    finer_than
        Name of the curve with half as many steps, or of the filter of the next lower order: a
        search looks at this one only where that leads.
    twins
        Pairs of coefficients that may change places, all at once, and it does the same. Of the
        first pair the first is the smaller one.
    """

    name: str
    family: str
    law: Law
    kinds: tuple[SiteKind, ...]
    equation: str
    coefficients: tuple[FormCoefficient, ...]
    variables: int = 0
    states: tuple[OwnState, ...] = ()
    reaction: str = ""
    memory: str = ""
    when: tuple[FormCondition, ...] = ()
    order: float = 0.0
    differences: bool = False
    later: bool = False
    values: int = 0
    finer_than: str = ""
    twins: tuple[tuple[str, str], ...] = ()

    def divides_by(self, coefficient: str) -> bool:
        """Return whether an equation of it has a coefficient alone as a divisor: 0 is no value."""
        texts = [self.equation, self.reaction, *(state.derivative for state in self.states)]
        return any(re.search(rf"/ *{coefficient}\b", text) for text in texts)

    @property
    def free(self) -> bool:
        """It is a free curve or a free filter: it fits anything, and explains nothing."""
        return self.family in FREE_FAMILIES

    @property
    def is_dynamics(self) -> bool:
        """It is a free filter of its argument, with hidden states and no known form."""
        return self.family == DYNAMICS_FAMILY

    @property
    def curve_values(self) -> tuple[str | None, ...]:
        """The coefficients that are the values of a free curve, at equal steps from low to high.

        None where it is 0 by definition.
        """
        own = {c.name for c in self.coefficients}
        names = [f"k{i}" for i in range(1, self.values + 1)]
        return tuple(name if name in own else None for name in names)

    @property
    def is_characteristic(self) -> bool:
        """It is a free curve of the very signal that it is added to."""
        return self.values > 0 and not self.variables

    @property
    def is_noise(self) -> bool:
        """It is noise that acts on a state, with its first coefficient as its strength."""
        return self.family == NOISE_FAMILY

    @property
    def of_time_alone(self) -> bool:
        """It is a function of nothing but time: a drift, a wave, what decays from the start."""
        texts = [self.equation, *(z.derivative for z in self.states)]
        signals = self.variables or self.memory or any(re.search(r"\bs\b", t) for t in texts[1:])
        return not signals and (bool(self.states) or re.search(r"\bt\b", texts[0]) is not None)


def positive(coefficient: FormCoefficient, *, own: bool) -> bool:
    """Return whether physics wants a coefficient positive.

    Parameters
    ----------
    coefficient
        Of a form.
    own
        The form's variable is the state at whose derivative the effect acts.
    """
    return coefficient.positive and (own or not coefficient.if_own)
