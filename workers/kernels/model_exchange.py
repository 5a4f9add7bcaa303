"""What the model exchange solvers share: they integrate, the FMU only answers for a derivative."""

from __future__ import annotations

from workers.kernels.calling import inlined
from workers.kernels.failure import EVENT, FINISHED, INITIALISATION, STEP, TERMINATED, failed
from workers.kernels.fmi2 import (
    DISCARD,
    completed_integrator_step,
    enter_continuous_time_mode,
    get_continuous_states,
    get_derivatives,
    get_real,
    new_discrete_states,
    set_continuous_states,
    set_real,
    set_time,
)
from workers.kernels.hooks import before, begin, first_inputs, inside, take_inputs
from workers.kernels.initialise import initialise

MAX_EVENT_ITERATIONS = 100


@inlined
def start(c, references, constants, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Initialise, iterate the initial event to its end, and fetch the states."""
    inputs = first_inputs(hooks, grid, work)
    status = initialise(c, references, constants, point, inputs, 0.0, grid.times[0])
    info = work.event_info
    info[0] = 1
    iterations = 0
    while status < DISCARD and info[0] != 0 and iterations < MAX_EVENT_ITERATIONS:
        status = new_discrete_states(c, info)
        iterations += 1
        if status < DISCARD and info[1] != 0:
            return TERMINATED
    if status < DISCARD and info[4] != 0:
        return EVENT
    if status < DISCARD:
        status = enter_continuous_time_mode(c)
    if status < DISCARD:
        status = get_continuous_states(c, work.states)
    begin(hooks, grid.times[0], work)
    return FINISHED if status < DISCARD else failed(INITIALISATION, status)


@inlined
def go_to(c, references, hooks, time, states, work):  # type: ignore[no-untyped-def]
    """Tell the FMU where it is; its inputs are in `work`. Returns the worst status."""
    status = set_time(c, time)
    if status < DISCARD:
        status = max(status, set_continuous_states(c, states))
    if hooks.before != 0:
        before(hooks, time, states, work)
        if status < DISCARD and len(work.edited) > 0:
            status = max(status, set_real(c, references.inputs, work.edited))
        if status < DISCARD and len(work.varied) > 0:
            status = max(status, set_real(c, hooks.parameters, work.varied))
    elif status < DISCARD and len(work.inputs) > 0:
        status = max(status, set_real(c, references.inputs, work.inputs))
    return status


@inlined
def slopes_here(c, hooks, time, states, work, result):  # type: ignore[no-untyped-def]
    """dx/dt where the FMU stands. Returns the status."""
    status = get_derivatives(c, result)
    inside(hooks, time, states, work, result)
    return status


@inlined
def derivative(c, references, hooks, grid, i, time, states, work, result):  # type: ignore[no-untyped-def]
    """dx/dt at a time in the interval after grid time i. Returns the worst status."""
    take_inputs(grid, i, time, work)
    status = go_to(c, references, hooks, time, states, work)
    if status >= DISCARD:
        return status
    return max(status, slopes_here(c, hooks, time, states, work, result))


@inlined
def record_outputs(c, references, hooks, grid, i, work, record):  # type: ignore[no-untyped-def]
    """The outputs at grid time i, to which the FMU is moved. Returns the worst status."""
    take_inputs(grid, i, grid.times[i], work)
    status = go_to(c, references, hooks, grid.times[i], work.states, work)
    return max(status, get_real(c, references.outputs, record)) if status < DISCARD else status


@inlined
def complete_step(c, work):  # type: ignore[no-untyped-def]
    """Tell the FMU that a step is accepted. Returns FINISHED, or why the simulation must end."""
    if not c.completes_steps:
        return FINISHED
    status = completed_integrator_step(c, work.flags)
    if status >= DISCARD:
        return failed(STEP, status)
    if work.flags[1] != 0:
        return TERMINATED
    return EVENT if work.flags[0] != 0 else FINISHED
