"""Effects at outputs, compiled and applied to recorded outputs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from workers.effects.between_samples import PIECES, refine
from workers.effects.definition import SIGNAL, TIME, EffectDefinition, variable_symbol
from workers.effects.memory import MEMORIES, SampledSignal
from workers.effects.source import CAssignment, EffectArray, SymbolLocations, compile_function
from workers.grid import SignalGrid
from workers.kernels.record import (
    OutputHooks,
    OutputWorkspace,
    OwnStateMotion,
    apply_to_outputs,
)
from workers.messages import FloatArray

READ = (
    EffectArray.STATES,
    EffectArray.OUTPUTS,
    EffectArray.INPUTS,
    EffectArray.COEFFICIENTS,
)


@dataclass(frozen=True)
class CompiledOutputEffect:
    """The functions of an effect at an output; they must be kept as long as they are called."""

    start_states: Any
    state_derivatives: Any
    output: Any
    states: int

    def hooks(self) -> OutputHooks:
        """Return their addresses."""
        return OutputHooks(
            self.start_states.address if self.start_states else 0,
            self.state_derivatives.address if self.state_derivatives else 0,
            self.output.address,
        )


def apply_output_effect(
    definition: EffectDefinition,
    coefficients: FloatArray,
    grid: SignalGrid,
    outputs: FloatArray,
    recorded: tuple[str, ...],
    inputs: tuple[str, ...],
) -> None:
    """Apply an effect at an output to the recorded outputs of one simulation, in place.

    Parameters
    ----------
    definition, coefficients
        The effect and the values of its coefficients.
    grid, outputs : (n, y)
        The simulation.
    recorded, inputs
        Names of the columns of the outputs and of the grid.
    """
    column = recorded.index(definition.site.target)
    if definition.form.memory:
        change = MEMORIES[definition.form.memory]
        fine, seen = refine(grid, outputs[:, [column]])
        changed = change(SampledSignal(fine.times, seen[:, 0]), float(coefficients[0]))
        outputs[:, column] = np.interp(grid.times, changed.times, changed.values)
        return
    fine, seen = refine(grid, outputs) if definition.states else (grid, outputs)
    compiled = _compile(definition, recorded, inputs)
    work = OutputWorkspace(
        states=np.zeros(compiled.states),
        trial=np.zeros(compiled.states),
        stages=np.zeros((5, max(1, compiled.states))),
        outputs=np.zeros(len(recorded)),
        inputs=np.zeros(len(inputs)),
        result=np.zeros(1),
    )
    signals = dict(zip((*recorded, *inputs), (*seen.T, *fine.inputs.T), strict=True))
    motion = OwnStateMotion(
        definition.fastest_rate(coefficients, signals), definition.decay_rate(coefficients)
    )
    own_coefficients = np.ascontiguousarray(coefficients)
    apply_to_outputs(compiled.hooks(), fine, seen, column, own_coefficients, motion, work)
    if seen is not outputs:
        outputs[:, column] = seen[::PIECES, column]


@lru_cache(maxsize=512)
def _compile(
    definition: EffectDefinition, recorded: tuple[str, ...], inputs: tuple[str, ...]
) -> CompiledOutputEffect:
    locations: SymbolLocations = {
        variable_symbol(name): (EffectArray.INPUTS, i) for i, name in enumerate(inputs)
    }
    locations |= {
        variable_symbol(name): (EffectArray.OUTPUTS, i) for i, name in enumerate(recorded)
    }
    locations[SIGNAL] = (EffectArray.OUTPUTS, recorded.index(definition.site.target))
    locations |= {s: (EffectArray.COEFFICIENTS, i) for i, s in enumerate(definition.coefficients)}
    locations |= {s: (EffectArray.STATES, i) for i, s in enumerate(definition.states)}
    start_states = [CAssignment(EffectArray.STATES, i, e) for i, e in enumerate(definition.starts)]
    state_derivatives = [
        CAssignment(EffectArray.DERIVATIVES, i, e) for i, e in enumerate(definition.derivatives)
    ]
    output = [CAssignment(EffectArray.RESULT, 0, equation) for _, equation in definition.equations]
    own_coefficients = bool(definition.states)
    return CompiledOutputEffect(
        start_states=compile_function(READ, locations, start_states, TIME)
        if own_coefficients
        else None,
        state_derivatives=compile_function(
            (*READ, EffectArray.DERIVATIVES), locations, state_derivatives, TIME
        )
        if own_coefficients
        else None,
        output=compile_function((*READ, EffectArray.RESULT), locations, output, TIME),
        states=len(definition.states),
    )
