"""An effect in terms of an FMU: SymPy equations in the FMU's variables, with their units."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import sympy as sp

from workers.core.assemble import TIME_SYMBOL
from workers.effects.expression import parse
from workers.effects.forms import form
from workers.effects.kinds import EffectForm, FormCoefficient, positive
from workers.effects.laws import Law
from workers.effects.site import (
    EffectSite,
    check_site,
    parse_site,
    split_variable,
    unnamed_variables,
)
from workers.errors import EffectError
from workers.fmu.description import ModelDescription
from workers.messages import Effect, Experiment, FloatArray, Interface

REMEMBERED_DEFINITIONS = 4096
"""Definitions that are remembered: those of the same effects are asked for again and again."""

SIGNAL_SYMBOL = sp.Symbol("s", real=True)


def variable_symbol(name: str) -> sp.Symbol:
    """Return the symbol of a variable of the FMU in an equation."""
    return sp.Symbol(f"fmu:{name}", real=True)


@dataclass(frozen=True)
class EffectDefinition:
    """An effect with its equations.

    Attributes
    ----------
    effect, site, form
        The effect, where it acts, and its form.
    equations
        (target, equation): what is added to the derivative of a state, or takes the place of the
        signal `SIGNAL_SYMBOL` of that name. Two at a pair, else one.
    coefficients
        Symbols, in the order of the form's coefficients.
    states
        Symbols of its own states; `derivatives` and `starts` belong to them.
    uses
        FMU variables and measured signals that the equations depend on.
    """

    effect: Effect
    site: EffectSite
    form: EffectForm
    equations: tuple[tuple[str, sp.Expr], ...]
    coefficients: tuple[sp.Symbol, ...]
    states: tuple[sp.Symbol, ...]
    derivatives: tuple[sp.Expr, ...]
    starts: tuple[sp.Expr, ...]
    uses: tuple[str, ...]

    def fastest_rate(
        self, values: FloatArray, signals: Mapping[str, FloatArray] | None = None
    ) -> float:
        """Return the rate of the fastest of its own states, 1 over a time constant.

        0 where it has none, or where the rates depend on more than the coefficients and, if these
        are given, the variables in `signals`, of which it is the largest.
        """
        given = signals or {}
        names = tuple(name for name in self.uses if name in given)
        with np.errstate(all="ignore"):  # a simulation that failed left NaN
            rates = _rates(self, names)(*values, *(given[name] for name in names))
        return max((0.0, *(float(np.max(np.abs(rate))) for rate in rates)))

    def decay_rate(self, values: FloatArray) -> float:
        """Return the rate at which its one own state follows signals, if that is linear.

        0 where it has no or more own states, or where they follow in another way.
        """
        return float(_decay(self)(*values))

    def linear_rates(self, values: FloatArray) -> FloatArray:
        """Return the matrix A of several own states with x' = A x + g(t), (states, states).

        Empty where it has no or one own state, or where they follow signals in another way.
        """
        return np.array(_linear_rates(self)(*values), np.float64)

    def is_neutral(self, values: FloatArray) -> bool:
        """Return whether it provably does nothing with these values of its coefficients.

        A user's equation must also become 0, or the signal itself, by algebra: what is declared
        neutral there need not be, and may not be all that acts.
        """
        neutral_values = [c.neutral for c in self.form.coefficients]
        pairs = zip(neutral_values, values.tolist(), strict=True)
        still = all(value == neutral for neutral, value in pairs if neutral is not None)
        if self.effect.equation:
            return still and _vanishes(self)
        return still and any(neutral is not None for neutral in neutral_values)


@lru_cache(maxsize=512)
def _vanishes(definition: EffectDefinition) -> bool:
    """Return whether equations change nothing once the coefficients are neutral that can be."""
    pairs = zip(definition.coefficients, definition.form.coefficients, strict=True)
    neutral = {symbol: c.neutral for symbol, c in pairs if c.neutral is not None}
    unchanged = sp.Integer(0) if definition.site.at_rates else SIGNAL_SYMBOL
    return all(equation.subs(neutral) - unchanged == 0 for _, equation in definition.equations)


@lru_cache(maxsize=512)
def _rates(definition: EffectDefinition, names: tuple[str, ...]) -> Callable[..., list[FloatArray]]:
    """Return the rates of the own states as a function of coefficients and named variables."""
    symbols = (*definition.coefficients, *(variable_symbol(name) for name in names))
    rates = known_rates(definition, names)
    function: Callable[..., list[FloatArray]] = sp.lambdify(symbols, rates, "numpy")
    return function


@lru_cache(maxsize=512)
def _decay(definition: EffectDefinition) -> Callable[..., float]:
    """Return `known_decay` as a function of the coefficients."""
    function: Callable[..., float] = sp.lambdify(
        definition.coefficients, known_decay(definition), "numpy"
    )
    return function


@lru_cache(maxsize=512)
def _linear_rates(definition: EffectDefinition) -> Callable[..., list[list[float]]]:
    """Return the matrix of `EffectDefinition.linear_rates` as a function of the coefficients."""
    several = len(definition.states) > 1 and _follows_linearly(definition)
    rows = [[sp.diff(d, state) for state in definition.states] for d in definition.derivatives]
    function: Callable[..., list[list[float]]] = sp.lambdify(
        definition.coefficients, rows if several else [], "numpy"
    )
    return function


def known_decay(definition: EffectDefinition) -> sp.Expr:
    """Return the rate a of one own state with x' = g(t) - a x, g linear in signals; 0 elsewhere."""
    if len(definition.states) != 1 or not _follows_linearly(definition):
        return sp.Integer(0)
    (derivative,), (state,) = definition.derivatives, definition.states
    return -sp.diff(derivative, state)


