"""Effects as a closed loop describes them, made of units, numbers and curves alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from support.loop_objects import (
    made_fit,
    made_fitter,
    made_problem,
    made_result,
    made_round,
    made_screening,
    made_selection,
)

from cluster_est import Effect, Parameter
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.description import describe_effects
from cluster_est.closed_loop.findings.effects import NamedEffect
from cluster_est.results.fit_tables import EffectCurve, Estimate
from workers.effects.forms import FORMS, EffectForm
from workers.effects.site import parse_site
from workers.fmu.description import ModelDescription
from workers.messages import FloatArray

PROBLEM = made_problem(50)
FITTER = made_fitter(PROBLEM)


def described(
    site: str,
    form: str | EffectForm,
    *variables: str,
    values: Sequence[float] = (),
    estimates: Sequence[Estimate] = (),
    units: Mapping[str, str] | None = None,
    given: Mapping[str, str] | None = None,
    curve: EffectCurve | None = None,
    way: int = 1,
    declared: bool = False,
) -> NamedEffect:
    """Describe an effect "e" that a search has found.

    Its coefficients are `estimates`, or have `values`, which are 1 where none are given. A model
    has variables with these `units`, and no others, or is the spring's; a config gives signals
    theirs. `way` says to which side the search has bounded its strengths, 0 to none. An effect that
    is `declared` stands in the problem of the last fit, so that its equation is known beyond its
    curve.
    """
    place = parse_site(site, "")
    made = FORMS[place.kind, form] if isinstance(form, str) else form
    names = [c.name for c in made.coefficients]
    low, high = (0.0 if way == sign else -sign * np.inf for sign in (1, -1))
    candidate = EffectCandidate(
        Effect("e", site, made.name, variables), made, place, variables == (place.target,), (),
        (low,) * len(names), (high,) * len(names),
    )  # fmt: skip
    numbers = values or [1.0] * len(names)
    known = estimates or [estimate(*pair) for pair in zip(names, numbers, strict=True)]
    problem = replace(PROBLEM, units=tuple((given or {}).items()))
    fitter = replace(FITTER, problem=problem, description=_description(units))
    if declared:
        own = tuple(Parameter(f"e.{e.label[2:]}", e.value) for e in known)
        problem = replace(
            problem, effects=(candidate.effect,), parameters=(*problem.parameters, *own)
        )
    fitted = made_fit(problem, np.zeros(50), [candidate])
    last = made_round(None, made_screening(fitted.jacobian, fitted.residuals, [], []))
    found = made_selection(made_fit(PROBLEM, np.zeros(50)), fitted, last)
    result = replace(made_result(problem, []), estimates=tuple(known))
    curves = [] if curve is None else [replace(curve, effect="e")]
    (effect,) = describe_effects(fitter, found, result, curves)
    return effect


def estimate(
    name: str, value: float, unit: str = "", error: float = 0.01, on: str = "train"
) -> Estimate:
    """Estimate a coefficient of the effect, with an interval of two standard errors."""
    known = {
        "label": f"e.{name}", "parameter": f"e.{name}", "value": value, "unit": unit,
        "estimated_on": on, "lower95": value - 2.0 * error, "upper95": value + 2.0 * error,
    }  # fmt: skip
    fields: dict[str, Any] = dict.fromkeys(Estimate.__annotations__, "") | known
    return Estimate(**fields)


def seen(x: FloatArray, y: FloatArray, integral_of: str = "") -> EffectCurve:
    """Make a curve with no more than its points."""
    return EffectCurve("e", "", "z", x=x, y=y, integral_of=integral_of)


def visited(
    low: float,
    high: float,
    shape: Callable[[FloatArray], FloatArray],
    error: float = 0.01,
    counts: FloatArray | None = None,
) -> EffectCurve:
    """Make a curve over a range of the data; its standard error is a share of its size."""
    x = np.linspace(low, high, 201)
    y = shape(x)
    half = 1.96 * error * np.abs(y).max() * np.ones(len(x))
    edges = np.linspace(low, high, 49)
    counts = np.ones(48) if counts is None else counts
    return EffectCurve("e", "der(v)", "v", "m/s", "m/s2", x, y, y - half, y + half, edges, counts)


def _description(units: Mapping[str, str] | None) -> ModelDescription:
    if units is None:
        return FITTER.description
    known = FITTER.description.variables
    template = next(iter(known.values()))
    variables = {
        name: replace(known.get(name, template), name=name, kind="real", unit=unit)
        for name, unit in units.items()
    }
    return replace(FITTER.description, variables=variables, units={})
