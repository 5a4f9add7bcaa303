"""Effects of a problem: what is added to the model, and the parameters that come with it."""

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
"""Lower bound of a coefficient that has a size, over its start. A start is known to be wrong by a
factor of ten or a hundred; what is a thousandth of it is as good as not there."""


@dataclass(frozen=True)
class DeclaredCoefficient:
    """A coefficient of an effect as it is declared.

    Attributes
    ----------
    start
        Of the estimation; None for the value that does nothing.
    bounds
        None for those that physics gives. What has a size (a time constant, a width, a speed, a
        frequency) then begins at a thousandth of its start: at 0 its form divides by it, or it is
        the end at which nothing happens, where a search would be caught.
    scale
        See `Parameter`. None for a logarithm where the coefficient has a size, a start above 0 and
        no bound of 0 or below, and else for a linear scale.
    fixed, per, unit, prior
        See `Parameter`.
    neutral
        Of an equation of one's own: the value at which it does nothing.
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
    """An effect as it is declared, by a form of the library or an equation of one's own.

    Attributes
    ----------
    name
        The form if empty.
    site
        "der(v)", "pair v,w", "input F", "output y" or "parameter k".
    form, equation
        One of the two.
    variables
        Arguments of the form; empty for the state of der(STATE).
    coefficients
        Coefficients of which something is declared, by name.
    reaction
        Of an equation at a pair: what is added to the second state's derivative.
    shape
        Of a free curve: how smooth it is, whether it is monotone, and the bounds of its values.
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

    Beside the coefficients may stand auxiliary parameters, from which a smooth curve follows.
    """

    effect: Effect
    parameters: tuple[Parameter, ...]
    constraints: tuple[ParameterConstraint, ...] = ()


UNDECLARED_COEFFICIENT = DeclaredCoefficient()
"""A coefficient of which nothing is declared."""


def make_effect(declared: DeclaredEffect) -> MadeEffect:
    """Make an effect and its coefficients as parameters.

    Raises
    ------
    ConfigError
        If it names both a form and an equation, or neither, or a coefficient that it lacks,
        starts at 0 what the form divides by, or has the shape of a curve that it is not.
    EffectError
        If there is no such form or site.
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
    """What is declared of a coefficient beside its start, its unit and what it is by nature."""
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
    """Return where a coefficient starts, or refuse what has no start or may not start there."""
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
            f"{where}: parameters.{coefficient.name}.start: must not be 0, because {declared.form} "
            f"divides by {coefficient.name}, but is 0; give a value of the expected size"
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
    """Return what an effect adds to its site, or makes of the signal there.

    "der(v) += -k * tanh(v / width)", "F -> F + k * F^2", "u -> delay(u, tau)". A coefficient
    or a state of its own that has the name of a variable in the equation carries the effect's name
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