def _follows_linearly(definition: EffectDefinition) -> bool:
    """Return whether the derivatives of all own states are linear in these and in signals."""
    constant = set(definition.coefficients)
    moving = [(d, d.free_symbols - constant) for d in definition.derivatives]
    return not any(TIME_SYMBOL in symbols for _, symbols in moving) and all(
        sp.diff(derivative, symbol).free_symbols <= constant
        for derivative, symbols in moving
        for symbol in symbols
    )


def known_rates(definition: EffectDefinition, names: tuple[str, ...]) -> list[sp.Expr]:
    """Return the rates of own states that depend on coefficients and these variables alone.

    Of states that act on each other, none is faster than the largest of these: the sums of the rows
    of their Jacobian (S. A. Gershgorin, Bull. Acad. Sci. URSS 6 (1931) 749-754).
    """
    symbols = {*definition.coefficients, *(variable_symbol(name) for name in names)}
    rates = []
    for derivative in definition.derivatives:
        row = [sp.diff(derivative, state) for state in definition.states]
        known = [sp.Abs(entry) for entry in row if entry != 0 and entry.free_symbols <= symbols]
        rates += [sp.Add(*known)] if known else []
    return rates


def define(
    effect: Effect,
    description: ModelDescription,
    interface: Interface,
    signals: tuple[str, ...] = (),
) -> EffectDefinition:
    """Resolve an effect.

    Parameters
    ----------
    effect, description, interface
        The effect, and the FMU and interface that it acts on.
    signals
        Names of measured signals beside the FMU's inputs.

    Raises
    ------
    EffectError
        If the site is closed, the form unknown, or the equation is none.
    """
    where = f"effect {effect.name!r}"
    site = parse_site(effect.site, f"{where}: site")
    check_site(site, description, interface, f"{where}: site")
    allowed = [*_variables(description, site, interface), *signals]
    return _definition(effect, site, tuple(allowed))


def define_all(
    effects: Iterable[Effect],
    description: ModelDescription,
    interface: Interface,
    experiments: Iterable[Experiment],
) -> list[EffectDefinition]:
    """Resolve effects that may depend on the measured signals of these experiments.

    Raises
    ------
    EffectError
        As `define`.
    """
    named = (given.variable for e in experiments for given in e.signals)
    signals = tuple(dict.fromkeys(named))
    return [define(effect, description, interface, signals) for effect in effects]


