"""Effects of a problem: the terms that are added to the model, and their parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from cluster_est.errors import ConfigError
from cluster_est.problem.formulas import ParameterConstraint
from cluster_est.problem.free_curves import UNSHAPED, ShapedCurve, TableShape
from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import Prior
from workers.effects.forms import EffectForm
from workers.effects.kinds import FormCoefficient
from workers.effects.site import EffectSite, bracketed, own_variable, parts_of
from workers.fmu.description import nearest
from workers.messages import Effect

LEAST_COEFFICIENT_OVER_START = 1e-3
"""Default lower bound of a positive coefficient, over its start value. Start values may be wrong by
a factor of ten or a hundred; a thousandth of them is practically 0."""


@dataclass(frozen=True)
class DeclaredCoefficient:
    """A declared coefficient of an effect.

    Attributes
    ----------
    start
        Start value; None for the value at which the effect has no influence.
    bounds
        None for the physical bounds. For a size (a time constant, a width, a speed, a frequency),
        the lower bound is then a thousandth of the start value. At 0, the form would divide by it,
        or the effect would have no influence and a search could not leave this point.
    scale
        See `Parameter`. None: logarithmic if the coefficient is a size with a start value above 0
        and no bound of 0 or below; linear otherwise.
    fixed, per, unit, prior
        See `Parameter`.
    neutral
        For a user's own equation: the value at which the effect has no influence.
    """

    start: float | None = None
    bounds: tuple[float, float] | None = None
    scale: Literal["linear", "log"] | None = None
    fixed: bool = False
    neutral: float | None = None
    per: str | None = None
    unit: str = ""
    prior: Prior | None = None


@dataclass(frozen=True)
class DeclaredEffect:
    """A declared effect, with a form of the library or the user's own equation.

    Attributes
    ----------
    name
        Name of the effect; the name of the form if empty.
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form, equation
        One of the two.
    variables
        Arguments of the form; empty for the state of der(STATE).
    coefficients
        The declared coefficients by name.
    reaction
        For an equation at a pair: the term that is added to the second state's derivative.
    shape
        For a free curve: its smoothness, whether it is monotonic, and the bounds of its values.
    """

    name: str
    site: str
    form: str = ""
    equation: str = ""
    variables: tuple[str, ...] = ()
    coefficients: Mapping[str, DeclaredCoefficient] = field(default_factory=dict)
    reaction: str = ""
    shape: TableShape = UNSHAPED


@dataclass(frozen=True)
class MadeEffect:
    """An effect with its coefficients as parameters, and the constraints between them.

    Auxiliary parameters may be added, from which the values of a smooth curve are computed.
    """

    effect: Effect
    parameters: tuple[Parameter, ...]
    constraints: tuple[ParameterConstraint, ...] = ()


UNDECLARED_COEFFICIENT = DeclaredCoefficient()
"""A coefficient without declared properties."""


def make_effect(declared: DeclaredEffect) -> MadeEffect:
    """Make an effect and its coefficients as parameters.

    Raises
    ------
    ConfigError
        If the effect names both a form and an equation, or neither, or an unknown coefficient; if a
        divisor starts at 0; or if a shape is given for a form that is not a free curve.
    EffectError
        If the form or the site does not exist.
    """
    from workers.effects.definition import (  # SymPy takes long to import
        coefficients,
        divisors,
        form_of,
    )

    name = declared.name or declared.form
    where = f"effect {name!r}"
    if bool(declared.form) == bool(declared.equation):
        has = "both" if declared.form else "neither"
        raise ConfigError(
            f"{where}: must have exactly one of form and equation, but has {has}; give one of them"
        )
    if not name:
        raise ConfigError("effects: an effect with an equation must have a name; add name")
    given = declared.coefficients
    own = tuple((n, c.neutral) for n, c in given.items()) if declared.equation else ()
    effect = Effect(
        name,
        declared.site,
        declared.form,
        declared.variables,
        declared.equation,
        own,
        declared.reaction,
    )
    known = coefficients(effect, where)
    names = [c.name for c in known]
    for unknown in (n for n in given if n not in names):
        raise ConfigError(
            f"{where}: parameters.{unknown}: {declared.form} has no such coefficient"
            f"{nearest(unknown, names)}"
        )
    divided = divisors(effect, where)
    parameters = [
        _parameter(
            f"{name}.{c.name}",
            _start(
                c, given.get(c.name, UNDECLARED_COEFFICIENT), declared, singular=c.name in divided
            ),
            c,
            given.get(c.name, UNDECLARED_COEFFICIENT),
            singular=c.name in divided,
        )
        for c in known
    ]
    if not declared.shape.says_something:
        return MadeEffect(effect, tuple(parameters))
    chosen = {c.name: _chosen_keys(given.get(c.name, UNDECLARED_COEFFICIENT)) for c in known}
    shaped = ShapedCurve(name, form_of(effect, where), declared.shape, tuple(parameters), chosen)
    return MadeEffect(effect, shaped.parameters(), shaped.constraints())


def _chosen_keys(chosen: DeclaredCoefficient) -> tuple[str, ...]:
    """Return the declared keys of a coefficient, except start, unit and neutral value."""
    keys = ("bounds", "scale", "fixed", "per", "prior")
    return tuple(
        key for key in keys if getattr(chosen, key) != getattr(UNDECLARED_COEFFICIENT, key)
    )


def _start(
    coefficient: FormCoefficient,
    chosen: DeclaredCoefficient,
    declared: DeclaredEffect,
    *,
    singular: bool,
) -> float:
    """Return the start value of a coefficient; refuse a missing or a forbidden start value."""
    name = declared.name or declared.form
    where = f"effect {name!r}"
    start = chosen.start if chosen.start is not None else coefficient.neutral
    if start is None or not math.isfinite(start):
        raise ConfigError(
            f"{where}: parameters.{coefficient.name}.start is missing; add it, because "
            f"{coefficient.name} of {declared.form or 'your own equation'} has no default start"
        )
    if singular and start == 0.0 and not (chosen.fixed and coefficient.neutral == 0.0):
        raise ConfigError(
            f"{where}: parameters.{coefficient.name}.start: is 0, but {declared.form} divides by "
            f"{coefficient.name}; give a value of the expected size"
        )
    return start


def _parameter(
    label: str,
    start: float,
    coefficient: FormCoefficient,
    chosen: DeclaredCoefficient,
    *,
    singular: bool,
) -> Parameter:
    low, high = chosen.bounds or (0.0 if coefficient.positive else -math.inf, math.inf)
    scale = chosen.scale
    if coefficient.positive and coefficient.scale is not None and start > 0.0 and not chosen.fixed:
        if chosen.bounds is None and (scale != "linear" or singular):
            low = LEAST_COEFFICIENT_OVER_START * start
        scale = scale or ("log" if low > 0.0 else "linear")
    return Parameter(
        label,
        start,
        (low, high),
        scale or "linear",
        chosen.fixed,
        per=chosen.per,
        unit=chosen.unit,
        prior=chosen.prior,
    )


def equation_text(effect: Effect, form: EffectForm, site: EffectSite) -> str:
    """Return the equation of an effect as a text.

    "der(v) += -k * tanh(v / width)", "F -> F + k * F^2", "u -> delay(u, tau)". If a coefficient or
    an internal state has the same name as a variable in the equation, the effect's name is put
    before it.
    """
    names = dict(zip(("v", "w"), effect.variables, strict=False))
    if form.variables and not effect.variables:
        names["v"] = own_variable(site)
    at_rates = site.kind in ("derivative", "pair")
    if not at_rates:
        names["s"] = site.target
    coefficients = [c.name for c in form.coefficients]
    taken = {part for name in names.values() for part in parts_of(name)}
    own_names = [*coefficients, *(z.name for z in form.states)]
    names |= {name: f"{effect.name}.{name}" for name in own_names if name in taken}

    def named(text: str) -> str:
        return re.sub(
            r"[A-Za-z_]\w*(?!\w*\()", lambda m: bracketed(names.get(m.group(), m.group())), text
        )

    if form.memory:
        return f"{site.target} -> {form.memory}({site.target}, {coefficients[0]})"
    if form.values:
        argument = effect.variables[-1] if effect.variables else names.get("v", site.target)
        table = f"table of {argument} from low to high: "
        values = [c.name for c in form.coefficients if c.neutral is not None]
        table += ", ".join(values if len(values) < 9 else [*values[:2], "...", values[-1]])
        if site.kind == "pair":
            first, second = site.targets
            return f"der({first}) += {table}; der({second}) -= {names.get('back', 'back')} times it"
        if site.kind == "parameter":
            return f"{site.target} -> {site.target} * (1 + {table})"
        if form.variables > 1:
            return f"{site} += {named('-tanh(v / width)')} * ({table})"
        return f"{site} += {table}" if at_rates else f"{site.target} -> {site.target} + {table}"
    text = named(form.equation)
    if site.kind == "pair":
        first, second = site.targets
        return f"der({first}) += {text}, der({second}) += {named(form.reaction)}"
    own = "".join(f", {named(z.name)}' = {named(z.derivative)}" for z in form.states)
    return f"{site} += {text}{own}" if at_rates else f"{site.target} -> {text}{own}"
