"""Effects as compiled loops see them: three functions called by address, 0 where there is none.

- ``begin(t, states, raw, coefficients, base)`` starts the effects' own states, which follow the
  FMU's in the array of states;
- ``before(t, states, raw, coefficients, base, edited, varied)`` makes of the measured inputs those
  that the FMU sees, and of the base values of parameters those that hold at this moment;
- ``inside(t, states, raw, coefficients, base, slopes)`` adds to the derivatives of the FMU's states
  and fills in those of the effects' own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core.types import float64, int32, intp

from workers.kernels.fmi.calling import address_of, c_function, inlined
from workers.kernels.fmi.progress import count_simulation
from workers.messages import FloatArray, IntArray


class EffectHooks(NamedTuple):
    """What acts on a batch of simulations.

    `parameters` are value references; `substeps` (steps of the effects' own states within a
    communication step), `coefficients` and `base` have a row for each point.
    """

    begin: int
    before: int
    inside: int
    parameters: IntArray
    substeps: IntArray
    coefficients: FloatArray
    base: FloatArray


def no_hooks(points: int) -> EffectHooks:
    """What acts where there are no effects."""
    nothing = np.zeros((points, 0))
    return EffectHooks(0, 0, 0, np.zeros(0, np.uint32), np.ones(points, np.int64), nothing, nothing)


_begin = c_function(int32, float64, intp, intp, intp, intp)
_before = c_function(int32, float64, intp, intp, intp, intp, intp, intp)
_inside = c_function(int32, float64, intp, intp, intp, intp, intp)


@inlined
def take_point(hooks, p, work):  # type: ignore[no-untyped-def]
    """Begin a simulation: copy a point's coefficients and base values to where hooks find them."""
    count_simulation(work)
    work.counts[0] = hooks.substeps[p]
    for j in range(len(work.coefficients)):
        work.coefficients[j] = hooks.coefficients[p, j]
    for j in range(len(work.base)):
        work.base[j] = hooks.base[p, j]


@inlined
def begin(hooks, time, work):  # type: ignore[no-untyped-def]
    """Start the effects' own states."""
    if hooks.begin != 0:
        _begin(
            hooks.begin,
            (
                time,
                address_of(work.states),
                address_of(work.inputs),
                address_of(work.coefficients),
                address_of(work.base),
            ),
        )


@inlined
def before(hooks, time, states, work):  # type: ignore[no-untyped-def]
    """Edit inputs and parameters; only where there is such a hook."""
    _before(
        hooks.before,
        (
            time,
            address_of(states),
            address_of(work.inputs),
            address_of(work.coefficients),
            address_of(work.base),
            address_of(work.edited),
            address_of(work.varied),
        ),
    )


@inlined
def inside(hooks, time, states, work, slopes):  # type: ignore[no-untyped-def]
    """Add to the derivatives."""
    if hooks.inside != 0:
        _inside(
            hooks.inside,
            (
                time,
                address_of(states),
                address_of(work.inputs),
                address_of(work.coefficients),
                address_of(work.base),
                address_of(slopes),
            ),
        )


@inlined
def take_inputs(grid, i, time, work):  # type: ignore[no-untyped-def]
    """The inputs as measured, at a time in the interval after grid time i."""
    for j in range(len(work.inputs)):
        work.inputs[j] = grid.inputs[i, j] + (time - grid.times[i]) * grid.slopes[i, j]


@inlined
def first_inputs(hooks, grid, work):  # type: ignore[no-untyped-def]
    """The inputs that the FMU is initialised with, into `edited`.

    Its states are not known yet and count as 0.
    """
    take_inputs(grid, 0, grid.times[0], work)
    if hooks.before == 0:
        for j in range(len(work.inputs)):
            work.edited[j] = work.inputs[j]
    else:
        for j in range(len(work.states)):
            work.states[j] = 0.0
        begin(hooks, grid.times[0], work)
        before(hooks, grid.times[0], work.states, work)