@lru_cache(REMEMBERED_DEFINITIONS)
def _definition(effect: Effect, site: EffectSite, allowed: tuple[str, ...]) -> EffectDefinition:
    """Read the equations of an effect over the variables that they may depend on."""
    variables = {name: variable_symbol(name) for name in allowed}
    where = f"effect {effect.name!r}"
    chosen = _chosen(effect, site, where)
    names = _placeholders(effect, chosen, site, variables, where)
    own = {c.name: sp.Symbol(f"{effect.name}.{c.name}", real=True) for c in chosen.coefficients}
    states = {z.name: sp.Symbol(f"{effect.name}:{z.name}", real=True) for z in chosen.states}
    symbols = {"t": TIME_SYMBOL, **names, **own, **states}
    if not site.at_rates:
        symbols["s"] = SIGNAL_SYMBOL

    def read(text: str) -> sp.Expr:
        return parse(text, symbols, f"{where}: equation")

    texts = (chosen.equation, chosen.reaction) if site.other else (chosen.equation,)
    equations = tuple((t, read(text)) for t, text in zip(site.targets, texts, strict=True))
    derivatives = tuple(read(z.derivative) for z in chosen.states)
    starts = tuple(read(z.start) for z in chosen.states)
    used = set().union(
        *(e.free_symbols for e in (*dict(equations).values(), *derivatives, *starts))
    )
    return EffectDefinition(
        effect=effect,
        site=site,
        form=chosen,
        equations=equations,
        coefficients=tuple(own.values()),
        states=tuple(states.values()),
        derivatives=derivatives,
        starts=starts,
        uses=tuple(name for name, symbol in variables.items() if symbol in used),
    )


def coefficients(effect: Effect, where: str) -> tuple[FormCoefficient, ...]:
    """The coefficients of an effect, without an FMU; `positive` is what holds at its site.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    site = parse_site(effect.site, f"{where}: site")
    own = site.kind == "derivative" and effect.variables in ((), (site.target,))
    chosen = _chosen(effect, site, where)
    return tuple(replace(c, positive=positive(c, own=own)) for c in chosen.coefficients)


def form_of(effect: Effect, where: str) -> EffectForm:
    """The form that an effect names, or that of its own equation, without an FMU.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    return _chosen(effect, parse_site(effect.site, f"{where}: site"), where)


def divisors(effect: Effect, where: str) -> tuple[str, ...]:
    """The coefficients of a form that it divides by; none are known of an equation of one's own.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    chosen = form_of(effect, where)
    own = chosen.coefficients if not effect.equation else ()
    return tuple(c.name for c in own if chosen.divides_by(c.name))


def _chosen(effect: Effect, site: EffectSite, where: str) -> EffectForm:
    """Return the form that an effect names, or that of its own equation."""
    if effect.reaction and (site.kind != "pair" or not effect.equation):
        raise EffectError(
            f"{where}: reaction: is only for an equation at a pair, but site is {effect.site!r} "
            f"and {'form is ' + repr(effect.form) if effect.form else 'no form is given'}; leave "
            "it out"
        )
    if not effect.equation:
        return form(site.kind, effect.form, where)
    if site.kind == "pair" and not effect.reaction:
        raise EffectError(
            f"{where}: reaction: is missing; add the equation that is added to der({site.other}), "
            f"as equation is added to der({site.target})"
        )
    return _own_form(effect, site)


def _own_form(effect: Effect, site: EffectSite) -> EffectForm:
    own = tuple(FormCoefficient(name, is_neutral) for name, is_neutral in effect.coefficients)
    return EffectForm(
        "expression",
        "own",
        Law.OTHER,
        (site.kind,),
        effect.equation,
        own,
        reaction=effect.reaction,
    )


def _variables(description: ModelDescription, site: EffectSite, interface: Interface) -> list[str]:
    """Return the variables that an equation at a site may depend on.

    States are known in model exchange, or from the recorded outputs. In co-simulation the FMU shows
    what it computes from one communication point to the next.
    """
    names = [v.name for v in description.inputs()]
    if interface == "co_simulation" and site.kind != "output":
        names += [v.name for v in description.variables.values() if v.is_read]
    if interface == "model_exchange" or site.kind == "output":
        names = [*description.states, *names]
    if site.kind == "output":
        outputs = [v.name for v in description.variables.values() if v.causality == "output"]
        names += [*outputs, site.target]
    return list(dict.fromkeys(names))


def _placeholders(
    effect: Effect,
    chosen: EffectForm,
    site: EffectSite,
    variables: Mapping[str, sp.Symbol],
    where: str,
) -> dict[str, sp.Expr]:
    """Return `v` and `w` of a form, or every variable by its name for a user's equation."""
    if effect.equation:
        return dict(variables)
    given = effect.variables or unnamed_variables(chosen, site)
    if len(given) != chosen.variables:
        raise EffectError(
            f"{where}: variables: {chosen.name} needs {chosen.variables} variable"
            f"{'' if chosen.variables == 1 else 's'}, but was given {len(given)}; name states or "
            f"inputs of the FMU, such as {list(variables)[:3]}"
        )
    read = [_variable(text, variables, f"{where}: variables") for text in given]
    return dict(zip(("v", "w"), read, strict=False))


