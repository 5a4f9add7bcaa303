"""The classic Runge-Kutta method of order 4 with a fixed step.

The cheapest choice for smooth, non-stiff models whose inputs are sampled more finely than their
dynamics. It never checks its own error: compare once with half the step.

Reference: W. Kutta, Zeitschrift fuer Mathematik und Physik 46 (1901) 435-453.
"""

from __future__ import annotations

import numpy as np

from workers.kernels.fmi.compiling import inlined, kernel, subroutine
from workers.kernels.fmi.early_end import begin_squares, is_above_bound
from workers.kernels.fmi.failure import (
    ENDED_EARLY,
    EVENT,
    FINISHED,
    HAS_EVENTS,
    OUTPUT,
    SENSITIVITIES,
    STEP,
    TOO_MANY_STEPS,
    failed,
)
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.initialise import n_steps
from workers.kernels.fmi.progress import note_steps
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.evaluation import (
    current_derivatives,
    derivatives_at,
    record_outputs,
    set_time_and_states,
)
from workers.kernels.model_exchange.events import (
    dense_output,
    find_event,
    handle_event,
    time_resolution,
)
from workers.kernels.model_exchange.forward_sensitivities import advance_sensitivities
from workers.kernels.model_exchange.solver_steps import (
    complete_step,
    handle_input_jump,
    start_simulation,
)
from workers.messages.types import STEPS

INTERPOLANT = np.array(
    [[1.0, -3 / 2, 2 / 3], [0.0, 1.0, -2 / 3], [0.0, 1.0, -2 / 3], [0.0, -1 / 2, 2 / 3]]
)
"""Of order 3 within a step, see `dense_output` in `workers.kernels.model_exchange.events`. Source:
E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section II.6."""


@kernel
def rk4_batch(  # type: ignore[no-untyped-def]
    c,
    references,
    starts,
    settings,
    hooks,
    grid,
    points,
    bounds,
    work,
    outputs,
    codes,
    stopped_at,
    steps,
):
    """Simulate one experiment for many points; arguments as in `co_simulate_batch`."""
    c, references, starts, settings, hooks, grid, work = by_reference(
        (c, references, starts, settings, hooks, grid, work)
    )
    for p in range(len(points)):
        select_point(hooks, p, work)
        begin_squares(bounds, p, work)
        codes[p], stopped_at[p] = _simulate(
            c, references, starts, settings, hooks, grid, points[p], work, outputs[p]
        )
        steps[p] = work.progress[STEPS]
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@subroutine
def _simulate(c, references, starts, settings, hooks, grid, point, work, outputs):  # type: ignore[no-untyped-def]
    times, steps = grid.times, 0
    time = times[0]
    code = start_simulation(c, references, starts, settings, hooks, grid, point, work)
    for i in range(len(times)):
        if code == FINISHED:
            code = handle_input_jump(c, references, settings, hooks, grid, i, time, work)
        if code != FINISHED:
            return code, time
        status = record_outputs(c, references, hooks, grid, i, time, work, outputs[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        if is_above_bound(grid, i, outputs[i], work):
            return ENDED_EARLY, time
        if i + 1 < len(times):
            code, time, steps_left = equal_steps(
                c, references, settings, hooks, grid, i, time, settings.max_steps, work
            )
            steps += settings.max_steps - steps_left
    note_steps(work, steps)
    return code, time


@inlined
def equal_steps(  # type: ignore[no-untyped-def]
    c, references, settings, hooks, grid, i, time, steps_left, work, forward=None
):
    """Step to grid time i + 1, in equal steps from event to event.

    Returns (code, time, steps left). With `forward`, sensitivities are integrated too, up to the
    first event.
    """
    last, at_grid, repeated_events = grid.times[i + 1], True, 0
    resolution = time_resolution(time, last)
    while True:
        begin = time
        end = min(last, work.next_event[0])
        if (
            abs(work.next_event[0] - last) <= resolution
        ):  # not once before the grid time and once after
            end = work.next_event[0]
        steps = n_steps(end - begin, settings.step, steps_left) if end > begin else 0
        if steps > steps_left:
            return TOO_MANY_STEPS, begin, steps_left
        steps_left -= steps
        step = (end - begin) / max(steps, 1)
        code = FINISHED
        for s in range(steps):
            code, time = _step_to_event(
                c, references, hooks, grid, i, begin + s * step, step, not at_grid, work, forward
            )
            at_grid = False
            if code != FINISHED:
                break
        if code == FINISHED and steps > 0:
            time = end
        if code == EVENT or (code == FINISHED and time >= work.next_event[0]):
            if forward is not None:
                return HAS_EVENTS, time, steps_left
            repeated_events = repeated_events + 1 if time - begin <= resolution else 0
            code = handle_event(
                c, references, settings, hooks, grid, i, i, time, repeated_events, work
            )
            at_grid = True
        if code != FINISHED or last - time <= resolution:
            return code, time, steps_left


@inlined
def _step_to_event(c, references, hooks, grid, i, time, step, set_first, work, forward):  # type: ignore[no-untyped-def]
    """Take one step, or its part up to an event. Returns (code, time), EVENT if there is one."""
    status = _evaluate_step(c, references, hooks, grid, i, time, step, set_first, work)
    fraction, has_event = 1.0, False
    if c.n_indicators > 0 and status < DISCARD:
        event_status, fraction = find_event(
            c, references, hooks, grid, i, time, step, dense_output, INTERPOLANT, work
        )
        status, has_event = max(status, event_status), fraction <= 1.0
        fraction = min(fraction, 1.0)
    if status >= DISCARD:
        return failed(STEP, status), time
    if forward is not None:
        status = advance_sensitivities(c, references, hooks, grid, i, time, step, work, forward)
        if status >= DISCARD:
            return failed(SENSITIVITIES, status), time
    for j in range(len(work.states)):
        work.states[j] = work.trial[j]
    code = complete_step(c, work)
    if code == FINISHED and has_event:
        code = EVENT
    return code, time + fraction * step


@inlined
def _evaluate_step(c, references, hooks, grid, i, time, step, set_first, work):  # type: ignore[no-untyped-def]
    """Compute a step into `trial`; if not `set_first`, the FMU is set to `time` already."""
    x, trial, k = work.states, work.trial, work.stages
    if set_first:
        status = derivatives_at(c, references, hooks, grid, i, time, x, work, k[0])
    else:
        status = current_derivatives(c, hooks, time, x, work, k[0])
    for stage in range(1, 4):
        offset = step if stage == 3 else 0.5 * step
        for j in range(len(x)):
            trial[j] = x[j] + offset * k[stage - 1, j]
        if status < DISCARD:
            status = derivatives_at(
                c, references, hooks, grid, i, time + offset, trial, work, k[stage]
            )
    for j in range(len(x)):
        trial[j] = x[j] + step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
    if (c.completes_steps or c.n_indicators > 0) and status < DISCARD:
        status = max(status, set_time_and_states(c, references, hooks, time + step, trial, work))
    return status
