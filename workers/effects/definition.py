"""An effect in terms of an FMU: SymPy equations in the FMU's variables."""

from __future__ import annotations

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
"""Size of the cache of definitions; the same effects are resolved many times."""

SIGNAL_SYMBOL = sp.Symbol("s", real=True)


def variable_symbol(name: str) -> sp.Symbol:
    """Return the symbol of a variable of the FMU in an equation."""
    return sp.Symbol(f"fmu:{name}", real=True)


@dataclass(frozen=True)
class EffectDefinition:
    """An effect with its equations.

    Attributes
    ----------
    equations
        Pairs (target, equation), two at a pair of states and otherwise one. At a state, the
        equation is added to its derivative. At a signal, it replaces the signal, which the equation
        calls `SIGNAL_SYMBOL`.
    coefficients
        Symbols, in the order of the form's coefficients.
    states
        Symbols of the effect's internal states. `derivatives` and `starts` have the same order.
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
        """Return the rate of the fastest internal state: 1 over its time constant.

        If rates depend on variables in `signals`, the largest rate over all their samples is used.
        The result is 0 if there are no internal states, or if the rates depend on other variables.
        """
        given = signals or {}
        names = tuple(name for name in self.uses if name in given)
        with np.errstate(all="ignore"):  # a failed simulation leaves NaN in the signals
            rates = _rates(self, names)(*values, *(given[name] for name in names))
        return max((0.0, *(float(np.max(np.abs(rate))) for rate in rates)))

    def decay_rate(self, values: FloatArray) -> float:
        """Return the rate at which a single internal state follows signals linearly.

        0 if the number of internal states is not 1, or if the state's equation is not linear.
        """
        return float(_decay(self)(*values))

    def linear_rates(self, values: FloatArray) -> FloatArray:
        """Return the matrix A of several internal states with x' = A x + g(t): (states, states).

        Empty if there are fewer than two internal states, or if their equations are not linear.
        """
        return np.array(_linear_rates(self)(*values), np.float64)

    def is_neutral(self, values: FloatArray) -> bool:
        """Return whether the effect certainly has no influence with these coefficients.

        For a user's equation, algebra must also show that it becomes 0, or the unchanged signal.
        The values that a user declares neutral may be wrong, or the equation may have other terms.
        """
        neutral_values = [c.neutral for c in self.form.coefficients]
        pairs = zip(neutral_values, values.tolist(), strict=True)
        still = all(value == neutral for neutral, value in pairs if neutral is not None)
        if self.effect.equation:
            return still and _vanishes(self)
        return still and any(neutral is not None for neutral in neutral_values)


@lru_cache(maxsize=512)
def _vanishes(definition: EffectDefinition) -> bool:
    """Return whether the equations have no influence if all neutral values are inserted."""
    pairs = zip(definition.coefficients, definition.form.coefficients, strict=True)
    neutral = {symbol: c.neutral for symbol, c in pairs if c.neutral is not None}
    unchanged = sp.Integer(0) if definition.site.at_rates else SIGNAL_SYMBOL
    return all(equation.subs(neutral) - unchanged == 0 for _, equation in definition.equations)


@lru_cache(maxsize=512)
def _rates(definition: EffectDefinition, names: tuple[str, ...]) -> Callable[..., list[FloatArray]]:
    """Return `known_rates` as a function of the coefficients and the named variables."""
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
    """Return the rate a of a single internal state with x' = g(t) - a x; 0 if there is none.

    g must be linear in signals.
    """
    if len(definition.states) != 1 or not _follows_linearly(definition):
        return sp.Integer(0)
    (derivative,), (state,) = definition.derivatives, definition.states
    return -sp.diff(derivative, state)


def _follows_linearly(definition: EffectDefinition) -> bool:
    """Return whether the derivatives of all internal states are linear in states and signals."""
    constant = set(definition.coefficients)
    moving = [(d, d.free_symbols - constant) for d in definition.derivatives]
    return not any(TIME_SYMBOL in symbols for _, symbols in moving) and all(
        sp.diff(derivative, symbol).free_symbols <= constant
        for derivative, symbols in moving
        for symbol in symbols
    )


def known_rates(definition: EffectDefinition, names: tuple[str, ...]) -> list[sp.Expr]:
    """Return the rates of internal states that depend only on coefficients and these variables.

    The rate of a state is the sum of the absolute values in its row of the Jacobian. No eigenvalue
    is larger than the largest of these sums (S. A. Gershgorin, Bull. Acad. Sci. URSS 6 (1931)
    749-754).
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
    """Return the equations of an effect on an FMU with a given interface.

    Parameters
    ----------
    signals
        Names of measured signals that are not inputs of the FMU.

    Raises
    ------
    EffectError
        If the site is closed, the form is unknown, or the equation is invalid.
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
    """Return the equations of effects that may depend on measured signals of these experiments.

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
    """Parse the equations of an effect; `allowed` are the variables that they may contain."""
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
    """Return the coefficients of an effect; no FMU is needed.

    `FormCoefficient.positive` of each coefficient is adapted to the effect's site.

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
    """Return the form that an effect names, or a form for its own equation; no FMU is needed.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    return _chosen(effect, parse_site(effect.site, f"{where}: site"), where)


def divisors(effect: Effect, where: str) -> tuple[str, ...]:
    """Return the coefficients by which a form divides; () for a user's own equation.

    Raises
    ------
    EffectError
        If its site cannot be read or its form is unknown.
    """
    chosen = form_of(effect, where)
    own = chosen.coefficients if not effect.equation else ()
    return tuple(c.name for c in own if chosen.divides_by(c.name))


def _chosen(effect: Effect, site: EffectSite, where: str) -> EffectForm:
    """Return the form that an effect names, or a form for its own equation."""
    if effect.reaction and (site.kind != "pair" or not effect.equation):
        is_given = f"a form ({effect.form!r})" if effect.form else "neither equation nor form"
        but = f"{is_given} is given" if site.kind == "pair" else f"site is {effect.site!r}"
        raise EffectError(
            f'{where}: reaction: can be used only with an equation at a site "pair STATE,STATE", '
            f"but {but}; remove reaction"
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

    States are included in model exchange, and at outputs, whose records contain them. In
    co-simulation, all variables are included that can be read at communication points.
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
    """Return the expressions of a form's `v` and `w`; all variables for a user's equation."""
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
    """Return the expression of a variable or of a difference of two variables."""
    names = split_variable(text, variables)
    if not names:
        parse(text, variables, where)  # its error message says which name is unknown
        raise EffectError(
            f"{where}: must be a name or the difference of two names, but is {text!r}"
        )
    first, *second = (variables[name] for name in names)
    return first - second[0] if second else first
