"""The parts of a form: its equation, its coefficients, and the information that a search needs."""

from __future__ import annotations

import enum
import re
from dataclasses import dataclass
from typing import Literal

from workers.effects.laws import Law

SiteKind = Literal["derivative", "pair", "input", "output", "parameter"]


class GridScale(enum.Enum):
    """The unit of the entries of a coefficient's grid, computed from the data.

    v is the form's variable. If the form has no variable, v is the signal at the site. s is always
    the signal at the site. w is the form's second variable.
    """

    RMS_V = "rms v"
    MAX_V = "max v"
    """Largest absolute value."""
    MEAN_V = "mean v"
    MEAN_ABSOLUTE_V = "mean |v|"
    MEAN_SQUARE_V = "mean v^2"
    TRAVEL_V = "travel v"
    """Root mean square of the integral of v, after its mean is subtracted."""
    WAVES_V = "waves v"
    """Entries are numbers of periods within the range of v. If v is an angle of several turns,
    small whole wave numbers are tried too."""
    WAVES_TRAVEL_V = "waves travel v"
    """Entries are numbers of periods within the range of the integral of v from the start of each
    experiment."""
    QUANTILE_V = "quantile v"
    """Entries are quantiles of v."""
    LOW_V = "low v"
    """1 % quantile."""
    HIGH_V = "high v"
    """99 % quantile."""
    LOW_W = "low w"
    """1 % quantile of w."""
    HIGH_W = "high w"
    """99 % quantile of w."""
    MAX_W = "max w"
    """Largest absolute value of w."""
    COUPLING = "coupling"
    """Ratio of the actions of a pair's two states on each other: the largest derivative of the
    second state's rate by the first state, over the reverse; 1 if one of the two is 0."""
    MAX_S = "max s"
    """Largest absolute value."""
    FASTEST_S = "fastest s"
    """Largest rate of change; a jump counts as a change within one sampling interval."""
    RANGE_S = "range s"
    """Entries are positions between min s (0) and max s (1)."""
    STEP = "step"
    """The sampling interval."""
    PER_STEP = "1 / step"
    """Entries are multiples of 1 over the sampling interval."""
    MIDDLE_T = "middle t"
    """The middle of the experiment."""
    ABSOLUTE_ZERO = "absolute zero"
    """Distance of the zero of v's unit from absolute zero; for temperatures in K or degC."""
    EXPONENT = "exponent"
    """Entries are exponents of a power law, independent of the data."""
    NUMBER = "number"
    """Entries are the values themselves; the coefficient has no unit."""
    SHARE = "share"
    """Entries are shares between 0 and 1."""
    KELVIN = "kelvin"
    """Entries are in kelvin."""
    DAMPING = "damping"
    """Entries are damping ratios of an oscillation; they are below 1."""
    SPECTRUM = "spectrum"
    """Angular frequencies of the peaks in the residual's spectrum."""


class FormCondition(enum.Enum):
    """A condition on the data, or on a form's variable, under which a search tries the form.

    For a form with two variables, "the variable" means the first one.
    """

    OSCILLATES = "oscillates"
    """The variable, or without one the signal at the site, clearly takes both signs."""
    POSITIVE = "positive"
    """The variable, or without one the signal at the site, is never negative."""
    AMOUNT = "amount"
    """The variable, or without one the signal at the site, is never negative and is not a
    temperature, so zero means that nothing is there."""
    OWN = "own"
    """The variable is the state at whose derivative the effect acts. For an effect at an input, it
    is a state whose derivative depends on this input."""
    DIFFERENCE = "difference"
    """The variable is a difference of two signals."""
    OTHER = "other"
    """The variable is not a state on whose derivative the effect acts."""
    FIRST = "first"
    """The variable is the first state of the pair."""
    FORCE = "force"
    """The variable is a state, and the effect's input acts on the derivatives of several states.

    If an input acts on only one derivative, the same form at that derivative is equivalent. In
    co-simulation, derivatives are not accessible, and the variable is an output of the FMU.
    """
    POSITION = "position"
    """The variable is, except for a factor, the integral of a state on which the effect acts."""
    NO_POSITION = "no position"
    """The variable is not the derivative of a state. If its unit is known, it is a rate."""
    AROUND = "around"
    """The variables are the state at whose derivative the effect acts, and an input of the same
    unit that acts on this state, such as an ambient temperature. At a pair, they are the pair's two
    states, if these have the same unit."""
    EXCHANGE = "exchange"
    """The first variable is the difference of the pair's two states, which have the same unit."""
    FROM_REST = "from rest"
    """In some experiment, the signal at the site is not zero at the start. It may have jumped to
    this value at the start, or it may have had this value before."""
    REVERSES = "reverses"
    """In some experiment, the signal at the site clearly rises and falls. An effect that shows only
    when a signal turns cannot otherwise be told from an offset or a characteristic."""
    STATE = "state"
    """The variable is a state and not a difference."""
    DRIVEN = "driven"
    """The variable is an input or a measured signal."""
    FEEDS = "feeds"
    """The variables are inputs that act on the output directly and not through states."""


