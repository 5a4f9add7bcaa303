"""Events in model exchange: found between two steps, located, and handed to the FMU.

A state event is where an event indicator goes from positive to not positive, or back (FMI 2.0.4,
section 3.1.1; FMI 3.0, section 3.1). It is located on the integrator's own interpolant, to within
what a CVODE root would be, and the simulation goes on from behind it.
"""

from __future__ import annotations

import numpy as np

from workers.kernels.fmi.calling import inlined, kernel
from workers.kernels.fmi.failure import CHATTERING, EVENT, FINISHED, TERMINATED, failed
from workers.kernels.fmi.functions import (
    AGAIN,
    ENDS,
    NOMINALS,
    VALUES,
    enter_continuous_time_mode,
    enter_event_mode,
    get_continuous_states,
    get_event_indicators,
    get_nominals_of_continuous_states,
    next_event_time,
    update_discrete_states,
)
from workers.kernels.fmi.hooks import before, take_inputs
from workers.kernels.fmi.values import DISCARD, set_values
from workers.kernels.model_exchange.moving import stand

MAX_EVENT_ITERATIONS = 100
MOST_AT_ONCE = 1000
"""Events one after the other without any time between them, after which there is no progress."""
EPSILON = float(np.finfo(np.float64).eps)
WIDTH = 100.0 * EPSILON
"""How closely an event is located, of the time: what CVODE's root finding does."""


@inlined
def shortest(time, last):  # type: ignore[no-untyped-def]
    """What counts as no time at all between two times."""
    return 16.0 * EPSILON * max(abs(time), abs(last))


@inlined
def iterate_event(c, settings, work):  # type: ignore[no-untyped-def]
    """In event mode, let the FMU update its discrete states to the end, and leave the mode.

    Returns (status, code). Afterwards `work` has the states, their tolerances, and the time of the
    next event.
    """
    info = work.info
    info[AGAIN] = 1
    iterations, changed, nominals, status = 0, False, False, 0
    while status < DISCARD and info[AGAIN] != 0:
        if iterations == MAX_EVENT_ITERATIONS:
            return status, CHATTERING
        status = max(status, update_discrete_states(c, info))
        iterations += 1
        if status < DISCARD and info[ENDS] != 0:
            return status, TERMINATED
        changed |= info[VALUES] != 0
        nominals |= info[NOMINALS] != 0
    work.next_event[0] = next_event_time(info)
    if status < DISCARD:
        status = max(status, enter_continuous_time_mode(c))
    if status < DISCARD and changed:
        status = max(status, get_continuous_states(c, work.states))
    if status < DISCARD and nominals:
        status = max(status, get_nominals_of_continuous_states(c, work.trial))
        for j in range(c.n_states):
            work.atols[j] = settings.atol * abs(work.trial[j])
    return status, FINISHED


@kernel
def handle_event(  # type: ignore[no-untyped-def]
    c, references, settings, hooks, grid, before_it, i, time, still, work
):
    """At a time: to event mode, inputs, event iteration, and back.

    Inputs are those after grid time `before_it` until the event, and after grid time i from then
    on. `still` counts the events before this one between which no time has passed. Returns
    FINISHED, or why the simulation must end.
    """
    if still > MOST_AT_ONCE:
        return CHATTERING
    status, code = stand(c, references, hooks, grid, before_it, time, work.states, work), FINISHED
    if status < DISCARD:
        status = max(status, enter_event_mode(c))
    if status < DISCARD and len(work.inputs) > 0:
        take_inputs(grid, i, time, work)
        if hooks.before != 0:
            before(hooks, time, work.states, work)
            status = max(status, set_values(c, references.inputs, work.edited, work.cell))
        else:
            status = max(status, set_values(c, references.inputs, work.inputs, work.cell))
    if status < DISCARD:
        status, code = iterate_event(c, settings, work)
    if code != FINISHED:
        return code
    if status < DISCARD:
        status = max(status, stand(c, references, hooks, grid, i, time, work.states, work))
    if status < DISCARD:
        status = max(status, note_signs(c, work))
    return FINISHED if status < DISCARD else failed(EVENT, status)


