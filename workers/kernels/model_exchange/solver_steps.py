"""Start of a simulation, jumps of inputs and accepted steps, for all model exchange solvers."""

from __future__ import annotations

from workers.kernels.fmi.compiling import inlined
from workers.kernels.fmi.failure import EVENT, FINISHED, INITIALISATION, STEP, TERMINATED, failed
from workers.kernels.fmi.functions import (
    EVENT_NEEDED,
    SIMULATION_ENDED,
    completed_integrator_step,
    get_continuous_states,
)
from workers.kernels.fmi.hooks import initial_inputs, start_effect_states
from workers.kernels.fmi.initialise import initialise
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.events import (
    handle_event,
    iterate_event,
    store_event_indicators,
)


@inlined
def start_simulation(c, references, starts, settings, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Initialise, iterate the initial event to its end, and fetch the states."""
    initial_inputs(hooks, grid, work)
    for j in range(len(work.atols)):
        work.atols[j] = settings.atols[j]
    status = initialise(
        c, references, starts, point, work.effective_inputs, 0.0, grid.times[0], work
    )
    if status < DISCARD:
        status, code = iterate_event(c, settings, work)
        if code != FINISHED:
            return code
    if status < DISCARD and c.n_states > 0:
        status = max(status, get_continuous_states(c, work.states))
    start_effect_states(hooks, grid.times[0], work)
    if status < DISCARD:
        status = max(status, store_event_indicators(c, references, work))
    return FINISHED if status < DISCARD else failed(INITIALISATION, status)


@inlined
def handle_input_jump(c, references, settings, hooks, grid, i, time, work):  # type: ignore[no-untyped-def]
    """Handle inputs that jump at grid time i, which is an event for some FMUs."""
    if i > 0 and c.eventful and grid.jumps[i]:
        return handle_event(c, references, settings, hooks, grid, i - 1, i, time, 0, work)
    return FINISHED


@inlined
def complete_step(c, work):  # type: ignore[no-untyped-def]
    """Tell the FMU that a step is accepted. Returns FINISHED, EVENT, or why it must end."""
    if not c.completes_steps:
        return FINISHED
    status = completed_integrator_step(c, work.info)
    if status >= DISCARD:
        return failed(STEP, status)
    if work.info[SIMULATION_ENDED] != 0:
        return TERMINATED
    return EVENT if work.info[EVENT_NEEDED] != 0 else FINISHED
