"""Shapes of effects: the added term over its argument with a band, in the range of the data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import sympy as sp

from cluster_est.results.fit_tables import EffectCurve, Estimate
from cluster_est.results.result import Result
from cluster_est.results.shapes.filter_responses import (
    bode_plot,
    settled_after,
    shown_frequencies,
    step_response,
)
from workers.core.assemble import TIME_SYMBOL
from workers.effects.definition import (
    SIGNAL_SYMBOL,
    EffectDefinition,
    define_all,
    variable_symbol,
)
from workers.effects.site import EffectSite, difference, own_variable, parts_of, split_variable
from workers.effects.units import per_second
from workers.fmu.description import ModelDescription
from workers.messages import FloatArray


def covariance_of(result: Result, coefficients: Sequence[Estimate]) -> FloatArray:
    """Return the covariance of coefficients: (coefficients, coefficients).

    Fixed coefficients have no variance. Derived coefficients vary with the parameters of the effect
    from which they are computed.
    """
    if any(e.estimated_on == "derived" for e in coefficients):
        begin = f"{coefficients[0].label.rpartition('.')[0]}."
        own = [e for e in result.estimates if e.label.startswith(begin)]
        free = [e for e in own if e.estimated_on != "derived" and e.label == e.parameter]
        slopes = _derivatives(result, coefficients, free)
        return np.asarray(slopes @ covariance_of(result, free) @ slopes.T)
    labels = [e.label for e in coefficients]
    known = result.uncertainty
    shared = () if known is None else known.shared
    errors = np.array([0.0 if e.estimated_on == "known" else e.std_error for e in coefficients])
    correlations = np.eye(len(labels))
    for i, one in enumerate(labels):
        for j, other in enumerate(labels[:i]):
            if known is not None and one in shared and other in shared:
                found = known.correlations[shared.index(one), shared.index(other)]
                correlations[i, j] = correlations[j, i] = found
    return np.asarray(correlations * errors * errors[:, None])


def _derivatives(
    result: Result, coefficients: Sequence[Estimate], free: Sequence[Estimate]
) -> FloatArray:
    """Return the derivatives of coefficients by the free parameters: (coefficients, free).

    The expressions of derived coefficients are linear, so differences are exact.
    """
    problem, count = result.problem, len(free)
    values = {e.label: np.full(1 + count, e.value) for e in result.estimates}
    columns = {p.name: values.get(p.name, np.full(1 + count, p.start)) for p in problem.parameters}
    sizes = np.array([max(abs(e.value), 1.0) for e in free])
    for i, each in enumerate(free):
        columns[each.label][1 + i] += sizes[i]
    for i, formula in problem.derived:
        columns[problem.parameters[i].name] = formula.values(columns, 1 + count)
    found = np.array([columns[e.label] for e in coefficients])
    return np.asarray((found[:, 1:] - found[:, :1]) / sizes)


POINTS, ARGUMENT_BINS = 201, 48
UNKNOWN_ARGUMENT = "nothing is known of"
"""Start of the reason if the values of an argument are not known."""
BAND_QUANTILE = 1.959963984540054
"""The 97.5 % quantile of the normal distribution, half the width of a 95 % band."""
VisitedValues = Callable[[EffectSite, str], FloatArray]
"""Returns the values of a variable at a site in the training experiments; empty if unknown."""
Shape = Callable[[FloatArray, FloatArray], FloatArray]
"""The added term of an effect as a function of its argument and its coefficients."""


@dataclass(frozen=True)
class EffectShape:
    """One part of an effect as a function of its only variable.

    Attributes
    ----------
    target
        The state, input, output or parameter on which it acts.
    argument
        The name of the variable; "time" for the time.
    shape
        The function.
    positive
        A variable whose sign switches the effect; the function applies if it is positive. "" if
        there is none.
    """

    target: str
    argument: str
    shape: Shape = field(repr=False)
    positive: str = ""


def effect_shapes(
    result: Result, description: ModelDescription, visited: VisitedValues
) -> tuple[EffectCurve, ...]:
    """Compute the curves of all effects of a fitted model.

    Parameters
    ----------
    result
        The result, with the coefficients and their covariance.
    description
        Description of the FMU, for units.
    visited
        Returns the values of variables in the training experiments.
    """
    definitions = _definitions(result, description)
    return tuple(c for d in definitions for c in _curves(d, result, description, visited))


def shape_over(
    curve: EffectCurve, result: Result, description: ModelDescription
) -> Callable[[FloatArray], FloatArray] | None:
    """Return the added term of an effect over its variable, also outside the range of the data.

    None if the effect has no curve, depends on the sign of another variable, changes a parameter,
    or has internal states. For a signal that is replaced by a function of itself, the signal is
    subtracted.
    """
    found = next(
        (d for d in _definitions(result, description) if d.effect.name == curve.effect), None
    )
    if curve.why_not or curve.positive or found is None or found.site.kind == "parameter":
        return None
    if found.states:
        return None
    part = part_shapes(found)[0]
    values = np.array([e.value for e in coefficient_estimates(found, result)])
    of_itself = not found.site.at_rates and part.argument == part.target

    def added(x: FloatArray) -> FloatArray:
        return part.shape(x, values) - (x if of_itself else 0.0)

    return added


def _definitions(result: Result, description: ModelDescription) -> list[EffectDefinition]:
    problem = result.problem
    shown = (effect for effect in problem.effects if not effect.is_noise)
    return define_all(shown, description, problem.model.interface, problem.experiments)


def _none(definition: EffectDefinition, why: str) -> EffectCurve:
    return EffectCurve(definition.effect.name, str(definition.site), why_not=why)


def _curves(
    definition: EffectDefinition,
    result: Result,
    description: ModelDescription,
    visited: VisitedValues,
) -> list[EffectCurve]:
    if definition.form.is_dynamics and _is_one(definition, result):
        return _filter_curves(definition, result, description)
    if definition.form.memory or definition.states:
        why = "the effect depends on the past, so it is not a curve over one variable"
        return [_none(definition, why)]
    if not _is_one(definition, result):
        return [_none(definition, "the coefficients of the effect differ between experiments")]
    signal = next((e.value for e in result.estimates if e.label == definition.site.target), 1.0)
    parts = part_shapes(definition, signal)
    if not parts:
        return [_none(definition, "the effect is not a function of one variable")]
    found = []
    for part in parts:
        seen = visited(definition.site, part.argument)
        seen = seen[np.isfinite(seen)]
        if len(seen):
            x = np.linspace(float(seen.min()), float(seen.max()), POINTS)
            curve = _curve(definition, part, x, result, description)
            if not curve.why_not:
                counts, edges = np.histogram(seen, ARGUMENT_BINS)
                curve = replace(curve, edges=edges, counts=counts.astype(np.float64))
            found.append(curve)
        else:
            found.append(_none(definition, f"{UNKNOWN_ARGUMENT} {part.argument}"))
    return found


def _filter_curves(
    definition: EffectDefinition, result: Result, description: ModelDescription
) -> list[EffectCurve]:
    """Return the step response of a free filter until it has settled, its magnitude and phase."""
    form, site = definition.form, definition.site
    values = np.array([e.value for e in coefficient_estimates(definition, result)])
    own = own_variable(site) if site.at_rates else site.target
    given = next(iter(definition.effect.variables), own)
    train = [e for e in result.problem.experiments if e.role == "train"]
    times = np.linspace(0.0, settled_after(form, values), POINTS)
    frequencies = np.geomspace(*shown_frequencies(form, values, train), POINTS)

    def curve(
        response: Shape, x: FloatArray, argument: str, variable_unit: str, unit: str = ""
    ) -> EffectCurve:
        part = EffectShape(site.target, argument, response)
        found = _curve(definition, part, x, result, description)
        return replace(found, variable_unit=variable_unit, unit=unit or found.unit)

    magnitude, phase = bode_plot(form)
    sine = f"frequency of a sine in {given}"
    return [
        curve(step_response(form), times, f"time after a step of {given} by 1", "s"),
        curve(magnitude, frequencies, sine, "Hz", "dB"),
        curve(phase, frequencies, sine, "Hz", "deg"),
    ]


def part_shapes(definition: EffectDefinition, signal: float = 1.0) -> list[EffectShape]:
    """Return a function for each part of an effect; none if a part has more than one variable.

    Parameters
    ----------
    definition
        Definition of an effect without memory and internal states.
    signal
        The value of the parameter, for an effect on a parameter.
    """
    found = []
    for target, equation in definition.equations:
        positive, made = "", _part(definition, equation, signal)
        if made is None:
            positive, made = _while_positive(definition, equation, signal)
        if made is None:
            return []
        argument, symbol, shown = made
        shape = _compiled(definition, shown, symbol)
        found.append(EffectShape(target, argument, shape, positive))
    return found


def _part(
    definition: EffectDefinition, equation: sp.Expr, signal: float
) -> tuple[str, sp.Symbol, sp.Expr] | None:
    """Return the name and the symbol of a part's argument, and its added term.

    If an effect replaces a signal by a function of the signal only, return the new signal.
    """
    site = definition.site
    if site.kind == "parameter":
        equation = equation.subs(SIGNAL_SYMBOL, signal)
    elif not site.at_rates and _arguments(definition, equation) != {SIGNAL_SYMBOL}:
        equation = sp.expand(equation - SIGNAL_SYMBOL)
    used = _arguments(definition, equation)
    if used == {TIME_SYMBOL}:
        return "time", TIME_SYMBOL, equation
    if used == {SIGNAL_SYMBOL}:
        return site.target, SIGNAL_SYMBOL, equation
    if len(used) == 1:
        (symbol,) = used
        return str(symbol).removeprefix("fmu:"), symbol, equation
    return _difference(definition, equation) if len(used) == 2 else None


def _while_positive(
    definition: EffectDefinition, equation: sp.Expr, signal: float
) -> tuple[str, tuple[str, sp.Symbol, sp.Expr] | None]:
    """Return the variable whose sign switches a part, and the part for positive values, if any."""
    name = next(iter(definition.effect.variables), "")
    switching = variable_symbol(name)
    switched = equation.replace(lambda e: isinstance(e, sp.tanh) and e.has(switching), lambda _: 1)
    if not name or switched.has(switching):
        return "", None
    return name, _part(definition, switched, signal)


def _arguments(definition: EffectDefinition, equation: sp.Expr) -> set[sp.Symbol]:
    return set(equation.free_symbols) - set(definition.coefficients)


def _difference(
    definition: EffectDefinition, equation: sp.Expr
) -> tuple[str, sp.Symbol, sp.Expr] | None:
    """Return the argument of a part that depends only on the difference of two variables."""
    effect, site = definition.effect, definition.site
    given = effect.variables[0] if effect.variables else own_variable(site)
    names = split_variable(given, definition.uses)
    if len(names) != 2:
        return None
    first, second = map(variable_symbol, names)
    between = sp.Symbol("between", real=True)
    equation = sp.expand(equation.subs(first, second + between))
    if _arguments(definition, equation) != {between}:
        equation = sp.simplify(equation)
    if _arguments(definition, equation) != {between}:
        return None
    return difference(*names), between, equation


def _compiled(definition: EffectDefinition, equation: sp.Expr, argument: sp.Symbol) -> Shape:
    compiled = sp.lambdify([argument, *definition.coefficients], equation, "numpy")

    def shape(x: FloatArray, values: FloatArray) -> FloatArray:
        with np.errstate(all="ignore"):
            found = np.asarray(compiled(x, *values), np.float64)
        return np.array(np.broadcast_to(found, x.shape))

    return shape


def _is_one(definition: EffectDefinition, result: Result) -> bool:
    """Return whether an effect has the same coefficients in all experiments."""
    known = {e.label for e in result.estimates}
    return all(str(symbol) in known for symbol in definition.coefficients)


def coefficient_estimates(definition: EffectDefinition, result: Result) -> list[Estimate]:
    """Return the estimates of an effect's coefficients, in the order of its form."""
    rows = {e.label: e for e in result.estimates}
    return [rows[str(symbol)] for symbol in definition.coefficients]


