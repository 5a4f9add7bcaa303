"""Effects at outputs, applied to recorded outputs.

A lag or a delay of a sensor depends on the output at all times, but the recorded output has values
only at some times. Between them, the output is interpolated. Consider a wave with w h radians
between two values. The error of a straight line is (w h)^2 / 8 of the amplitude. The error of the
cubic through the four values around an interval is 3/128 (w h)^4. With ten values per period, this
is 5 % and 0.4 % (P. J. Davis, Interpolation and Approximation (1975), section 3.1).
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import addressof
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import sympy as sp

from workers.core.assemble import Assignment, EffectArray, Locations, Registers, assemble
from workers.core.failure import FINISHED
from workers.core.library import LoadedProgram, Pieces, Record, core
from workers.effects.definition import SIGNAL_SYMBOL, EffectDefinition, variable_symbol
from workers.effects.signal_memory import MEMORIES, SampledSignal
from workers.grid import SignalGrid
from workers.messages import FloatArray, IntArray

PIECES = 8
"""Number of pieces of each interval; within a piece, a straight line is accurate enough."""
STENCIL = 4
"""Number of recorded values that define a cubic."""
UNEVEN_INTERVALS = 5.0
"""Ratio of the longest to the shortest interval above which no cubic is used."""


def refine(grid: SignalGrid, outputs: FloatArray) -> tuple[SignalGrid, FloatArray]:
    """Divide each interval of a simulation into `PIECES`.

    No cubic extends across a jump of an input, because outputs have a kink there. No cubic extends
    over intervals of very different lengths, because its curvature in the short ones would be
    wrong. In these cases, and between two jumps with fewer than four records, interpolation is
    linear.

    Parameters
    ----------
    grid, outputs : (n, y)
        The simulation.

    Returns
    -------
    grid, outputs : ((n - 1) PIECES + 1, y)
        Every `PIECES`-th row has a time of the simulation and its outputs.
    """
    first, smooth = _stencils(grid)
    count, width = outputs.shape
    rows, columns = (count - 1) * PIECES + 1, grid.inputs.shape[1]
    times, seen = np.empty(rows), np.empty((rows, width))
    inputs, slopes = np.empty((2, rows, columns))
    pieces = Pieces(n_times=count, n_inputs=columns, n_outputs=width, pieces=PIECES)
    pieces.hold(
        np.float64, times=grid.times, lengths=grid.intervals, values=grid.inputs,
        slopes=grid.slopes, outputs=outputs, at=times, fine_values=inputs, fine_slopes=slopes,
        fine_outputs=seen,
    ).hold(np.int64, first=first).hold(np.bool_, smooth=smooth)  # fmt: skip
    core().core_refine(addressof(pieces))
    refined = grid._replace(
        times=times, intervals=np.diff(times, append=times[-1:]), inputs=inputs, slopes=slopes
    )
    return refined, seen


def _stencils(grid: SignalGrid) -> tuple[IntArray, npt.NDArray[np.bool_]]:
    """Return the first record of each interval's cubic, and whether the interval has a cubic."""
    count = len(grid.times)
    intervals = np.arange(count - 1)
    breaks = np.unique([0, *np.flatnonzero(grid.jumps).tolist(), count - 1])
    part = np.searchsorted(breaks, intervals, side="right") - 1
    begin, end = breaks[part], breaks[np.minimum(part + 1, len(breaks) - 1)]
    first = np.clip(intervals - 1, begin, np.maximum(begin, end - STENCIL + 1))
    enough = end - begin >= STENCIL - 1
    rows = np.where(enough, first, 0)[:, None] + np.arange(STENCIL - 1)
    lengths = grid.intervals[np.minimum(rows, count - 2)]
    return first, enough & (lengths.max(axis=1) <= UNEVEN_INTERVALS * lengths.min(axis=1))


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
    program = _compile(definition, recorded, inputs)
    signals = dict(zip((*inputs, *recorded), (*fine.inputs.T, *seen.T), strict=True))
    seen = np.ascontiguousarray(seen)
    record = Record(
        n_times=len(fine.times),
        n_inputs=len(inputs),
        n_outputs=len(recorded),
        column=column,
        every=PIECES if definition.states else 1,
        program=program.address,
        rate=definition.fastest_rate(coefficients, signals),
        decay=definition.decay_rate(coefficients),
    ).hold(
        np.float64, times=fine.times, values=fine.inputs, slopes=fine.slopes,
        coefficients=coefficients, outputs=seen,
    )  # fmt: skip
    if (linear := definition.linear_rates(coefficients)).size:
        record.hold(np.float64, linear=linear)
    if core().core_apply_to_outputs(addressof(record)) != FINISHED:
        raise MemoryError(f"effect at output {definition.site.target!r}")
    outputs[:, column] = seen[:: PIECES if definition.states else 1, column]


@lru_cache(maxsize=512)
def _compile(
    definition: EffectDefinition, recorded: tuple[str, ...], inputs: tuple[str, ...]
) -> LoadedProgram:
    return LoadedProgram(output_code(definition, recorded, inputs))


def output_code(
    definition: EffectDefinition, recorded: tuple[str, ...], inputs: tuple[str, ...]
) -> bytes:
    """Return the byte code of an effect at an output: initial states, value and derivatives."""
    own = len(definition.states)
    seen, coefficients = len(inputs) + len(recorded), len(definition.coefficients)
    ((_, equation),) = definition.equations
    return assemble(
        Registers(own, own, seen, coefficients, parameters=1),
        output_locations(definition, recorded, inputs),
        assigned(EffectArray.STATES, definition.starts),
        assigned(EffectArray.EFFECTIVE_PARAMETERS, [equation]),
        assigned(EffectArray.DERIVATIVES, definition.derivatives),
    )


def output_locations(
    definition: EffectDefinition, recorded: tuple[str, ...], inputs: tuple[str, ...]
) -> Locations:
    """Return the array and index of each symbol; the inputs of the grid precede the outputs."""
    seen = (*inputs, *recorded)
    target = len(inputs) + recorded.index(definition.site.target)
    return {
        **{variable_symbol(name): (EffectArray.INPUTS, i) for i, name in enumerate(seen)},
        SIGNAL_SYMBOL: (EffectArray.INPUTS, target),
        **{s: (EffectArray.COEFFICIENTS, i) for i, s in enumerate(definition.coefficients)},
        **{s: (EffectArray.STATES, i) for i, s in enumerate(definition.states)},
    }


def assigned(array: EffectArray, values: Sequence[sp.Expr]) -> list[Assignment]:
    """Return assignments of values to the first elements of an array."""
    return [Assignment(array, i, value) for i, value in enumerate(values)]
