"""Co-simulation: the FMU integrates itself from one communication point to the next."""

from __future__ import annotations

from workers.kernels.fmi.calling import inlined, is_fmi_2, kernel
from workers.kernels.fmi.failure import (
    FINISHED,
    INITIALISATION,
    OUTPUT,
    TERMINATED,
    TOO_MANY_STEPS,
    failed,
    failed_step,
)
from workers.kernels.fmi.functions import (
    ENDED,
    do_step,
    has_ended,
    reached,
    set_real_input_derivatives,
)
from workers.kernels.fmi.hooks import before, begin, first_inputs, inside, take_inputs, take_point
from workers.kernels.fmi.initialise import initialise, n_steps
from workers.kernels.fmi.progress import count_call
from workers.kernels.fmi.values import DISCARD, get_values, set_reals, set_values


@kernel
def co_simulate_batch(  # type: ignore[no-untyped-def]
    c, references, starts, settings, hooks, grid, points, work, outputs, codes, stopped_at
):
    """Simulate one experiment for many points.

    Parameters
    ----------
    hooks
        Effects, see `workers.kernels.fmi.hooks`.
    points : (p, k)
        Start values of the reals, a row a point.
    outputs : (p, n, y)
        Filled with the outputs at each time of the grid.
    codes, stopped_at : (p,)
        Filled with 0, or what went wrong (see `workers.kernels.fmi.failure`), and the time of it.

    Returns
    -------
    int
        How many points were tried: all, or those up to the first that failed, so that the caller
        can ask the FMU what it has to say about it.
    """
    for p in range(len(points)):
        take_point(hooks, p, work)
        codes[p], stopped_at[p] = _co_simulate(
            c, references, starts, settings, hooks, grid, points[p], work, outputs[p]
        )
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@kernel
def _co_simulate(c, references, starts, settings, hooks, grid, point, work, record):  # type: ignore[no-untyped-def]
    times = grid.times
    tolerance = settings.fmu_tolerance
    work.info[ENDED] = 0
    first_inputs(hooks, grid, work)
    status = initialise(c, references, starts, point, work.edited, tolerance, times[0], work)
    if status >= DISCARD:
        return failed(INITIALISATION, status), times[0]
    if hooks.before != 0:
        begin(hooks, times[0], work)
        return _go_with_effects(c, references, settings, hooks, grid, work, record)
    return _go(c, references, settings, grid, work, record)


@kernel
def _go(c, references, settings, grid, work, record):  # type: ignore[no-untyped-def]
    """From the first time of the grid to the last. Returns (code, time)."""
    times, steps_left = grid.times, settings.max_steps
    for i in range(len(times)):
        status = 0
        if grid.inputs.shape[1] > 0:
            status = set_values(c, references.inputs, grid.inputs[i], work.cell)
        if status < DISCARD:
            status = get_values(c, references.outputs, record[i], work.cell)
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        steps = n_steps(times[i + 1] - times[i], settings.step, steps_left)
        if steps > steps_left:
            return TOO_MANY_STEPS, times[i]
        steps_left -= steps
        status = _advance(c, references, settings, grid, i, steps, work)
        if status >= DISCARD:
            return failed_step(status), times[i]
        if has_ended(c, work.info):
            return TERMINATED, _ended_at(c, times[i], work)
    return FINISHED, times[-1]


@kernel
def _go_with_effects(c, references, settings, hooks, grid, work, record):  # type: ignore[no-untyped-def]
    """The same where effects edit inputs or parameters; apart, so that `_go` stays lean."""
    times, steps_left = grid.times, settings.max_steps
    for i in range(len(times)):
        status = _write_edited(c, references, hooks, grid, i, times[i], work)
        if status < DISCARD:
            status = get_values(c, references.outputs, record[i], work.cell)
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        steps = n_steps(times[i + 1] - times[i], settings.step, steps_left)
        if steps > steps_left:
            return TOO_MANY_STEPS, times[i]
        steps_left -= steps
        status = _advance_with_effects(c, references, settings, hooks, grid, i, steps, work)
        if status >= DISCARD:
            return failed_step(status), times[i]
        if has_ended(c, work.info):
            return TERMINATED, _ended_at(c, times[i], work)
    return FINISHED, times[-1]