@inlined
def note_signs(c, work):  # type: ignore[no-untyped-def]
    """Remember the event indicators where the FMU stands."""
    return get_event_indicators(c, work.indicators[0]) if c.n_indicators > 0 else 0


@inlined
def _crossed(work):  # type: ignore[no-untyped-def]
    """Whether an indicator has another sign than after the last step."""
    crossed = False
    for j in range(len(work.indicators[0])):
        crossed |= (work.indicators[0][j] > 0.0) != (work.indicators[2][j] > 0.0)
    return crossed


@inlined
def find_event(  # type: ignore[no-untyped-def]
    c, references, hooks, grid, i, time, step, interpolate, source, work
):
    """Look for a state event in a step that ends at `work.trial`, where the FMU stands.

    Parameters
    ----------
    interpolate
        ``interpolate(time, step, part, source, work)`` puts the states at a part of the step into
        `work.trial`.

    Returns
    -------
    (status, part)
        Which part of the step is left of the event: at most 1 if there is one, else 2. If there is
        one, `work.trial` is the state just behind it, and the FMU stands there.
    """
    status = get_event_indicators(c, work.indicators[2])
    if status >= DISCARD or not _crossed(work):
        if status < DISCARD:
            for j in range(len(work.indicators[0])):
                work.indicators[0][j] = work.indicators[2][j]
        return status, 2.0
    for j in range(len(work.indicators[0])):
        work.indicators[1][j] = work.indicators[2][j]
    low, high, side, tries = 0.0, 1.0, 0, 0
    width = min(0.5, WIDTH * (abs(time) + step) / step)
    while high - low > width:
        tries += 1
        guess = 0.5 if tries % 3 == 0 else _first_zero(work)
        part = low + min(max(guess * (high - low), 0.5 * width), high - low - 0.5 * width)
        interpolate(time, step, part, source, work)
        status = max(status, _look(c, references, hooks, grid, i, time + part * step, work))
        if status >= DISCARD:
            return status, part
        if _crossed(work):
            high, side = part, max(side, 0) + 1
            _take(work.indicators[1], work.indicators[2], work.indicators[0], side)
        else:
            low, side = part, min(side, 0) - 1
            _take(work.indicators[0], work.indicators[2], work.indicators[1], -side)
    if high < 1.0:
        interpolate(time, step, high, source, work)
    return max(status, _look(c, references, hooks, grid, i, time + high * step, work)), high


@inlined
def _first_zero(work):  # type: ignore[no-untyped-def]
    """Where the first indicator would be zero if all were straight lines, from 0 to 1."""
    first = 1.0
    for j in range(len(work.indicators[0])):
        one, other = work.indicators[0][j], work.indicators[1][j]
        if (one > 0.0) != (other > 0.0):
            first = min(first, abs(one) / (abs(one) + abs(other)))
    return first


@inlined
def _take(moved, found, kept, times):  # type: ignore[no-untyped-def]
    """One end of the bracket has moved, for so many times in a row.

    From the second time on the end that is kept counts half, so that it moves soon (the Illinois
    rule; M. Dowell, P. Jarratt, BIT 11 (1971) 168-174, doi:10.1007/BF01934364).
    """
    for j in range(len(found)):
        moved[j] = found[j]
        if times > 1:
            kept[j] *= 0.5


@kernel
def polynomial(time, step, part, dense, work):  # type: ignore[no-untyped-def]
    """The states within a step of a Runge-Kutta method, which began at `work.states`.

    `dense` has a row for each stage: the polynomial of its slope, from the first power on.
    """
    for j in range(len(work.states)):
        total = 0.0
        for stage in range(len(dense)):
            weight = 0.0
            for power in range(dense.shape[1] - 1, -1, -1):
                weight = (weight + dense[stage, power]) * part
            total += weight * work.stages[stage, j]
        work.trial[j] = work.states[j] + step * total


@inlined
def _look(c, references, hooks, grid, i, time, work):  # type: ignore[no-untyped-def]
    """Move the FMU to `work.trial` and ask for the indicators. Returns the worst status."""
    status = stand(c, references, hooks, grid, i, time, work.trial, work)
    return max(status, get_event_indicators(c, work.indicators[2])) if status < DISCARD else status