def _curve(
    definition: EffectDefinition,
    part: EffectShape,
    x: FloatArray,
    result: Result,
    description: ModelDescription,
) -> EffectCurve:
    """Return the curve of one part of an effect, with its band."""
    own = coefficient_estimates(definition, result)
    values = np.array([e.value for e in own])
    y = part.shape(x, values)
    if not np.isfinite(y).any():
        return _none(definition, "the effect is not finite in the range of the data")
    spread = BAND_QUANTILE * spread_of(part.shape, x, values, covariance_of(result, own))
    units = {name: variable.unit for name, variable in description.variables.items()}
    unit, at_rates = units.get(part.target, ""), definition.site.at_rates
    first = parts_of(part.argument)[0]
    at = f"der({part.target})" if at_rates else str(definition.site)
    return EffectCurve(
        effect=definition.effect.name,
        part=f"{at} while {part.positive} > 0" if part.positive else at,
        positive=part.positive,
        variable=part.argument,
        variable_unit="s" if part.argument == "time" else units.get(first, ""),
        unit=per_second(unit) if unit and at_rates else unit,
        x=x,
        y=y,
        lower=y - spread,
        upper=y + spread,
    )


def spread_of(
    shape: Shape, x: FloatArray, values: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Return the standard deviation of a shape, to first order, from central differences."""
    if not np.isfinite(covariance).all():
        return np.full(len(x), np.nan)
    slopes = np.zeros((len(x), len(values)))
    for i, step in enumerate(1e-3 * np.sqrt(np.diag(covariance))):
        if step > 0.0:
            moved = np.eye(len(values))[i] * step
            slopes[:, i] = (shape(x, values + moved) - shape(x, values - moved)) / (2.0 * step)
    variance = np.einsum("ni,ij,nj->n", slopes, covariance, slopes)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def with_evidence(
    curve: EffectCurve, at: FloatArray, more: FloatArray, error: FloatArray
) -> EffectCurve:
    """Return the curve with the term that the residuals suggest: curve plus `more` at `at`."""
    free = np.interp(at, curve.x, curve.y) + more
    return replace(curve, free_x=at, free_y=free, free_error=error)
