"""The rows of the tables of a fit, one class each."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from workers.messages import FloatArray
from workers.messages.types import by_content


@dataclass(frozen=True)
class Estimate:
    """One estimated number, a row of parameters.parquet.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" where the parameter has a value of its own there.
    parameter, variable, unit
        The parameter that it belongs to, the FMU's name and unit for it.
    scope
        "shared", or the experiment or group that the value is for.
    value, start, lower, upper
        Physical values.
    std_error, lower95, upper95
        NaN where the data do not determine the value, or hold it at a bound.
    error_white, error_autoregression, error_experiments
        The standard error for white noise, for noise that is an autoregression, and from the
        scatter of the experiments; NaN where there is none. `std_error` is one of them.
    at_bound
        "lower", "upper" or "".
    difference_step
        Step of the last finite difference, in search coordinates; NaN if there was none.
    estimated_on
        "train", or "test" for a value that belongs to a test record alone; "known" if fixed,
        "derived" if it follows from others.
    """

    label: str
    parameter: str
    variable: str
    unit: str
    scope: str
    value: float
    start: float
    lower: float
    upper: float
    scale: str
    at_bound: str
    std_error: float
    lower95: float
    upper95: float
    error_white: float
    error_autoregression: float
    error_experiments: float
    difference_step: float
    estimated_on: str


@dataclass(frozen=True)
class ConstraintValue:
    """One constraint, a row of constraints.parquet.

    `before` and `after` are at the start and at the estimates, in units of the constraint's scale:
    at most 0 where `kind` is "<= 0", 0 where it is "= 0". NaN where a simulation failed.
    """

    constraint: str
    kind: str
    before: float
    after: float
    satisfied: bool


@dataclass(frozen=True)
class StartResult:
    """One start of several, a row of starts.parquet.

    Attributes
    ----------
    start
        Its number; 0 is the parameters' own.
    cost, ending, iterations
        Of its search.
    minimum
        Number of the minimum that it reached, 0 being the best; -1 if it reached none.
    """

    start: int
    cost: float
    ending: str
    iterations: int
    minimum: int


@dataclass(frozen=True)
class PointValue:
    """A value at one of several points worth keeping, a row of minima.parquet or front.parquet.

    `point` numbers them, the best first; `objectives` are costs kept apart.
    """

    point: int
    label: str
    value: float
    cost: float
    objectives: tuple[float, ...] = ()


@by_content
@dataclass(frozen=True)
class EffectCurve:
    """The curve of an effect: what it adds, as a function of the one variable that it depends on.

    Attributes
    ----------
    effect, part
        Its name, and the site: "der(v)", "der(v) while v > 0". A pair has two of them.
    variable, variable_unit, unit
        Its argument, and both units; "" where the FMU names none.
    x, y, lower, upper : (n,)
        The curve and its 95 % band, to first order in the coefficients; NaN where the data do not
        determine one of them.
    edges : (bins + 1,)
    counts : (bins,)
        Samples of the training experiments in each bin.
    free_x, free_y, free_error : (places,)
        What the residuals ask for without any form, and its standard error, at a few places; empty
        where that was not computed.
    why_not
        Reason why it has no curve, in a sentence; the arrays are empty then.
    integral_of
        The state whose integral the variable is, but for a factor, or the difference of two for a
        difference: "v - w" for "x - z". "" where it is none.
    positive
        A variable that switches the effect with its sign: the curve holds where it is positive. ""
        without one.
    """

    effect: str
    part: str
    variable: str = ""
    variable_unit: str = ""
    unit: str = ""
    x: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    y: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    lower: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    upper: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    edges: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    counts: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    free_x: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    free_y: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    free_error: FloatArray = field(default_factory=lambda: np.zeros(0), repr=False)
    why_not: str = ""
    integral_of: str = ""
    positive: str = ""
