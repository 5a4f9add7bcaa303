"""The functions of FMI 2.0 and 3.0 under the standard's names, for compiled loops.

Each returns the standard's status: 0 OK, 1 warning, 2 discard, 3 error, 4 fatal, 5 pending. Where
the versions differ, the function of the instance's version is called with what it takes.

What FMUs say of events is in an array of int32 in the order of fmi2EventInfo, from `UPDATE_NEEDED`
to `NEXT_EVENT_DEFINED`, followed by the time of the next event; then come whether a step needs an
event, whether the FMU ends the simulation, and room for FMI 3.0's booleans, which are bytes.
"""

from __future__ import annotations

from math import ceil

import numpy as np
from numba.core.types import float64, int32, intp, uintp

from workers.kernels.fmi.calling import address_of, c_function, is_fmi_2, peek
from workers.kernels.fmi.compiling import inlined

(
    UPDATE_NEEDED,
    TERMINATE,
    NOMINALS_CHANGED,
    VALUES_CHANGED,
    NEXT_EVENT_DEFINED,
    NEXT_EVENT_TIME,
    EVENT_NEEDED,
    SIMULATION_ENDED,
    BOOLEANS,
) = 0, 1, 2, 3, 4, 6, 8, 9, 10

_handle_only = c_function(int32, intp)
_setup = c_function(int32, intp, int32, float64, float64, int32, float64)
_time = c_function(int32, intp, float64)
_vector = c_function(int32, intp, intp, uintp)
_strings = c_function(int32, intp, intp, uintp, intp)
_strings_3 = c_function(int32, intp, intp, uintp, intp, uintp)
_event = c_function(int32, intp, intp)
_event_3 = c_function(int32, intp, intp, intp, intp, intp, intp, intp)
_completed = c_function(int32, intp, int32, intp, intp)
_step = c_function(int32, intp, float64, float64, int32)
_step_3 = c_function(int32, intp, float64, float64, int32, intp, intp, intp, intp)
_input_derivatives = c_function(int32, intp, intp, uintp, intp, intp)
_directional = c_function(int32, intp, intp, uintp, intp, uintp, intp, intp)
_directional_3 = c_function(int32, intp, intp, uintp, intp, uintp, intp, uintp, intp, uintp)


@inlined
def reset(c):  # type: ignore[no-untyped-def]
    """Reset the instance."""
    return _handle_only(c.reset, (c.handle,))


@inlined
def enter_configuration_mode(c):  # type: ignore[no-untyped-def]
    """Enter the mode in which structural parameters are set (FMI 3.0)."""
    return _handle_only(c.enter_configuration_mode, (c.handle,))


@inlined
def exit_configuration_mode(c):  # type: ignore[no-untyped-def]
    """Leave it."""
    return _handle_only(c.exit_configuration_mode, (c.handle,))


@inlined
def set_strings(c, references, texts):  # type: ignore[no-untyped-def]
    """Set string variables to texts, given by their addresses."""
    at, count, first = address_of(references), len(references), address_of(texts)
    if is_fmi_2(c):
        return _strings(c.set_string, (c.handle, at, count, first))
    return _strings_3(c.set_string, (c.handle, at, count, first, count))


@inlined
def setup_experiment(c, tolerance, start, stop):  # type: ignore[no-untyped-def]
    """Name the start time, a tolerance, where 0 is none, and a stop time, for those that need it.

    FMI 3.0 is told these later.
    """
    if not is_fmi_2(c):
        return 0
    return _set_up(c, c.setup_experiment, tolerance, start, stop)


@inlined
def enter_initialization_mode(c, tolerance, start, stop):  # type: ignore[no-untyped-def]
    """Begin initialisation."""
    if is_fmi_2(c):
        return _handle_only(c.enter_initialization_mode, (c.handle,))
    return _set_up(c, c.enter_initialization_mode, tolerance, start, stop)


@inlined
def _set_up(c, function, tolerance, start, stop):  # type: ignore[no-untyped-def]
    told, unit = stop, c.stop_unit
    if unit > 0.0:
        told = start + unit * max(1.0, ceil((stop - start) / unit))
    values = (
        c.handle,
        tolerance > 0.0,
        tolerance,
        start,
        unit >= 0.0,
        told if unit >= 0.0 else 0.0,
    )
    return _setup(function, values)


@inlined
def exit_initialization_mode(c):  # type: ignore[no-untyped-def]
    """End initialisation."""
    return _handle_only(c.exit_initialization_mode, (c.handle,))


@inlined
def set_time(c, time):  # type: ignore[no-untyped-def]
    """Set the time."""
    return _time(c.set_time, (c.handle, time))


@inlined
def set_continuous_states(c, states):  # type: ignore[no-untyped-def]
    """Set the continuous states; the array may be longer."""
    return _vector(c.set_continuous_states, (c.handle, address_of(states), c.n_states))


@inlined
def get_continuous_states(c, states):  # type: ignore[no-untyped-def]
    """Get the continuous states."""
    return _vector(c.get_continuous_states, (c.handle, address_of(states), c.n_states))


