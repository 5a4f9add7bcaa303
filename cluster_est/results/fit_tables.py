"""The tables of a fit: a class for the rows of each table, and functions that make them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.methods.method import TOLERANCE, OtherPoint, Solution
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import scope_of
from cluster_est.results.output_errors import Simulation
from cluster_est.running.multistart import MultistartResult
from cluster_est.running.search_state import assemble_evaluation
from cluster_est.uncertainty import ConfidenceInterval, Uncertainty
from workers.messages import FloatArray
from workers.messages.types import by_content


@by_content
@dataclass(frozen=True)
class Estimate:
    """One estimated value, a row of parameters.parquet.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" if the parameter has its own value in experiment exp5.
    parameter, variable, unit
        The parameter of this value, and the FMU's name and unit for it.
    scope
        "shared", or the experiment or group of the value.
    value, start, lower, upper
        Estimate, start value and bounds in physical units.
    std_error, lower95, upper95
        Standard error and 95 % interval; NaN if the data do not determine the value, or if it is at
        a bound.
    error_white, error_autoregression, error_experiments
        The standard error for white noise, for autoregressive noise, and from the scatter of the
        experiments; NaN if it was not computed. `std_error` is one of them.
    at_bound
        "lower", "upper" or "".
    difference_step
        Step of the last finite difference, in search coordinates; NaN if there was none.
    estimated_on
        "train", or "test" for a value that belongs only to a test record; "known" if fixed,
        "derived" if computed from others.
    description
        The FMU's description of the parameter; "" if it has none.
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
    description: str = ""

    @property
    def stderr(self) -> float:
        """The standard error, under its name in SciPy and lmfit."""
        return self.std_error

    @property
    def interval(self) -> tuple[float, float]:
        """The ends of the 95 % interval, in the unit of `value`; NaN if there is none."""
        return self.lower95, self.upper95


@dataclass(frozen=True)
class ConstraintValue:
    """One constraint, a row of constraints.parquet.

    `before` is at the start values, `after` at the estimates; both are divided by the constraint's
    scale. They must be at most 0 if `kind` is "<= 0", and 0 if `kind` is "= 0". NaN if a simulation
    failed.
    """

    constraint: str
    kind: str
    before: float
    after: float
    satisfied: bool


@dataclass(frozen=True)
class StartResult:
    """One start of a multi-start, a row of starts.parquet.

    Attributes
    ----------
    start
        Number of the start; start 0 uses the parameters' start values.
    cost, ending, iterations
        Cost, kind of ending and number of iterations of the search.
    minimum
        Number of the minimum that was reached; 0 is the best minimum, -1 means none.
    """

    start: int
    cost: float
    ending: str
    iterations: int
    minimum: int


@dataclass(frozen=True)
class PointValue:
    """A value at one of several points, a row of minima.parquet or front.parquet.

    `point` is the number of the point, the best first. `objectives` are the separate costs of a
    method with several objectives.
    """

    point: int
    label: str
    value: float
    cost: float
    objectives: tuple[float, ...] = ()


