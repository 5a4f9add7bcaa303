"""Co-simulation: the FMU integrates itself from one communication point to the next."""

from __future__ import annotations

from workers.kernels.fmi.calling import is_fmi_2
from workers.kernels.fmi.compiling import inlined, kernel, subroutine
from workers.kernels.fmi.early_end import begin_squares, is_above_bound
from workers.kernels.fmi.failure import (
    ENDED_EARLY,
    FINISHED,
    INITIALISATION,
    OUTPUT,
    TERMINATED,
    TOO_MANY_STEPS,
    failed,
    failed_step,
)
from workers.kernels.fmi.functions import (
    SIMULATION_ENDED,
    do_step,
    has_terminated,
    last_successful_time,
    set_real_input_derivatives,
)
from workers.kernels.fmi.hooks import (
    add_derivatives,
    initial_inputs,
    interpolate_inputs,
    modify_inputs,
    select_point,
    start_effect_states,
)
from workers.kernels.fmi.initialise import initialise, n_steps
from workers.kernels.fmi.own_states import substep_count
from workers.kernels.fmi.progress import note_call, note_steps
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD, get_values, set_reals, set_values
from workers.messages.types import STEPS


@kernel
def co_simulate_batch(  # type: ignore[no-untyped-def]
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
    """Simulate one experiment for many points.

    Parameters
    ----------
    hooks
        Effects, see `workers.kernels.fmi.hooks`.
    points : (p, k)
        Start values of the reals, a row a point.
    bounds : (p,)
        Sums of squares above which a simulation ends early; infinite for none.
    outputs : (p, n, y)
        Filled with the outputs at each time of the grid.
    codes, stopped_at : (p,)
        Filled with 0, or what went wrong (see `workers.kernels.fmi.failure`), and the time of it.
    steps : (p,)
        Filled with the number of steps, where a simulation reaches its end.

    Returns
    -------
    int
        How many points were tried: all, or those up to the first that failed, so that the caller
        can ask the FMU what it has to say about it.
    """
    c, references, starts, settings, hooks, grid, work = by_reference(
        (c, references, starts, settings, hooks, grid, work)
    )
    for p in range(len(points)):
        select_point(hooks, p, work)
        begin_squares(bounds, p, work)
        codes[p], stopped_at[p] = _co_simulate(
            c, references, starts, settings, hooks, grid, points[p], work, outputs[p]
        )
        steps[p] = work.progress[STEPS]
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@subroutine
def _co_simulate(c, references, starts, settings, hooks, grid, point, work, outputs):  # type: ignore[no-untyped-def]
    times = grid.times
    tolerance = settings.fmu_tolerance
    work.info[SIMULATION_ENDED] = 0
    initial_inputs(hooks, grid, work)
    status = initialise(
        c, references, starts, point, work.effective_inputs, tolerance, times[0], work
    )
    if status >= DISCARD:
        return failed(INITIALISATION, status), times[0]
    if hooks.modify_inputs != 0:
        start_effect_states(hooks, times[0], work)
        return _step_through_grid_with_effects(c, references, settings, hooks, grid, work, outputs)
    return _step_through_grid(c, references, settings, grid, work, outputs)


@subroutine
def _step_through_grid(c, references, settings, grid, work, outputs):  # type: ignore[no-untyped-def]
    """Step from the first time of the grid to the last. Returns (code, time)."""
    times, steps_in_all = grid.times, 0
    for i in range(len(times)):
        status = 0
        if grid.inputs.shape[1] > 0:
            status = set_values(c, references.inputs, grid.inputs[i], work.buffer)
        if status < DISCARD:
            status = get_values(c, references.outputs, outputs[i], work.buffer)
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if is_above_bound(grid, i, outputs[i], work):
            return ENDED_EARLY, times[i]
        if i + 1 == len(times):
            break
        steps = n_steps(grid.intervals[i], settings.step, settings.max_steps)
        if steps > settings.max_steps:
            return TOO_MANY_STEPS, times[i]
        steps_in_all += steps
        status = _advance_to_next_time(c, references, settings, grid, i, steps, work)
        if status >= DISCARD:
            return failed_step(status), times[i]
        if has_terminated(c, work.info):
            return TERMINATED, _termination_time(c, times[i], work)
    note_steps(work, steps_in_all)
    return FINISHED, times[-1]


@subroutine
def _step_through_grid_with_effects(c, references, settings, hooks, grid, work, outputs):  # type: ignore[no-untyped-def]
    """Do the same where effects change inputs or parameters; apart, to keep the other one fast."""
    times, steps_in_all = grid.times, 0
    for i in range(len(times)):
        status = _set_effective_inputs(c, references, hooks, grid, i, times[i], work)
        if status < DISCARD:
            status = get_values(c, references.outputs, outputs[i], work.buffer)
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if is_above_bound(grid, i, outputs[i], work):
            return ENDED_EARLY, times[i]
        if i + 1 == len(times):
            break
        steps = n_steps(grid.intervals[i], settings.step, settings.max_steps)
        if steps > settings.max_steps:
            return TOO_MANY_STEPS, times[i]
        steps_in_all += steps
        status = _advance_to_next_time_with_effects(
            c, references, settings, hooks, grid, i, steps, work
        )
        if status >= DISCARD:
            return failed_step(status), times[i]
        if has_terminated(c, work.info):
            return TERMINATED, _termination_time(c, times[i], work)
    note_steps(work, steps_in_all)
    return FINISHED, times[-1]


@inlined
def _termination_time(c, time, work):  # type: ignore[no-untyped-def]
    """Return the time of the FMU's termination as far as it gives one, at least `time`."""
    return time if is_fmi_2(c) else max(time, last_successful_time(work.info))


@inlined
def _advance_to_next_time(c, references, settings, grid, i, steps, work):  # type: ignore[no-untyped-def]
    """Step from one time of the grid to the next, in equal communication steps.

    An FMU that interpolates its inputs is told their slopes. Any other holds each at what it is at
    the start of a step: where that is too coarse, `Solver.step` shortens the steps.
    """
    step = settings.fixed or grid.intervals[i] / steps
    status = 0
    for s in range(steps):
        if has_terminated(c, work.info):
            break
        if s > 0 and status < DISCARD and len(work.inputs) > 0:
            interpolate_inputs(grid, i, grid.times[i] + s * step, work)
            status = max(status, set_values(c, references.inputs, work.inputs, work.buffer))
        if (
            c.interpolates_inputs
            and len(references.continuous_inputs.reals) > 0
            and status < DISCARD
        ):
            status = set_real_input_derivatives(
                c, references.inputs.reals, work.derivative_orders, grid.slopes[i]
            )
        note_call(work)
        if status < DISCARD:
            status = do_step(c, _communication_point(grid, i, s, steps, step), step, work.info)
    return status


@inlined
def _communication_point(grid, i, s, steps, step):  # type: ignore[no-untyped-def]
    """Return the begin of step s; the last of several ends at the next time itself."""
    if 0 < s == steps - 1:
        return grid.times[i + 1] - step
    return grid.times[i] + s * step


@subroutine
def _advance_to_next_time_with_effects(c, references, settings, hooks, grid, i, steps, work):  # type: ignore[no-untyped-def]
    """Do the same where effects change inputs or parameters, which are linear within a step."""
    step = settings.fixed or grid.intervals[i] / steps
    status = 0
    for s in range(steps):
        time = grid.times[i] + s * step
        if has_terminated(c, work.info):
            break
        if s > 0 and status < DISCARD:
            status = _set_effective_inputs(c, references, hooks, grid, i, time, work)
        _input_slopes_with_effects(hooks, grid, i, time, step, work)
        if (
            c.interpolates_inputs
            and len(references.continuous_inputs.reals) > 0
            and status < DISCARD
        ):
            status = set_real_input_derivatives(
                c, references.inputs.reals, work.derivative_orders, work.input_slopes
            )
        note_call(work)
        if status < DISCARD:
            status = do_step(c, _communication_point(grid, i, s, steps, step), step, work.info)
    return status


@subroutine
def _set_effective_inputs(c, references, hooks, grid, i, time, work):  # type: ignore[no-untyped-def]
    """Set the inputs and parameters with their effects. Returns the worst status."""
    interpolate_inputs(grid, i, time, work)
    modify_inputs(hooks, time, work.states, work)
    status = 0
    if len(work.effective_inputs) > 0:
        status = set_values(c, references.inputs, work.effective_inputs, work.buffer)
    if status < DISCARD and len(work.effective_parameters) > 0:
        status = max(status, set_reals(c, hooks.parameters, work.effective_parameters))
    return status


@inlined
def _input_slopes_with_effects(hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """Compute the slopes of the effective inputs, and advance the effects' states by the step."""
    for j in range(len(work.input_slopes)):
        work.input_slopes[j] = -work.effective_inputs[j] / step
    if hooks.add_derivatives != 0:
        substeps = substep_count(step, work.fastest_rate[0])
        substep = step / substeps
        for n in range(substeps):
            _advance_effect_states(hooks, grid, i, time + n * substep, substep, work)
    interpolate_inputs(grid, i, time + step, work)
    modify_inputs(hooks, time + step, work.states, work)
    for j in range(len(work.input_slopes)):
        work.input_slopes[j] += work.effective_inputs[j] / step


@inlined
def _advance_effect_states(hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """Take one classic Runge-Kutta step of the effects' own states."""
    x, trial, k = work.states, work.trial, work.stages
    for stage in range(4):
        offset = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
        for j in range(len(x)):
            trial[j] = x[j] + offset * k[max(stage - 1, 0), j] if stage > 0 else x[j]
        interpolate_inputs(grid, i, time + offset, work)
        add_derivatives(hooks, time + offset, trial, work, k[stage])
    for j in range(len(x)):
        x[j] += step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
