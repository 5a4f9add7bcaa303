"""Effects of one experiment made ready for the compiled loops.

An effect at a state derivative, an input or a parameter acts while the simulation runs, through
three functions: `begin` starts its own states, `before` edits inputs and parameters before the FMU
sees them, `inside` adds to the derivatives. An effect at an output acts on the record afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy as sp

from workers.effects.definition import SIGNAL, TIME, EffectDefinition, variable_symbol
from workers.effects.source import CAssignment, compile_function

Places = dict[sp.Symbol, tuple[str, int]]


@dataclass(frozen=True)
class InnerEffects:
    """What acts while a simulation runs.

    Attributes
    ----------
    parameters
        FMU parameters that are modulated, in the order of the `base` and `varied` arrays.
    own_states
        How many states the effects bring along.
    begin, before, inside
        Compiled functions, None where there is nothing to do.
    """

    parameters: tuple[str, ...]
    own_states: int
    begin: Any
    before: Any
    inside: Any


@dataclass(frozen=True)
class CompiledEquations:
    """What `InnerEffects` is compiled from: also what an exported FMU prints as C.

    Attributes
    ----------
    parameters
        As in `InnerEffects`.
    places
        Where each symbol stands: (array, index).
    begin, before, inside
        What each function assigns.
    """

    parameters: tuple[str, ...]
    places: Places
    begin: tuple[CAssignment, ...]
    before: tuple[CAssignment, ...]
    inside: tuple[CAssignment, ...]


@lru_cache(maxsize=512)
def compile_inner(
    definitions: tuple[EffectDefinition, ...],
    positions: tuple[int, ...],
    states: tuple[str, ...],
    inputs: tuple[str, ...],
) -> InnerEffects:
    """Compile the effects at derivatives, inputs and parameters; arguments as of `equations`."""
    made = equations(definitions, positions, states, inputs)
    return InnerEffects(
        parameters=made.parameters,
        own_states=len(made.begin),
        begin=_compile(READ, made.places, made.begin),
        before=_compile((*READ, "edited", "varied"), made.places, made.before),
        inside=_compile((*READ, "slopes"), made.places, made.inside),
    )


def equations(
    definitions: tuple[EffectDefinition, ...],
    positions: tuple[int, ...],
    states: tuple[str, ...],
    inputs: tuple[str, ...],
) -> CompiledEquations:
    """Lay the equations of effects at derivatives, inputs and parameters on arrays.

    Parameters
    ----------
    definitions
        Those effects, in the order in which they act.
    positions
        Where the coefficients of each begin in the array of coefficients.
    states, inputs
        The FMU's states, and the experiment's inputs with the signals that are used behind them,
        in the order of their arrays.
    """
    parameters = tuple(
        dict.fromkeys(d.site.target for d in definitions if d.site.kind == "parameter")
    )
    places = _places(definitions, positions, states, inputs, parameters)
    chain = _EffectChain(inputs, parameters)
    begin: list[CAssignment] = []
    inside: list[CAssignment] = []
    for definition in sorted(definitions, key=lambda d: d.site.at_rates):
        meaning = chain.meaning(definition)
        for symbol, start, slope in zip(
            definition.states, definition.starts, definition.derivatives, strict=True
        ):
            index = places[symbol][1]
            begin.append(CAssignment("states", index, start.xreplace(meaning)))
            inside.append(CAssignment("slopes", index, slope.xreplace(meaning)))
        for target, equation in definition.parts:
            here = equation.xreplace(meaning)
            if definition.site.at_rates:
                inside.append(CAssignment("slopes", states.index(target), here, add=True))
            else:
                chain.replace(definition, here)
    before = [CAssignment("edited", i, chain.inputs[n]) for i, n in enumerate(inputs)]
    before += [CAssignment("varied", i, chain.parameters[n]) for i, n in enumerate(parameters)]
    if all(d.site.at_rates for d in definitions):
        before = []
    return CompiledEquations(parameters, places, tuple(begin), tuple(before), tuple(inside))


READ = ("states", "raw", "coefficients", "base")
"""Arrays that every function reads: states, inputs as measured, coefficients, parameters."""


def _compile(arrays: tuple[str, ...], places: Places, assignments: Sequence[CAssignment]) -> Any:
    return compile_function(arrays, places, assignments, TIME) if assignments else None


def _places(
    definitions: Sequence[EffectDefinition],
    positions: Sequence[int],
    states: Sequence[str],
    inputs: Sequence[str],
    parameters: Sequence[str],
) -> Places:
    """Where each symbol stands in the arrays."""
    places: Places = {variable_symbol(n): ("states", i) for i, n in enumerate(states)}
    places |= {variable_symbol(n): ("raw", i) for i, n in enumerate(inputs)}
    places |= {_base(name): ("base", i) for i, name in enumerate(parameters)}
    own = len(states)
    for definition, position in zip(definitions, positions, strict=True):
        for i, symbol in enumerate(definition.coefficients):
            places[symbol] = ("coefficients", position + i)
        for symbol in definition.states:
            places[symbol] = ("states", own)
            own += 1
    return places


class _EffectChain:
    """What reaches the FMU at each input and parameter after the effects so far."""

    def __init__(self, inputs: Sequence[str], parameters: Sequence[str]) -> None:
        self.inputs: dict[str, sp.Expr] = {name: variable_symbol(name) for name in inputs}
        self.parameters: dict[str, sp.Expr] = {name: _base(name) for name in parameters}

    def meaning(self, definition: EffectDefinition) -> dict[sp.Symbol, sp.Expr]:
        """What the symbols of an effect's equations stand for at its site."""
        if definition.site.at_rates:
            return {variable_symbol(name): value for name, value in self.inputs.items()}
        return {SIGNAL: self._of(definition)[definition.site.target]}

    def replace(self, definition: EffectDefinition, equation: sp.Expr) -> None:
        """Let an equation take the place of its signal, for the effects that follow."""
        self._of(definition)[definition.site.target] = equation

    def _of(self, definition: EffectDefinition) -> dict[str, sp.Expr]:
        return self.inputs if definition.site.kind == "input" else self.parameters


def _base(name: str) -> sp.Symbol:
    """The value of a parameter without its effects."""
    return sp.Symbol(f"base:{name}", real=True)
