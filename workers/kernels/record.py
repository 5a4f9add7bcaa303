"""Effects at outputs: applied to recorded outputs after a simulation.

An own state that follows signals linearly, x' = g(t) - a x with g linear between two times of the
grid, is advanced exactly, in one step, by an exponential integrator (M. Hochbruck, A. Ostermann,
Acta Numerica 19 (2010) 209-286, doi:10.1017/S0962492910000048). Others are advanced by Runge-Kutta
substeps, eight for each time constant.
"""

from __future__ import annotations

from math import expm1
from typing import NamedTuple

from numba.core.types import float64, int32, intp

from workers.kernels.fmi.calling import address_of, c_function
from workers.kernels.fmi.compiling import inlined, kernel
from workers.kernels.fmi.own_states import substep_count
from workers.messages import FloatArray


class OutputHooks(NamedTuple):
    """Three functions by address, 0 where there is none.

    ``start_states(t, states, outputs, inputs, coefficients)`` sets the effect's own states at the
    start, ``state_derivatives(t, states, outputs, inputs, coefficients, derivatives)`` gives their
    derivatives, and ``output(t, states, outputs, inputs, coefficients, result)`` the output.
    """

    start_states: int
    state_derivatives: int
    output: int


class OutputWorkspace(NamedTuple):
    """Memory of an effect at an output; `outputs` and `inputs` hold the values at one time."""

    states: FloatArray
    trial: FloatArray
    stages: FloatArray
    outputs: FloatArray
    inputs: FloatArray
    result: FloatArray


class OwnStateMotion(NamedTuple):
    """How fast the effect's own states are.

    `rate` is the fastest one of the whole record; `decay` is that of a state which follows signals
    linearly, 0.0 where it does not.
    """

    rate: float
    decay: float


SMALL = 1e-2
"""Exponent below which a series is more exact than a difference."""

_call = c_function(int32, float64, intp, intp, intp, intp)
_call_into = c_function(int32, float64, intp, intp, intp, intp, intp)


@kernel
def apply_to_outputs(hooks, grid, outputs, column, coefficients, motion, work):  # type: ignore[no-untyped-def]
    """Apply an effect to one column of the recorded outputs.

    Between times of the grid, outputs are interpolated linearly.

    Parameters
    ----------
    outputs : (n, y)
        Outputs at each time of the grid; changed in place.
    column
        Index of the output that the effect is at.
    coefficients
        Of the effect.
    motion
        Of the effect's own states.
    """
    for i in range(len(grid.times)):
        if i > 0 and hooks.state_derivatives != 0:
            if motion.decay > 0.0:
                _follow(hooks, grid, outputs, i - 1, motion.decay, coefficients, work)
            else:
                substeps = substep_count(grid.times[i] - grid.times[i - 1], motion.rate)
                for n in range(substeps):
                    _advance_states(hooks, grid, outputs, i - 1, n, substeps, coefficients, work)
        _interpolate(grid, outputs, i, 0.0, work)
        if i == 0 and hooks.start_states != 0:
            _call_hook(hooks.start_states, grid.times[0], work.states, coefficients, work)
        _call_hook_into(hooks.output, grid.times[i], work.states, coefficients, work, work.result)
        if i > 0:
            outputs[i - 1, column] = work.stages[4, 0]
        work.stages[4, 0] = work.result[0]
    outputs[len(grid.times) - 1, column] = work.stages[4, 0]


@inlined
def _follow(hooks, grid, outputs, i, decay, coefficients, work):  # type: ignore[no-untyped-def]
    """Advance the one own state over the interval after grid time i, where it follows linearly."""
    x, first, last = work.states, work.stages[0], work.stages[1]
    length = grid.times[i + 1] - grid.times[i]
    _interpolate(grid, outputs, i, 0.0, work)
    _call_hook_into(hooks.state_derivatives, grid.times[i], x, coefficients, work, first)
    _interpolate(grid, outputs, i, 1.0, work)
    _call_hook_into(hooks.state_derivatives, grid.times[i + 1], x, coefficients, work, last)
    z = -decay * length
    if abs(z) < SMALL:
        once = 1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0)))
        twice = 0.5 + z / 6.0 * (1.0 + z / 4.0 * (1.0 + z / 5.0 * (1.0 + z / 6.0)))
    else:
        once = expm1(z) / z
        twice = (once - 1.0) / z
    x[0] += length * (once * first[0] + twice * (last[0] - first[0]))


@inlined
def _advance_states(hooks, grid, outputs, i, n, substeps, coefficients, work):  # type: ignore[no-untyped-def]
    """Advance the effect's states by Runge-Kutta substep n of those after grid time i."""
    x, trial, k = work.states, work.trial, work.stages
    length = grid.times[i + 1] - grid.times[i]
    step = length / substeps
    for stage in range(4):
        node = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        for j in range(len(x)):
            trial[j] = x[j] + node * step * k[max(stage - 1, 0), j] if stage > 0 else x[j]
        fraction = (n + node) / substeps
        _interpolate(grid, outputs, i, fraction, work)
        time = grid.times[i] + fraction * length
        _call_hook_into(hooks.state_derivatives, time, trial, coefficients, work, k[stage])
    for j in range(len(x)):
        x[j] += step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])


@inlined
def _interpolate(grid, outputs, i, fraction, work):  # type: ignore[no-untyped-def]
    """Interpolate outputs and inputs at a fraction of the interval after grid time i."""
    output = min(i + 1, len(grid.times) - 1)
    for j in range(len(work.outputs)):
        work.outputs[j] = outputs[i, j] + fraction * (outputs[output, j] - outputs[i, j])
    length = grid.times[output] - grid.times[i]
    for j in range(len(work.inputs)):
        work.inputs[j] = grid.inputs[i, j] + fraction * length * grid.slopes[i, j]


@inlined
def _call_hook(function, time, states, coefficients, work):  # type: ignore[no-untyped-def]
    _call(
        function,
        (
            time,
            address_of(states),
            address_of(work.outputs),
            address_of(work.inputs),
            address_of(coefficients),
        ),
    )


@inlined
def _call_hook_into(function, time, states, coefficients, work, target):  # type: ignore[no-untyped-def]
    _call_into(
        function,
        (
            time,
            address_of(states),
            address_of(work.outputs),
            address_of(work.inputs),
            address_of(coefficients),
            address_of(target),
        ),
    )
