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
from workers.kernels.initialise import initialise

MAX_EVENT_ITERATIONS = 100


@inlined
def start(c, references, constants, grid, point, work):  # type: ignore[no-untyped-def]
    """Initialise, iterate the initial event to its end, and fetch the states."""
    status = initialise(c, references, constants, point, grid.inputs[0], 0.0, grid.times[0])
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
    return FINISHED if status < DISCARD else failed(INITIALISATION, status)


@inlined
def go_to(c, references, time, states, inputs):  # type: ignore[no-untyped-def]
    """Tell the FMU where it is. Returns the worst status."""
    status = set_time(c, time)
    if status < DISCARD:
        status = max(status, set_continuous_states(c, states))
    if status < DISCARD and len(inputs) > 0:
        status = max(status, set_real(c, references.inputs, inputs))
    return status


@inlined
def derivative(c, references, grid, i, time, states, work, result):  # type: ignore[no-untyped-def]
    """dx/dt at a time in the interval after grid time i. Returns the worst status."""
    for j in range(len(work.inputs)):
        work.inputs[j] = grid.inputs[i, j] + (time - grid.times[i]) * grid.slopes[i, j]
    status = go_to(c, references, time, states, work.inputs)
    return max(status, get_derivatives(c, result)) if status < DISCARD else status


@inlined
def record_outputs(c, references, grid, i, states, record):  # type: ignore[no-untyped-def]
    """The outputs at grid time i, to which the FMU is moved. Returns the worst status."""
    status = go_to(c, references, grid.times[i], states, grid.inputs[i])
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