@inlined
def _ended_at(c, time, work):  # type: ignore[no-untyped-def]
    """When the FMU ended the simulation, as far as it says so, which is after a time."""
    return time if is_fmi_2(c) else max(time, reached(work.info))


@inlined
def _advance(c, references, settings, grid, i, steps, work):  # type: ignore[no-untyped-def]
    """From one time of the grid to the next, in equal communication steps.

    An FMU that interpolates its inputs is told their slopes. Any other holds each at what it is at
    the start of a step: where that is too coarse, `Solver.step` shortens the steps.
    """
    step = settings.fixed or (grid.times[i + 1] - grid.times[i]) / steps
    status = 0
    for s in range(steps):
        if has_ended(c, work.info):
            break
        if s > 0 and status < DISCARD and len(work.inputs) > 0:
            take_inputs(grid, i, grid.times[i] + s * step, work)
            status = max(status, set_values(c, references.inputs, work.inputs, work.cell))
        if c.interpolates_inputs and len(references.moving.reals) > 0 and status < DISCARD:
            status = set_real_input_derivatives(
                c, references.inputs.reals, work.orders, grid.slopes[i]
            )
        count_call(work)
        if status < DISCARD:
            status = do_step(c, grid.times[i] + s * step, step, work.info)
    return status


@kernel
def _advance_with_effects(c, references, settings, hooks, grid, i, steps, work):  # type: ignore[no-untyped-def]
    """The same where effects edit inputs or parameters, which count as linear within a step."""
    step = settings.fixed or (grid.times[i + 1] - grid.times[i]) / steps
    status = 0
    for s in range(steps):
        time = grid.times[i] + s * step
        if has_ended(c, work.info):
            break
        if s > 0 and status < DISCARD:
            status = _write_edited(c, references, hooks, grid, i, time, work)
        _take_slopes(hooks, grid, i, time, step, work)
        if c.interpolates_inputs and len(references.moving.reals) > 0 and status < DISCARD:
            status = set_real_input_derivatives(
                c, references.inputs.reals, work.orders, work.slopes
            )
        count_call(work)
        if status < DISCARD:
            status = do_step(c, time, step, work.info)
    return status


@kernel
def _write_edited(c, references, hooks, grid, i, time, work):  # type: ignore[no-untyped-def]
    """Hand the FMU the inputs and parameters as the effects make them. Returns the worst status."""
    take_inputs(grid, i, time, work)
    before(hooks, time, work.states, work)
    status = 0
    if len(work.edited) > 0:
        status = set_values(c, references.inputs, work.edited, work.cell)
    if status < DISCARD and len(work.varied) > 0:
        status = max(status, set_reals(c, hooks.parameters, work.varied))
    return status


@inlined
def _take_slopes(hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """How fast the edited inputs change; the effects' own states go to the end of the step."""
    for j in range(len(work.slopes)):
        work.slopes[j] = -work.edited[j] / step
    if hooks.inside != 0:
        part = step / work.counts[0]
        for n in range(work.counts[0]):
            _advance_own_states(hooks, grid, i, time + n * part, part, work)
    take_inputs(grid, i, time + step, work)
    before(hooks, time + step, work.states, work)
    for j in range(len(work.slopes)):
        work.slopes[j] += work.edited[j] / step


@inlined
def _advance_own_states(hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """One classic Runge-Kutta step of the states that the effects bring along."""
    x, trial, k = work.states, work.trial, work.stages
    for stage in range(4):
        reach = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
        for j in range(len(x)):
            trial[j] = x[j] + reach * k[max(stage - 1, 0), j] if stage > 0 else x[j]
        take_inputs(grid, i, time + reach, work)
        inside(hooks, time + reach, trial, work, k[stage])
    for j in range(len(x)):
        x[j] += step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
