"""An effect resolved against an FMU: its equations in SymPy, over the FMU's own variables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import sympy as sp

from workers.description import Description
from workers.effects.expression import parse
from workers.effects.forms import Coefficient, Form, form
from workers.effects.site import Site, check_site, parse_site
from workers.errors import EffectError
from workers.messages import Effect, FloatArray, Interface

TIME, SIGNAL = sp.Symbol("t", real=True), sp.Symbol("s", real=True)


def variable_symbol(name: str) -> sp.Symbol:
    """What stands for a variable of the FMU in an equation."""
    return sp.Symbol(f"fmu:{name}", real=True)


MOST_SUBSTEPS = 10_000


@dataclass(frozen=True)
class Definition:
    """An effect with its equations.

    Attributes
    ----------
    effect, site, form
        What it is and where.
    equation
        What is added to a derivative, or takes the place of the signal `SIGNAL`.
    coefficients
        Symbols, in the order of the form's coefficients.
    states
        Symbols of its own states; `derivatives` and `starts` belong to them.
    uses
        FMU variables that the equations depend on.
    """

    effect: Effect
    site: Site
    form: Form
    equation: sp.Expr
    coefficients: tuple[sp.Symbol, ...]
    states: tuple[sp.Symbol, ...]
    derivatives: tuple[sp.Expr, ...]
    starts: tuple[sp.Expr, ...]
    uses: tuple[str, ...]

    def substeps(self, values: FloatArray, step: float) -> int:
        """Into how many parts a step must be cut, at least, for its own states to stay stable.

        Eight for each time constant, where the time constants depend on the coefficients alone.
        """
        fastest = _fastest(self)
        rate = abs(float(fastest(*values))) if fastest is not None else 0.0
        return int(min(max(1.0, np.ceil(8.0 * step * rate)), MOST_SUBSTEPS))

    def neutral(self, values: FloatArray) -> bool:
        """Whether it does nothing with these values of its coefficients."""
        known = [c.neutral for c in self.form.coefficients]
        pairs = zip(known, values.tolist(), strict=True)
        return all(value == still for still, value in pairs if still is not None)


@lru_cache(maxsize=512)
def _fastest(definition: Definition) -> Callable[..., float] | None:
    """The fastest rate of the own states, as a function of the coefficients."""
    pairs = zip(definition.derivatives, definition.states, strict=True)
    rates = [sp.Abs(sp.diff(slope, state)) for slope, state in pairs]
    known = [r for r in rates if r.free_symbols <= set(definition.coefficients)]
    if not known:
        return None
    function: Callable[..., float] = sp.lambdify(definition.coefficients, sp.Max(*known), "math")
    return function


def define(effect: Effect, description: Description, interface: Interface) -> Definition:
    """Resolve an effect.

    Raises
    ------
    EffectError
        If the site is closed, the form unknown, or the equation is none.
    """
    where = f"effect {effect.name!r}"
    site = parse_site(effect.site, f"{where}: site")
    check_site(site, description, interface, f"{where}: site")
    chosen = _own_form(effect, site) if effect.equation else form(site.kind, effect.form, where)
    names_there = _variables(description, site, interface)
    variables = {name: variable_symbol(name) for name in names_there}
    names = _placeholders(effect, chosen, site, variables, where)
    own = {c.name: sp.Symbol(f"{effect.name}.{c.name}", real=True) for c in chosen.coefficients}
    states = {z.name: sp.Symbol(f"{effect.name}:{z.name}", real=True) for z in chosen.states}
    symbols = {"t": TIME, **names, **own, **states}
    if site.kind != "derivative":
        symbols["s"] = SIGNAL

    def read(text: str) -> sp.Expr:
        return parse(text, symbols, f"{where}: equation")

    equations = [read(chosen.equation)]
    equations += [read(z.derivative) for z in chosen.states]
    equations += [read(z.start) for z in chosen.states]
    count = len(chosen.states)
    used = set().union(*(e.free_symbols for e in equations))
    return Definition(
        effect=effect,
        site=site,
        form=chosen,
        equation=equations[0],
        coefficients=tuple(own.values()),
        states=tuple(states.values()),
        derivatives=tuple(equations[1 : 1 + count]),
        starts=tuple(equations[1 + count :]),
        uses=tuple(name for name, symbol in variables.items() if symbol in used),
    )


def coefficients(effect: Effect, where: str) -> tuple[Coefficient, ...]:
    """The coefficients of an effect, without an FMU.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    site = parse_site(effect.site, f"{where}: site")
    chosen = _own_form(effect, site) if effect.equation else form(site.kind, effect.form, where)
    return chosen.coefficients


def _own_form(effect: Effect, site: Site) -> Form:
    own = tuple(Coefficient(name, neutral) for name, neutral in effect.coefficients)
    return Form("expression", "own", (site.kind,), effect.equation, own)


def _variables(description: Description, site: Site, interface: Interface) -> list[str]:
    """What an equation at a site may depend on; states are seen in model exchange, or recorded."""
    names = [v.name for v in description.inputs()]
    if interface == "model_exchange" or site.kind == "output":
        names = [*description.states, *names]
    if site.kind == "output":
        names += [v.name for v in description.variables.values() if v.causality == "output"]
    return names


def _placeholders(
    effect: Effect, chosen: Form, site: Site, variables: Mapping[str, sp.Symbol], where: str
) -> dict[str, sp.Symbol]:
    """`v` and `w` of a form, or every variable by its own name in an equation of the user's."""
    if effect.equation:
        return dict(variables)
    given = effect.variables
    if not given and chosen.variables == 1 and site.kind == "derivative":
        given = (site.target,)
    if len(given) != chosen.variables:
        raise EffectError(
            f"{where}: variables: {chosen.name} needs {chosen.variables} but has {len(given)}; "
            f"name states or inputs of the FMU, like {list(variables)[:3]}"
        )
    for name in given:
        if name not in variables:
            parse(name, variables, f"{where}: variables")
    return dict(zip(("v", "w"), (variables[name] for name in given), strict=False))