FREE_FAMILY = "table"
"""The family of free curves."""
DYNAMICS_FAMILY = "hidden dynamics"
"""The family of free filters."""
FREE_FAMILIES = (FREE_FAMILY, DYNAMICS_FAMILY)
"""Families of forms that show where an effect acts, but not which law it follows."""
NOISE_FAMILY = "process noise"
"""The family of random noise that acts on states."""


@dataclass(frozen=True)
class FormCoefficient:
    """A parameter of a form.

    Attributes
    ----------
    name
        As in the equation.
    neutral
        The value at which the effect has no influence, whatever the shape parameters are. None for
        a shape parameter, such as a threshold, a width or a frequency.
    positive
        The coefficient is positive for physical reasons.
    if_own
        `positive` applies only if the form's variable is the state at whose derivative the effect
        acts. A drag by the state's own velocity takes energy out; a drag by another velocity may
        add energy. At an input, the variable must be a state on which the input always acts with
        the same sign.
    scale
        The unit of the entries of `grid`; None for a strength, which needs no grid.
    grid
        Multiples of `scale` that a search tries.
    held
        A fit of the effect does not change the coefficient: it keeps its value from the grid.
    each
        Each experiment has its own value, such as the content of a store at the start.
    unit
        Unit in the words of `workers.effects.units.coefficient_units`, such as "site / v^2".
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
    """An internal state of a form, with its derivative and its initial value."""

    name: str
    derivative: str
    start: str


@dataclass(frozen=True)
class EffectForm:
    """One physically named effect.

    Attributes
    ----------
    name, family
        For example "coulomb" and "friction".
    law
        How the effect depends on its variables. The law and the units of the site give the effect
        its physical name.
    kinds
        Kinds of sites at which the form makes sense.
    equation
        See `workers.effects.forms`.
    variables
        Number of arguments: 0, 1 or 2.
    states
        Internal states.
    reaction
        At a pair of derivatives: the term that is added to the second derivative.
    memory
        Name of a function in `workers.effects.signal_memory` that changes the signal as a whole,
        with the first coefficient; "" for none. The equation is then "s".
    when
        Conditions under which a search tries the form; all must hold.
    order
        If the data cannot distinguish two forms, the form of lower order is chosen.
    differences
        At a derivative, the variable may also be a difference of two states of the same unit. For
        other forms, such differences are tried only at pairs.
    later
        A search tries the form only where another function of the same argument is among the best.
        The form differs little from that function, so it counts as a candidate only there.
    values
        Number of points of a free curve; 0 for other forms.
    finer_than
        Name of the curve with half as many steps, or of the filter of the next lower order. A
        search tries the finer form only where that coarser form is among the best.
    twins
        Pairs of coefficients. If the coefficients of all pairs are exchanged, the effect is the
        same. In the first pair, the first coefficient is the smaller one.
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
        """Return whether an equation divides by a coefficient, so that it cannot be 0."""
        texts = [self.equation, self.reaction, *(state.derivative for state in self.states)]
        return any(re.search(rf"/ *{coefficient}\b", text) for text in texts)

    @property
    def free(self) -> bool:
        """Whether the form is a free curve or filter, which fits any law but does not name it."""
        return self.family in FREE_FAMILIES

    @property
    def is_dynamics(self) -> bool:
        """Whether the form is a free filter of its argument, with hidden states."""
        return self.family == DYNAMICS_FAMILY

    @property
    def curve_values(self) -> tuple[str | None, ...]:
        """The coefficients of a free curve's values at equidistant points, from low to high.

        None for a point at which the curve is 0 by definition.
        """
        own = {c.name for c in self.coefficients}
        names = [f"k{i}" for i in range(1, self.values + 1)]
        return tuple(name if name in own else None for name in names)

    @property
    def is_characteristic(self) -> bool:
        """Whether the form is a free curve of the same signal that it changes."""
        return self.values > 0 and not self.variables

    @property
    def is_noise(self) -> bool:
        """Whether the form is noise on a state; its first coefficient is then the strength."""
        return self.family == NOISE_FAMILY

    @property
    def of_time_alone(self) -> bool:
        """Whether the form depends only on time: a drift, a wave, a decay from the start."""
        texts = [self.equation, *(z.derivative for z in self.states)]
        signals = self.variables or self.memory or any(re.search(r"\bs\b", t) for t in texts[1:])
        return not signals and (bool(self.states) or re.search(r"\bt\b", texts[0]) is not None)


def positive(coefficient: FormCoefficient, *, own: bool) -> bool:
    """Return whether a coefficient is positive for physical reasons.

    Parameters
    ----------
    coefficient
        A coefficient of a form.
    own
        Whether the form's variable is the state at whose derivative the effect acts.
    """
    return coefficient.positive and (own or not coefficient.if_own)