@by_content
@dataclass(frozen=True)
class EffectCurve:
    """The curve of an effect: the added term as a function of its only variable.

    Attributes
    ----------
    effect, part
        Name and site of the effect: "der(v)", "der(v) while v > 0". A pair has two curves.
    variable, variable_unit, unit
        The variable, its unit, and the unit of the term; "" if the FMU declares no unit.
    x, y, lower, upper : (n,)
        The curve and its 95 % band, to first order in the coefficients; the band is NaN if the data
        do not determine a coefficient.
    edges : (bins + 1,)
    counts : (bins,)
        Samples of the training experiments in each bin; both are empty for a filter's responses.
    free_x, free_y, free_error : (places,)
        The term that the residuals suggest without a form, and its standard error, at a few places;
        empty if it was not computed.
    why_not
        A sentence: why there is no curve; the arrays are then empty.
    integral_of
        The state whose integral the variable is (except for a factor); for a difference, the
        difference of two such states: "v - w" for "x - z". "" if there is none.
    positive
        A variable whose sign switches the effect; the curve applies if it is positive. "" if there
        is none.
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


OF_INTERVALS = (
    "at_bound", "std_error", "lower95", "upper95", "error_white", "error_autoregression",
    "error_experiments",
)  # fmt: skip
"""Fields that an estimate copies from the interval of its unknown."""


def estimates(
    space: SearchSpace,
    solution: Solution,
    role: str,
    units: dict[str, str],
    found: Sequence[ConfidenceInterval],
) -> list[Estimate]:
    """Return the estimated values with their intervals."""
    rows = []
    steps = solution.difference_steps
    for i, unknown in enumerate(space.unknowns):
        value = unknown.to_physical(float(solution.x[i]))
        rows.append(
            replace(
                _known(unknown.parameter, units, value, role),
                label=unknown.label,
                scope=unknown.scope or "shared",
                start=unknown.start,
                difference_step=np.nan if steps is None else float(steps[i]),
                **{name: getattr(found[i], name) for name in OF_INTERVALS},
            )
        )
    return rows


def derived(
    space: SearchSpace, solution: Solution, units: dict[str, str], uncertainty: Uncertainty
) -> list[Estimate]:
    """Return the parameters that are computed from others, with intervals to first order."""
    rows = []
    spread = {each.label: each for each in uncertainty.derived}
    parameters = {p.name: p for p in space.problem.parameters}
    for label, value in space.derived(solution.x).items():
        name = label if label in parameters else label.rpartition("[")[0]
        known = _known(parameters[name], units, value, "derived")
        known = replace(known, label=label, scope=scope_of(label, name) or "shared")
        if (each := spread.get(label)) is not None:
            known = replace(
                known, std_error=each.std_error, lower95=each.lower95, upper95=each.upper95
            )
        rows.append(known)
    return rows


def fixed(problem: Problem, units: dict[str, str]) -> list[Estimate]:
    """Return the parameters that were fixed at their start values."""
    return [_known(p, units, p.start, "known") for p in problem.parameters if p.fixed]


def _known(parameter: Parameter, units: dict[str, str], value: float, how: str) -> Estimate:
    """Return a row for a parameter that was not estimated."""
    return Estimate(
        label=parameter.name,
        parameter=parameter.name,
        variable=parameter.target,
        unit=parameter.unit or units.get(parameter.target, ""),
        scope="shared",
        value=value,
        start=parameter.start,
        lower=parameter.lower,
        upper=parameter.upper,
        scale=parameter.scale,
        at_bound="",
        std_error=np.nan,
        lower95=np.nan,
        upper95=np.nan,
        error_white=np.nan,
        error_autoregression=np.nan,
        error_experiments=np.nan,
        difference_step=np.nan,
        estimated_on=how,
    )


def constraints(
    space: SearchSpace, solution: Solution, before: list[Simulation], after: list[Simulation]
) -> tuple[ConstraintValue, ...]:
    """Return all constraints on the training experiments, at the start values and estimates."""
    if not space.constraint_names:
        return ()
    then, now = (
        _judged(space, x, each) for x, each in ((space.start, before), (solution.x, after))
    )
    rows = []
    for i, name in enumerate(space.constraint_names):
        equal = bool(space.equality[i])
        value = float(now[i])
        kept = (abs(value) if equal else value) <= TOLERANCE
        kind = "= 0" if equal else "<= 0"
        rows.append(ConstraintValue(name, kind, float(then[i]), value, kept))
    return tuple(rows)


def constraints_at_start(space: SearchSpace, simulations: list[Simulation]) -> tuple[float, ...]:
    """Return all constraints on the training experiments at the start values, over their scales."""
    return tuple(_judged(space, space.start, simulations).tolist())


def _judged(space: SearchSpace, x: FloatArray, simulations: list[Simulation]) -> FloatArray:
    """Return the constraints at x; NaN if a simulation failed."""
    outcomes = tuple(simulations[e].outcome for e in space.experiments)
    found = assemble_evaluation(space, x, outcomes, 0).constraints
    return found if len(found) else np.full(len(space.constraint_names), np.nan)


def starts_and_minima(
    space: SearchSpace, found: MultistartResult
) -> tuple[tuple[StartResult, ...], tuple[PointValue, ...]]:
    """Return the rows of all starts and of their minima; none if there was only one start."""
    if len(found.solutions) < 2:
        return (), ()
    numbered = enumerate(zip(found.solutions, found.minimum, strict=True))
    starts = tuple(
        StartResult(i, s.cost, s.ending.name.lower(), s.iterations, minimum)
        for i, (s, minimum) in numbered
    )
    minima = [OtherPoint(found.solutions[i].x, found.solutions[i].cost) for i in found.minima]
    return starts, points(space, tuple(minima))


def points(space: SearchSpace, others: tuple[OtherPoint, ...]) -> tuple[PointValue, ...]:
    """Return the rows of several points, one for each value."""
    return tuple(
        PointValue(i, label, value, other.cost, other.objectives)
        for i, other in enumerate(others)
        for label, value in space.estimates(other.x).items()
    )


def coefficient_units(problem: Problem) -> dict[str, str]:
    """Return units of the effects' coefficients by "EFFECT.COEFFICIENT"; "" for unknown units."""
    if not problem.effects:
        return {}
    from workers.effects import definition, units  # SymPy takes long to import

    description = problem.describe()
    found: dict[str, str] = {}
    for effect in definition.define_all(
        problem.effects, description, problem.model.interface, problem.experiments
    ):
        names = [f"{effect.effect.name}.{c.name}" for c in effect.form.coefficients]
        texts = units.coefficient_units(effect, description, problem.signal_units)
        pairs = zip(names, texts, strict=True)
        found |= {name: "" if units.UNKNOWN_UNIT in unit else unit for name, unit in pairs}
    return found