@inlined
def get_nominals_of_continuous_states(c, nominals):  # type: ignore[no-untyped-def]
    """Get the nominal values of the continuous states."""
    return _vector(c.get_nominals, (c.handle, address_of(nominals), c.n_states))


@inlined
def get_derivatives(c, derivatives):  # type: ignore[no-untyped-def]
    """Get the derivatives of the continuous states."""
    return _vector(c.get_derivatives, (c.handle, address_of(derivatives), c.n_states))


@inlined
def get_event_indicators(c, indicators):  # type: ignore[no-untyped-def]
    """Get the event indicators."""
    return _vector(c.get_event_indicators, (c.handle, address_of(indicators), c.n_indicators))


@inlined
def enter_event_mode(c):  # type: ignore[no-untyped-def]
    """Enter the mode in which events are handled."""
    return _handle_only(c.enter_event_mode, (c.handle,))


@inlined
def update_discrete_states(c, info):  # type: ignore[no-untyped-def]
    """Update discrete states: fmi2NewDiscreteStates in FMI 2.0. Fills `info` from AGAIN to NEXT."""
    at = address_of(info)
    if is_fmi_2(c):
        return _event(c.update_discrete_states, (c.handle, at))
    b = at + 4 * BOOLEANS
    status = _event_3(
        c.update_discrete_states,
        (c.handle, b, b + 1, b + 2, b + 3, b + 4, at + 4 * NEXT_EVENT_TIME),
    )
    for j in range(5):
        info[j] = peek(b + j, np.uint8(0))
    return status


@inlined
def next_event_time(info):  # type: ignore[no-untyped-def]
    """Return the time of the next time event, infinite if there is none."""
    time = peek(address_of(info) + 4 * NEXT_EVENT_TIME, np.float64(0.0))
    return time if info[NEXT_EVENT_DEFINED] != 0 else np.inf


@inlined
def enter_continuous_time_mode(c):  # type: ignore[no-untyped-def]
    """Enter the mode in which the states are integrated."""
    return _handle_only(c.enter_continuous_time_mode, (c.handle,))


@inlined
def completed_integrator_step(c, info):  # type: ignore[no-untyped-def]
    """Fill WANTS and ENDED of `info`."""
    at = address_of(info)
    if is_fmi_2(c):
        return _completed(
            c.completed_integrator_step,
            (c.handle, 1, at + 4 * EVENT_NEEDED, at + 4 * SIMULATION_ENDED),
        )
    b = at + 4 * BOOLEANS
    status = _completed(c.completed_integrator_step, (c.handle, 1, b, b + 1))
    info[EVENT_NEEDED], info[SIMULATION_ENDED] = peek(b, np.uint8(0)), peek(b + 1, np.uint8(0))
    return status


@inlined
def do_step(c, time, step, info):  # type: ignore[no-untyped-def]
    """Take one communication step; see `has_terminated` for an FMU that ends the simulation."""
    if is_fmi_2(c):
        return _step(c.do_step, (c.handle, time, step, 1))
    b = address_of(info) + 4 * BOOLEANS
    to = address_of(info) + 4 * NEXT_EVENT_TIME
    status = _step_3(c.do_step, (c.handle, time, step, 1, b, b + 1, b + 2, to))
    info[SIMULATION_ENDED] = peek(b + 1, np.uint8(0))
    return status


@inlined
def has_terminated(c, info):  # type: ignore[no-untyped-def]
    """Return whether the FMU of FMI 3.0 terminated with the last step."""
    return False if is_fmi_2(c) else info[SIMULATION_ENDED] != 0


@inlined
def last_successful_time(info):  # type: ignore[no-untyped-def]
    """Return the time that the last step of an FMU of FMI 3.0 came to."""
    return peek(address_of(info) + 4 * NEXT_EVENT_TIME, np.float64(0.0))


@inlined
def set_real_input_derivatives(c, references, orders, derivatives):  # type: ignore[no-untyped-def]
    """Set the derivatives of real inputs, for FMUs that interpolate them (FMI 2.0)."""
    return _input_derivatives(
        c.set_real_input_derivatives,
        (
            c.handle,
            address_of(references),
            len(references),
            address_of(orders),
            address_of(derivatives),
        ),
    )


@inlined
def get_directional_derivative(c, unknowns, knowns, n_knowns, seed, result):  # type: ignore[no-untyped-def]
    """Get the derivative of the unknowns along `seed`, a direction in the first knowns.

    Unknowns and knowns are value references of float64 scalars.
    """
    n_unknowns, at, known = len(unknowns), address_of(unknowns), address_of(knowns)
    given, found = address_of(seed), address_of(result)
    if is_fmi_2(c):
        return _directional(
            c.get_directional_derivative,
            (c.handle, at, n_unknowns, known, n_knowns, given, found),
        )
    return _directional_3(
        c.get_directional_derivative,
        (c.handle, at, n_unknowns, known, n_knowns, given, n_knowns, found, n_unknowns),
    )
