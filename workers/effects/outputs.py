"""Effects at outputs, made ready to act on a record."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import sympy as sp

from workers.effects.definition import SIGNAL, TIME, EffectDefinition, variable_symbol
from workers.effects.memory import MEMORIES
from workers.effects.source import CAssignment, compile_function
from workers.grid import SignalGrid
from workers.kernels.record import OutputHooks, OutputWorkspace, edit_record
from workers.messages import FloatArray

READ = ("states", "record", "raw", "coefficients")


@dataclass(frozen=True)
class CompiledOutputEffect:
    """The functions of an effect at an output; they must be kept as long as they are called."""

    begin: Any
    inside: Any
    after: Any
    states: int


def act_on_record(
    definition: EffectDefinition,
    coefficients: FloatArray,
    grid: SignalGrid,
    record: FloatArray,
    recorded: tuple[str, ...],
    inputs: tuple[str, ...],
) -> None:
    """Let an effect at an output act on one simulation's record, in place.

    Parameters
    ----------
    definition, coefficients
        The effect and the values of its coefficients.
    grid, record : (n, y)
        The simulation.
    recorded, inputs
        Names of the record's and of the grid's columns.
    """
    column = recorded.index(definition.site.target)
    if definition.form.memory:
        change = MEMORIES[definition.form.memory]
        times, values = change(grid.times, record[:, column], float(coefficients[0]))
        record[:, column] = np.interp(grid.times, times, values)
        return
    ready = _compile(definition, recorded, inputs)
    work = OutputWorkspace(
        states=np.zeros(ready.states),
        trial=np.zeros(ready.states),
        stages=np.zeros((5, max(1, ready.states))),
        row=np.zeros(len(recorded)),
        raw=np.zeros(len(inputs)),
        result=np.zeros(1),
    )
    hooks = OutputHooks(
        ready.begin.address if ready.begin else 0,
        ready.inside.address if ready.inside else 0,
        ready.after.address,
    )
    signals = dict(zip((*recorded, *inputs), (*record.T, *grid.inputs.T), strict=True))
    substeps = definition.substeps(coefficients, float(np.diff(grid.times).max()), signals)
    own = np.ascontiguousarray(coefficients)
    edit_record(hooks, grid, record, column, own, substeps, work)


@lru_cache(maxsize=512)
def _compile(
    definition: EffectDefinition, recorded: tuple[str, ...], inputs: tuple[str, ...]
) -> CompiledOutputEffect:
    places: dict[sp.Symbol, tuple[str, int]] = {
        variable_symbol(name): ("raw", i) for i, name in enumerate(inputs)
    }
    places |= {variable_symbol(name): ("record", i) for i, name in enumerate(recorded)}
    places[SIGNAL] = ("record", recorded.index(definition.site.target))
    places |= {s: ("coefficients", i) for i, s in enumerate(definition.coefficients)}
    places |= {s: ("states", i) for i, s in enumerate(definition.states)}
    begin = [CAssignment("states", i, e) for i, e in enumerate(definition.starts)]
    inside = [CAssignment("slopes", i, e) for i, e in enumerate(definition.derivatives)]
    after = [CAssignment("result", 0, equation) for _, equation in definition.parts]
    own = bool(definition.states)
    return CompiledOutputEffect(
        begin=compile_function(READ, places, begin, TIME) if own else None,
        inside=compile_function((*READ, "slopes"), places, inside, TIME) if own else None,
        after=compile_function((*READ, "result"), places, after, TIME),
        states=len(definition.states),
    )
