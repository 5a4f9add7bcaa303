"""Events in model exchange: found between two steps, located, and handed to the FMU.

A state event is where an event indicator goes from positive to not positive, or back (FMI 2.0.4,
section 3.1.1; FMI 3.0, section 3.1). It is located on the integrator's own interpolant, to within
what a CVODE root would be, and the simulation goes on from behind it.
"""

from __future__ import annotations

import numpy as np

from workers.kernels.fmi.compiling import inlined, subroutine
from workers.kernels.fmi.failure import CHATTERING, EVENT, FINISHED, TERMINATED, failed
from workers.kernels.fmi.functions import (
    NOMINALS_CHANGED,
    TERMINATE,
    UPDATE_NEEDED,
    VALUES_CHANGED,
    enter_continuous_time_mode,
    enter_event_mode,
    get_continuous_states,
    get_event_indicators,
    get_nominals_of_continuous_states,
    next_event_time,
    update_discrete_states,
)
from workers.kernels.fmi.hooks import interpolate_inputs, modify_inputs
from workers.kernels.fmi.values import DISCARD, get_first, set_values
from workers.kernels.model_exchange.evaluation import set_time_inputs_and_states

MAX_EVENT_ITERATIONS = 100
MAX_REPEATED_EVENTS = 1000
"""Events without any time between them, after which a simulation fails."""
EPSILON = float(np.finfo(np.float64).eps)
EVENT_TOLERANCE = 100.0 * EPSILON
"""Of an event's time, over that time: what CVODE's root finding uses."""


@inlined
def time_resolution(time, last):  # type: ignore[no-untyped-def]
    """Return the length of time below which two times are the same."""
    return 16.0 * EPSILON * max(abs(time), abs(last))


@inlined
def iterate_event(c, settings, work):  # type: ignore[no-untyped-def]
    """In event mode, let the FMU update its discrete states to the end, and leave the mode.

    Returns (status, code). Afterwards `work` has the states, their tolerances, and the time of the
    next event.
    """
    info = work.info
    info[UPDATE_NEEDED] = 1
    iterations, values_changed, nominals_changed, status = 0, False, False, 0
    while status < DISCARD and info[UPDATE_NEEDED] != 0:
        if iterations == MAX_EVENT_ITERATIONS:
            return status, CHATTERING
        status = max(status, update_discrete_states(c, info))
        iterations += 1
        if status < DISCARD and info[TERMINATE] != 0:
            return status, TERMINATED
        values_changed |= info[VALUES_CHANGED] != 0
        nominals_changed |= info[NOMINALS_CHANGED] != 0
    work.next_event[0] = next_event_time(info)
    if status < DISCARD:
        status = max(status, enter_continuous_time_mode(c))
    if status < DISCARD and values_changed:
        status = max(status, get_continuous_states(c, work.states))
    if status < DISCARD and nominals_changed:
        status = max(status, get_nominals_of_continuous_states(c, work.trial))
        for j in range(c.n_states):
            work.atols[j] = settings.atol * abs(work.trial[j])
    return status, FINISHED


@subroutine
def handle_event(  # type: ignore[no-untyped-def]
    c, references, settings, hooks, grid, interval_before, i, time, repeated_events, work
):
    """Handle an event: event mode, inputs, event iteration, continuous-time mode.

    Inputs are those after grid time `interval_before` until the event, and after grid time i from
    then on. `repeated_events` counts the events before this one between which no time has passed.
    Returns FINISHED, or the code of the failure.
    """
    if repeated_events > MAX_REPEATED_EVENTS:
        return CHATTERING
    status, code = (
        set_time_inputs_and_states(
            c, references, hooks, grid, interval_before, time, work.states, work
        ),
        FINISHED,
    )
    if status < DISCARD:
        status = max(status, enter_event_mode(c))
    if status < DISCARD and len(work.inputs) > 0:
        interpolate_inputs(grid, i, time, work)
        if hooks.modify_inputs != 0:
            modify_inputs(hooks, time, work.states, work)
            status = max(
                status, set_values(c, references.inputs, work.effective_inputs, work.buffer)
            )
        else:
            status = max(status, set_values(c, references.inputs, work.inputs, work.buffer))
    if status < DISCARD:
        status, code = iterate_event(c, settings, work)
    if code != FINISHED:
        return code
    if status < DISCARD:
        status = max(
            status,
            set_time_inputs_and_states(c, references, hooks, grid, i, time, work.states, work),
        )
    if status < DISCARD:
        status = max(status, store_event_indicators(c, references, work))
    return FINISHED if status < DISCARD else failed(EVENT, status)


@inlined
def store_event_indicators(c, references, work):  # type: ignore[no-untyped-def]
    """Store the present event indicators."""
    return _indicators_now(c, references, work, 0) if c.n_indicators > 0 else 0


