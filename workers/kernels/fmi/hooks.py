"""Effects as compiled loops see them: three functions called by address, 0 where there is none.

- ``start_states(t, states, inputs, coefficients, base_parameters)`` sets the effects' own states at
  the start, which follow the FMU's in the array of states;
- ``modify_inputs(t, states, inputs, coefficients, base_parameters, effective_inputs,
  effective_parameters)`` makes of the measured inputs those that the FMU sees, and of the base
  values of parameters those that hold at this time;
- ``add_derivatives(t, states, inputs, coefficients, base_parameters, derivatives)`` adds to the
  derivatives of the FMU's states and fills in those of the effects' own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core.types import float64, int32, intp

from workers.kernels.fmi.calling import address_of, c_function
from workers.kernels.fmi.compiling import inlined
from workers.kernels.fmi.progress import count_simulation
from workers.messages import FloatArray, IntArray


class EffectHooks(NamedTuple):
    """The effects on a batch of simulations.

    `parameters` are value references; `fastest_rates` (of the effects' own states, as far as the
    coefficients tell), `coefficients` and `base_parameters` have a row for each point.
    """

    start_states: int
    modify_inputs: int
    add_derivatives: int
    parameters: IntArray
    fastest_rates: FloatArray
    coefficients: FloatArray
    base_parameters: FloatArray


def no_hooks(points: int) -> EffectHooks:
    """Return hooks of no effects."""
    nothing = np.zeros((points, 0))
    return EffectHooks(0, 0, 0, np.zeros(0, np.uint32), np.zeros(points), nothing, nothing)


_call_start_states = c_function(int32, float64, intp, intp, intp, intp)
_call_modify_inputs = c_function(int32, float64, intp, intp, intp, intp, intp, intp)
_call_add_derivatives = c_function(int32, float64, intp, intp, intp, intp, intp)


@inlined
def select_point(hooks, p, work):  # type: ignore[no-untyped-def]
    """Begin a simulation: copy a point's coefficients and base values to the workspace."""
    count_simulation(work)
    work.fastest_rate[0] = hooks.fastest_rates[p]
    for j in range(len(work.coefficients)):
        work.coefficients[j] = hooks.coefficients[p, j]
    for j in range(len(work.base_parameters)):
        work.base_parameters[j] = hooks.base_parameters[p, j]


@inlined
def start_effect_states(hooks, time, work):  # type: ignore[no-untyped-def]
    """Set the effects' own states at the start."""
    if hooks.start_states != 0:
        _call_start_states(
            hooks.start_states,
            (
                time,
                address_of(work.states),
                address_of(work.inputs),
                address_of(work.coefficients),
                address_of(work.base_parameters),
            ),
        )


@inlined
def modify_inputs(hooks, time, states, work):  # type: ignore[no-untyped-def]
    """Compute effective inputs and parameters; only where there is such a hook."""
    _call_modify_inputs(
        hooks.modify_inputs,
        (
            time,
            address_of(states),
            address_of(work.inputs),
            address_of(work.coefficients),
            address_of(work.base_parameters),
            address_of(work.effective_inputs),
            address_of(work.effective_parameters),
        ),
    )


@inlined
def add_derivatives(hooks, time, states, work, derivatives):  # type: ignore[no-untyped-def]
    """Add the effects to the derivatives of the states."""
    if hooks.add_derivatives != 0:
        _call_add_derivatives(
            hooks.add_derivatives,
            (
                time,
                address_of(states),
                address_of(work.inputs),
                address_of(work.coefficients),
                address_of(work.base_parameters),
                address_of(derivatives),
            ),
        )


@inlined
def interpolate_inputs(grid, i, time, work):  # type: ignore[no-untyped-def]
    """Interpolate the measured inputs at a time in the interval after grid time i."""
    for j in range(len(work.inputs)):
        work.inputs[j] = grid.inputs[i, j] + (time - grid.times[i]) * grid.slopes[i, j]


@inlined
def initial_inputs(hooks, grid, work):  # type: ignore[no-untyped-def]
    """Compute the inputs that the FMU is initialised with, into `effective_inputs`.

    Its states are not known yet and count as 0.
    """
    interpolate_inputs(grid, 0, grid.times[0], work)
    if hooks.modify_inputs == 0:
        for j in range(len(work.inputs)):
            work.effective_inputs[j] = work.inputs[j]
    else:
        for j in range(len(work.states)):
            work.states[j] = 0.0
        start_effect_states(hooks, grid.times[0], work)
        modify_inputs(hooks, grid.times[0], work.states, work)