def _variable(text: str, variables: Mapping[str, sp.Symbol], where: str) -> sp.Expr:
    """Return the expression of a variable, or of the difference of two."""
    names = split_variable(text, variables)
    if not names:
        parse(text, variables, where)  # says which name is unknown
        raise EffectError(
            f"{where}: must be a name or the difference of two names, but is {text!r}"
        )
    first, *second = (variables[name] for name in names)
    return first - second[0] if second else first


UNKNOWN_UNIT = "?"
_WORD = re.compile(r"(site|other|travel|second|v|w|s)(\^[\d.]+)?")


def coefficient_units(
    definition: EffectDefinition, description: ModelDescription
) -> tuple[str, ...]:
    """Return the unit of each coefficient of an effect, such as "N/(m/s)^2".

    A form says them in these words: `site` is what its equation gives (at the derivative of a state
    the state's unit over a second, elsewhere that of the signal, which `s` means too), `other` the
    same at the second derivative of a pair, `v` and `w` its variables, `travel` the integral of
    `v` over time, `second` a second. "?" stands for what the FMU does not name; coefficients of an
    equation of the user's own have no unit here.
    """
    units = _units(definition, description)
    return tuple(_fill(c.unit, units) for c in definition.form.coefficients)


def _units(definition: EffectDefinition, description: ModelDescription) -> dict[str, str]:
    def unit(name: str = "") -> str:
        known = description.variables.get(name)
        return (known.unit if known is not None else "") or UNKNOWN_UNIT

    site = definition.site
    found = [unit(name) for name in site.targets]
    if site.at_rates:
        found = [_per_second(each) for each in found]
    units = {"site": found[0], "s": found[0], "other": found[-1], "second": "s"}
    texts = definition.effect.variables or (site.target,)
    for word, text in zip(("v", "w"), texts, strict=False):
        units[word] = unit(*split_variable(text, definition.uses)[:1])
    units["travel"] = _times_second(units["v"])
    return units


def _per_second(unit: str) -> str:
    """A unit over a second, so that "m/s" becomes "m/s^2"."""
    found = re.fullmatch(r"(.+)/s(?:\^?(\d))?", unit)
    return f"{found[1]}/s^{int(found[2] or 1) + 1}" if found else f"{unit}/s"


def _times_second(unit: str) -> str:
    return unit[:-2] if unit.endswith("/s") else f"{unit} s"


def _fill(template: str, units: Mapping[str, str]) -> str:
    """Put units in the place of a template's words; what is divided by is put in brackets."""
    over, _, under = template.partition(" / ")
    top = _WORD.sub(lambda m: _powered(m, units, alone=not m[2]), over)
    bottom = _WORD.sub(lambda m: _powered(m, units, alone=False), under)
    bottom = bottom.replace("(1 ", "(").replace(" 1)", ")")
    if bottom in ("", "1", "(1)"):
        return top
    if bottom in (top, f"({top})"):
        return "1"
    return _per_second(top) if bottom == "s" else f"{top}/{bottom}"


def _powered(found: re.Match[str], units: Mapping[str, str], *, alone: bool) -> str:
    """A unit to a power, in brackets where it is made of several."""
    unit, power = units[found[1]], found[2] or ""
    if unit == "1":
        return "1"
    return unit + power if alone or re.fullmatch(r"\w+|\?", unit) else f"({unit}){power}"
