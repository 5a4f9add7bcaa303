"""FMI 2.0 as seen from compiled code: the functions' addresses and thin callers with their names.

Each caller returns the standard's status: 0 OK, 1 warning, 2 discard, 3 error, 4 fatal, 5 pending.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.core.types import float64, int32, intp, uintp

from workers.kernels.calling import address_of, c_function, inlined
from workers.messages import FloatArray, IntArray

DISCARD, ERROR = 2, 3
"""From DISCARD on a call brought no result; from ERROR on the instance must be reset."""


class Component(NamedTuple):
    """An instance of an FMU: its handle and the addresses of its functions.

    `n_states` counts the FMU's own continuous states; arrays of states may be longer.
    `interpolates_inputs` and `completes_steps` repeat the flags canInterpolateInputs and
    completedIntegratorStepNotNeeded (negated) of the model description. Functions that the
    interface does not have are 0.
    """

    handle: int
    reset: int
    setup_experiment: int
    enter_initialization_mode: int
    exit_initialization_mode: int
    set_real: int
    set_integer: int
    set_boolean: int
    get_real: int
    set_time: int
    set_continuous_states: int
    get_continuous_states: int
    get_derivatives: int
    new_discrete_states: int
    enter_continuous_time_mode: int
    completed_integrator_step: int
    do_step: int
    set_real_input_derivatives: int
    interpolates_inputs: bool
    completes_steps: bool
    n_states: int


class References(NamedTuple):
    """Value references of what is written and read: uint32 arrays, in the order of the data."""

    start_reals: IntArray
    start_integers: IntArray
    start_booleans: IntArray
    inputs: IntArray
    outputs: IntArray


class Constants(NamedTuple):
    """Start values of integers and booleans (int32 arrays): alike for every point of a batch."""

    integers: IntArray
    booleans: IntArray


class Workspace(NamedTuple):
    """Memory that a simulation writes to. Reused: nothing is allocated inside a loop.

    `inputs` are as measured; `edited` what effects make of them, `slopes` how fast those change,
    `varied` the parameters that effects vary, `counts` the substeps of the effects' own states.
    `stages` holds the integrator's derivatives, a row a stage; `event_info` is the standard's
    fmi2EventInfo: five int32, four bytes of padding and a float64, here as eight int32.
    """

    inputs: FloatArray
    edited: FloatArray
    slopes: FloatArray
    varied: FloatArray
    coefficients: FloatArray
    base: FloatArray
    counts: IntArray
    orders: IntArray
    states: FloatArray
    trial: FloatArray
    stages: FloatArray
    flags: IntArray
    event_info: IntArray


def workspace(
    n_inputs: int, n_states: int, n_coefficients: int = 0, n_parameters: int = 0
) -> Workspace:
    """Allocate the memory for one instance; the last two are those of effects."""
    return Workspace(
        inputs=np.zeros(n_inputs),
        edited=np.zeros(n_inputs),
        slopes=np.zeros(n_inputs),
        varied=np.zeros(n_parameters),
        coefficients=np.zeros(n_coefficients),
        base=np.zeros(n_parameters),
        counts=np.ones(1, np.int64),
        orders=np.ones(n_inputs, np.int32),
        states=np.zeros(n_states),
        trial=np.zeros(n_states),
        stages=np.zeros((7, n_states)),
        flags=np.zeros(2, np.int32),
        event_info=np.zeros(8, np.int32),
    )


_handle_only = c_function(int32, intp)
_setup = c_function(int32, intp, int32, float64, float64, int32, float64)
_values = c_function(int32, intp, intp, uintp, intp)
_time = c_function(int32, intp, float64)
_vector = c_function(int32, intp, intp, uintp)
_event = c_function(int32, intp, intp)
_completed = c_function(int32, intp, int32, intp, intp)
_step = c_function(int32, intp, float64, float64, int32)
_slopes = c_function(int32, intp, intp, uintp, intp, intp)


@inlined
def reset(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.reset, (c.handle,))


@inlined
def setup_experiment(c, tolerance, start):  # type: ignore[no-untyped-def]
    return _setup(c.setup_experiment, (c.handle, tolerance > 0.0, tolerance, start, 0, 0.0))


@inlined
def enter_initialization_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.enter_initialization_mode, (c.handle,))


@inlined
def exit_initialization_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.exit_initialization_mode, (c.handle,))


@inlined
def set_real(c, references, values):  # type: ignore[no-untyped-def]
    return _values(
        c.set_real, (c.handle, address_of(references), len(references), address_of(values))
    )


@inlined
def set_integer(c, references, values):  # type: ignore[no-untyped-def]
    return _values(
        c.set_integer, (c.handle, address_of(references), len(references), address_of(values))
    )


@inlined
def set_boolean(c, references, values):  # type: ignore[no-untyped-def]
    return _values(
        c.set_boolean, (c.handle, address_of(references), len(references), address_of(values))
    )


@inlined
def get_real(c, references, values):  # type: ignore[no-untyped-def]
    return _values(
        c.get_real, (c.handle, address_of(references), len(references), address_of(values))
    )


@inlined
def set_time(c, time):  # type: ignore[no-untyped-def]
    return _time(c.set_time, (c.handle, time))


@inlined
def set_continuous_states(c, states):  # type: ignore[no-untyped-def]
    return _vector(c.set_continuous_states, (c.handle, address_of(states), c.n_states))


@inlined
def get_continuous_states(c, states):  # type: ignore[no-untyped-def]
    return _vector(c.get_continuous_states, (c.handle, address_of(states), c.n_states))


@inlined
def get_derivatives(c, derivatives):  # type: ignore[no-untyped-def]
    return _vector(c.get_derivatives, (c.handle, address_of(derivatives), c.n_states))


@inlined
def new_discrete_states(c, event_info):  # type: ignore[no-untyped-def]
    return _event(c.new_discrete_states, (c.handle, address_of(event_info)))


@inlined
def enter_continuous_time_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.enter_continuous_time_mode, (c.handle,))


@inlined
def completed_integrator_step(c, flags):  # type: ignore[no-untyped-def]
    at = address_of(flags)
    return _completed(c.completed_integrator_step, (c.handle, 1, at, at + 4))


@inlined
def do_step(c, time, step):  # type: ignore[no-untyped-def]
    return _step(c.do_step, (c.handle, time, step, 1))


@inlined
def set_real_input_derivatives(c, references, orders, slopes):  # type: ignore[no-untyped-def]
    return _slopes(
        c.set_real_input_derivatives,
        (c.handle, address_of(references), len(references), address_of(orders), address_of(slopes)),
    )
