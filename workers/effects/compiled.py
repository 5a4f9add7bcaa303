"""Effects of one experiment as byte code for the core.

An effect at a state derivative, an input or a parameter acts while the simulation runs. It has
three pieces of code: `start_states` sets its internal states at the start, `modify_inputs` changes
inputs and parameters before the FMU receives them, and `add_derivatives` adds to the derivatives.
An effect at an output is applied to the recorded outputs afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import sympy as sp

from workers.core.assemble import Assignment, EffectArray, Locations, Registers, assemble
from workers.core.library import LoadedProgram
from workers.effects.definition import SIGNAL_SYMBOL, EffectDefinition, variable_symbol


@dataclass(frozen=True)
class InnerEffects:
    """Effects that act while a simulation runs.

    Attributes
    ----------
    parameters
        FMU parameters that effects change, in the order of the core's arrays.
    n_effect_states
        Number of internal states of all effects.
    program
        The byte code of the effects, loaded into the core.
    """

    parameters: tuple[str, ...]
    n_effect_states: int
    program: LoadedProgram


@dataclass(frozen=True)
class CompiledEquations:
    """The equations of effects, from which the byte code of the core or of an exported FMU is made.

    Attributes
    ----------
    parameters
        As in `InnerEffects`.
    locations
        (array, index) of each symbol.
    start_states, modify_inputs, add_derivatives
        Assignments of each piece of code.
    """

    parameters: tuple[str, ...]
    locations: Locations
    start_states: tuple[Assignment, ...]
    modify_inputs: tuple[Assignment, ...]
    add_derivatives: tuple[Assignment, ...]

    def code(self, n_states: int, n_inputs: int, n_coefficients: int) -> bytes:
        """Return the byte code; the effects' internal states follow the states of the FMU."""
        own, changed = len(self.start_states), len(self.parameters)
        return assemble(
            Registers(n_states + own, own, n_inputs, n_coefficients, changed, changed),
            self.locations,
            self.start_states,
            self.modify_inputs,
            self.add_derivatives,
        )


@lru_cache(maxsize=512)
def compile_inner(
    definitions: tuple[EffectDefinition, ...],
    positions: tuple[int, ...],
    states: tuple[str, ...],
    inputs: tuple[str, ...],
    n_coefficients: int,
) -> InnerEffects:
    """Compile the effects at derivatives, inputs and parameters.

    The first four arguments are those of `equations`. `n_coefficients` is the number of
    coefficients in a row of the task.
    """
    laid_out = equations(definitions, positions, states, inputs)
    code = laid_out.code(len(states), len(inputs), n_coefficients)
    return InnerEffects(laid_out.parameters, len(laid_out.start_states), LoadedProgram(code))


def equations(
    definitions: tuple[EffectDefinition, ...],
    positions: tuple[int, ...],
    states: tuple[str, ...],
    inputs: tuple[str, ...],
) -> CompiledEquations:
    """Return the equations of effects at derivatives, inputs and parameters, with array positions.

    Parameters
    ----------
    definitions
        The effects, in the order in which they act.
    positions
        For each effect, the index of its first coefficient in the array of coefficients.
    states, inputs
        The FMU's states; the experiment's inputs, followed by the measured signals that effects
        use. Both are in the order of their arrays.
    """
    parameters = tuple(
        dict.fromkeys(d.site.target for d in definitions if d.site.kind == "parameter")
    )
    locations = _locate_symbols(definitions, positions, states, inputs, parameters)
    chain = _EffectChain(inputs, parameters)
    start_states: list[Assignment] = []
    add_derivatives: list[Assignment] = []
    for definition in sorted(definitions, key=lambda d: d.site.at_rates):
        starts, derivatives = _own_states(definition, locations, chain.substitutions(definition))
        start_states += starts
        add_derivatives += derivatives + chain.apply(definition, states)
    changes_signals = not all(d.site.at_rates for d in definitions)
    modify_inputs = chain.assignments() if changes_signals else ()
    return CompiledEquations(
        parameters, locations, tuple(start_states), modify_inputs, tuple(add_derivatives)
    )


