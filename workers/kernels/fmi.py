"""The functions of FMI 2.0 and 3.0 under the standard's names, for compiled loops.

Each returns the standard's status: 0 OK, 1 warning, 2 discard, 3 error, 4 fatal, 5 pending. Where
the versions differ, the function of the instance's version is called with what it takes.
"""

from __future__ import annotations

from numba.core.types import float64, int32, intp, uintp

from workers.kernels.calling import address_of, c_function, inlined

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
_slopes = c_function(int32, intp, intp, uintp, intp, intp)
_directional = c_function(int32, intp, intp, uintp, intp, uintp, intp, intp)
_directional_3 = c_function(int32, intp, intp, uintp, intp, uintp, intp, uintp, intp, uintp)


@inlined
def reset(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.reset, (c.handle,))


@inlined
def enter_configuration_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.enter_configuration_mode, (c.handle,))


@inlined
def exit_configuration_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.exit_configuration_mode, (c.handle,))


@inlined
def set_strings(c, references, texts):  # type: ignore[no-untyped-def]
    at, count, first = address_of(references), len(references), address_of(texts)
    if c.version == 2:
        return _strings(c.set_string, (c.handle, at, count, first))
    return _strings_3(c.set_string, (c.handle, at, count, first, count))


@inlined
def enter_initialization_mode(c, tolerance, start):  # type: ignore[no-untyped-def]
    """Begin initialisation at a time; a tolerance of 0 is not given."""
    given = tolerance > 0.0
    if c.version == 3:
        return _setup(c.enter_initialization_mode, (c.handle, given, tolerance, start, 0, 0.0))
    status = _setup(c.setup_experiment, (c.handle, given, tolerance, start, 0, 0.0))
    if status < 2:
        status = max(status, _handle_only(c.enter_initialization_mode, (c.handle,)))
    return status


@inlined
def exit_initialization_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.exit_initialization_mode, (c.handle,))


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
def get_nominals_of_continuous_states(c, nominals):  # type: ignore[no-untyped-def]
    return _vector(c.get_nominals, (c.handle, address_of(nominals), c.n_states))


@inlined
def get_derivatives(c, derivatives):  # type: ignore[no-untyped-def]
    return _vector(c.get_derivatives, (c.handle, address_of(derivatives), c.n_states))


@inlined
def get_event_indicators(c, indicators):  # type: ignore[no-untyped-def]
    return _vector(c.get_event_indicators, (c.handle, address_of(indicators), c.n_indicators))


@inlined
def enter_event_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.enter_event_mode, (c.handle,))


@inlined
def update_discrete_states(c, info, time, bits):  # type: ignore[no-untyped-def]
    """Called fmi2NewDiscreteStates in FMI 2.0. Fills `info` and `time`, which are its structure."""
    if c.version == 2:
        return _event(c.update_discrete_states, (c.handle, address_of(info)))
    at = address_of(bits)
    status = _event_3(
        c.update_discrete_states,
        (c.handle, at, at + 1, at + 2, at + 3, at + 4, address_of(time)),
    )
    for j in range(5):
        info[j] = bits[j]
    return status


@inlined
def enter_continuous_time_mode(c):  # type: ignore[no-untyped-def]
    return _handle_only(c.enter_continuous_time_mode, (c.handle,))


@inlined
def completed_integrator_step(c, flags, bits):  # type: ignore[no-untyped-def]
    """Fill `flags`: whether the FMU wants an event, and whether it ends the simulation."""
    if c.version == 2:
        at = address_of(flags)
        return _completed(c.completed_integrator_step, (c.handle, 1, at, at + 4))
    at = address_of(bits)
    status = _completed(c.completed_integrator_step, (c.handle, 1, at, at + 1))
    flags[0], flags[1] = bits[0], bits[1]
    return status


@inlined
def do_step(c, time, step, flags, bits, reached):  # type: ignore[no-untyped-def]
    """One communication step; flags[1] says whether the FMU ends the simulation with it."""
    flags[1] = 0
    if c.version == 2:
        return _step(c.do_step, (c.handle, time, step, 1))
    at = address_of(bits)
    status = _step_3(c.do_step, (c.handle, time, step, 1, at, at + 1, at + 2, address_of(reached)))
    flags[1] = bits[1]
    return status


@inlined
def set_real_input_derivatives(c, references, orders, slopes):  # type: ignore[no-untyped-def]
    return _slopes(
        c.set_real_input_derivatives,
        (c.handle, address_of(references), len(references), address_of(orders), address_of(slopes)),
    )


@inlined
def get_directional_derivative(c, unknowns, knowns, n_knowns, seed, result):  # type: ignore[no-untyped-def]
    """The derivative of the unknowns along `seed`, a direction in the first knowns.

    Unknowns and knowns are value references of float64 scalars.
    """
    n_unknowns, at, known = len(unknowns), address_of(unknowns), address_of(knowns)
    given, found = address_of(seed), address_of(result)
    if c.version == 2:
        return _directional(
            c.get_directional_derivative,
            (c.handle, at, n_unknowns, known, n_knowns, given, found),
        )
    return _directional_3(
        c.get_directional_derivative,
        (c.handle, at, n_unknowns, known, n_knowns, given, n_knowns, found, n_unknowns),
    )