@inlined
def _indicators_now(c, references, work, row):  # type: ignore[no-untyped-def]
    """Get the event indicators of what the FMU is set to, into a row of `work.indicators`.

    Some FMUs compute nothing while they are set, nor when they are asked for indicators, which are
    then those of an earlier time (some of OpenModelica's without states). All do when a variable is
    got, so an output is got first.
    """
    status = get_first(c, references.outputs, work.buffer)
    return (
        max(status, get_event_indicators(c, work.indicators[row])) if status < DISCARD else status
    )


@inlined
def _sign_changed(work):  # type: ignore[no-untyped-def]
    """Return whether an indicator has changed its sign since the last step."""
    crossed = False
    for j in range(len(work.indicators[0])):
        crossed |= (work.indicators[0][j] > 0.0) != (work.indicators[2][j] > 0.0)
    return crossed


@inlined
def find_event(  # type: ignore[no-untyped-def]
    c, references, hooks, grid, i, time, step, interpolate, coefficients, work
):
    """Look for a state event in a step that ends at `work.trial`, which the FMU is set to.

    Parameters
    ----------
    interpolate
        ``interpolate(time, step, part, source, work)`` puts the states at a part of the step into
        `work.trial`.

    Returns
    -------
    (status, part)
        Which part of the step is left of the event: at most 1 if there is one, else 2. If there is
        one, `work.trial` is the state just after it, which the FMU is set to.
    """
    status = _indicators_now(c, references, work, 2)
    if status >= DISCARD or not _sign_changed(work):
        if status < DISCARD:
            for j in range(len(work.indicators[0])):
                work.indicators[0][j] = work.indicators[2][j]
        return status, 2.0
    for j in range(len(work.indicators[0])):
        work.indicators[1][j] = work.indicators[2][j]
    low, high, side, tries = 0.0, 1.0, 0, 0
    width = min(0.5, EVENT_TOLERANCE * (abs(time) + step) / step)
    while high - low > width:
        tries += 1
        guess = 0.5 if tries % 3 == 0 else _first_zero(work)
        part = low + min(max(guess * (high - low), 0.5 * width), high - low - 0.5 * width)
        interpolate(time, step, part, coefficients, work)
        status = max(
            status, _evaluate_indicators(c, references, hooks, grid, i, time + part * step, work)
        )
        if status >= DISCARD:
            return status, part
        if _sign_changed(work):
            high, side = part, max(side, 0) + 1
            _move_bracket_end(work.indicators[1], work.indicators[2], work.indicators[0], side)
        else:
            low, side = part, min(side, 0) - 1
            _move_bracket_end(work.indicators[0], work.indicators[2], work.indicators[1], -side)
    if high < 1.0:
        interpolate(time, step, high, coefficients, work)
    return max(
        status, _evaluate_indicators(c, references, hooks, grid, i, time + high * step, work)
    ), high


@inlined
def _first_zero(work):  # type: ignore[no-untyped-def]
    """Return the first zero of the indicators, interpolated linearly, as a part of the bracket."""
    first = 1.0
    for j in range(len(work.indicators[0])):
        one, other = work.indicators[0][j], work.indicators[1][j]
        if (one > 0.0) != (other > 0.0):
            first = min(first, abs(one) / (abs(one) + abs(other)))
    return first


@inlined
def _move_bracket_end(moved_end, indicators, other_end, times):  # type: ignore[no-untyped-def]
    """Move one end of the bracket; `times` counts the moves of this end in a row.

    From the second one on the values at the other end are halved, so that it moves soon (the
    Illinois rule; M. Dowell, P. Jarratt, BIT 11 (1971) 168-174, doi:10.1007/BF01934364).
    """
    for j in range(len(indicators)):
        moved_end[j] = indicators[j]
        if times > 1:
            other_end[j] *= 0.5


@subroutine
def dense_output(_time, step, part, coefficients, work):  # type: ignore[no-untyped-def]
    """Interpolate the states within a step of a Runge-Kutta method from `work.states`.

    `coefficients` has a row for each stage: its weight as a polynomial, from the first power on.
    """
    for j in range(len(work.states)):
        total = 0.0
        for stage in range(len(coefficients)):
            weight = 0.0
            for power in range(coefficients.shape[1] - 1, -1, -1):
                weight = (weight + coefficients[stage, power]) * part
            total += weight * work.stages[stage, j]
        work.trial[j] = work.states[j] + step * total


@inlined
def _evaluate_indicators(c, references, hooks, grid, i, time, work):  # type: ignore[no-untyped-def]
    """Set the states in `work.trial` and get the event indicators. Returns the worst status."""
    status = set_time_inputs_and_states(c, references, hooks, grid, i, time, work.trial, work)
    return max(status, _indicators_now(c, references, work, 2)) if status < DISCARD else status