def _own_states(
    definition: EffectDefinition,
    locations: Locations,
    substitutions: dict[sp.Symbol, sp.Expr],
) -> tuple[list[Assignment], list[Assignment]]:
    """Return the initial values and the derivatives of an effect's internal states."""
    indices = [locations[symbol][1] for symbol in definition.states]
    starts = [
        Assignment(EffectArray.STATES, i, start.xreplace(substitutions))
        for i, start in zip(indices, definition.starts, strict=True)
    ]
    derivatives = [
        Assignment(EffectArray.DERIVATIVES, i, derivative.xreplace(substitutions))
        for i, derivative in zip(indices, definition.derivatives, strict=True)
    ]
    return starts, derivatives


def _locate_symbols(
    definitions: Sequence[EffectDefinition],
    positions: Sequence[int],
    states: Sequence[str],
    inputs: Sequence[str],
    parameters: Sequence[str],
) -> Locations:
    """Return the array and index of each symbol."""
    locations: Locations = {
        variable_symbol(n): (EffectArray.STATES, i) for i, n in enumerate(states)
    }
    locations |= {variable_symbol(n): (EffectArray.INPUTS, i) for i, n in enumerate(inputs)}
    locations |= {base_symbol(name): (EffectArray.BASE, i) for i, name in enumerate(parameters)}
    position_of_state = len(states)
    for definition, position in zip(definitions, positions, strict=True):
        for i, symbol in enumerate(definition.coefficients):
            locations[symbol] = (EffectArray.COEFFICIENTS, position + i)
        for symbol in definition.states:
            locations[symbol] = (EffectArray.STATES, position_of_state)
            position_of_state += 1
    return locations


class _EffectChain:
    """Expressions of the FMU's inputs and parameters after the effects that were applied so far."""

    def __init__(self, inputs: Sequence[str], parameters: Sequence[str]) -> None:
        self._input_names = tuple(inputs)
        self.inputs: dict[str, sp.Expr] = {name: variable_symbol(name) for name in inputs}
        self.parameters: dict[str, sp.Expr] = {name: base_symbol(name) for name in parameters}

    def substitutions(self, definition: EffectDefinition) -> dict[sp.Symbol, sp.Expr]:
        """Return the expressions that replace signals in the equations of an effect."""
        if definition.site.at_rates:
            return {variable_symbol(name): value for name, value in self.inputs.items()}
        return {SIGNAL_SYMBOL: self._of(definition)[definition.site.target]}

    def apply(self, definition: EffectDefinition, states: Sequence[str]) -> list[Assignment]:
        """Apply an effect: return what it adds to derivatives, or change its signal.

        The effects that follow act on the changed signal.
        """
        substitutions = self.substitutions(definition)
        added = []
        for target, equation in definition.equations:
            expression = equation.xreplace(substitutions)
            if definition.site.at_rates:
                index = states.index(target)
                added.append(Assignment(EffectArray.DERIVATIVES, index, expression, add=True))
            else:
                self._of(definition)[definition.site.target] = expression
        return added

    def assignments(self) -> tuple[Assignment, ...]:
        """Return the assignments of the effective inputs and parameters."""
        inputs = enumerate(self.inputs[name] for name in self._input_names)
        parameters = enumerate(self.parameters.values())
        return (
            *(Assignment(EffectArray.EFFECTIVE_INPUTS, i, value) for i, value in inputs),
            *(Assignment(EffectArray.EFFECTIVE_PARAMETERS, i, value) for i, value in parameters),
        )

    def _of(self, definition: EffectDefinition) -> dict[str, sp.Expr]:
        return self.inputs if definition.site.kind == "input" else self.parameters


def base_symbol(name: str) -> sp.Symbol:
    """Return the symbol of a parameter's value without effects."""
    return sp.Symbol(f"base:{name}", real=True)
