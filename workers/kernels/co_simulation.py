"""Co-simulation: the FMU integrates itself from one communication point to the next."""

from __future__ import annotations

from workers.kernels.calling import inlined, kernel
from workers.kernels.failure import (
    FINISHED,
    INITIALISATION,
    OUTPUT,
    STEP,
    TOO_MANY_STEPS,
    failed,
)
from workers.kernels.fmi2 import (
    DISCARD,
    do_step,
    get_real,
    set_real,
    set_real_input_derivatives,
)
from workers.kernels.initialise import initialise, n_steps


@kernel
def co_simulate_batch(  # type: ignore[no-untyped-def]
    c, references, constants, settings, grid, points, work, outputs, codes, stopped_at
):
    """Simulate one experiment for many points.

    Parameters
    ----------
    points : (p, k)
        Start values of the reals, a row a point.
    outputs : (p, n, y)
        Filled with the outputs at each time of the grid.
    codes, stopped_at : (p,)
        Filled with 0, or what went wrong (see `workers.kernels.failure`), and the time of it.

    Returns
    -------
    int
        How many points were tried: all, or those up to the first that failed, so that the caller
        can ask the FMU what it has to say about it.
    """
    for p in range(len(points)):
        codes[p], stopped_at[p] = _co_simulate(
            c, references, constants, settings, grid, points[p], work, outputs[p]
        )
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@kernel
def _co_simulate(c, references, constants, settings, grid, point, work, record):  # type: ignore[no-untyped-def]
    times = grid.times
    tolerance = settings.fmu_tolerance
    status = initialise(c, references, constants, point, grid.inputs[0], tolerance, times[0])
    if status >= DISCARD:
        return failed(INITIALISATION, status), times[0]
    steps_left = settings.max_steps
    for i in range(len(times)):
        if grid.inputs.shape[1] > 0:
            status = set_real(c, references.inputs, grid.inputs[i])
        if status < DISCARD:
            status = get_real(c, references.outputs, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        steps = n_steps(times[i + 1] - times[i], settings.step, steps_left)
        if steps > steps_left:
            return TOO_MANY_STEPS, times[i]
        steps_left -= steps
        status = _advance(c, references, grid, i, steps, work)
        if status >= DISCARD:
            return failed(STEP, status), times[i]
    return FINISHED, times[-1]


@inlined
def _advance(c, references, grid, i, steps, work):  # type: ignore[no-untyped-def]
    """From one time of the grid to the next, in equal communication steps.

    An FMU that interpolates its inputs is told their slopes. Any other holds each at what it is at
    the start of a step: where that is too coarse, `Solver.step` shortens the steps.
    """
    start, length = grid.times[i], grid.times[i + 1] - grid.times[i]
    step = length / steps
    status = 0
    for s in range(steps):
        if s > 0 and status < DISCARD and len(work.inputs) > 0:
            for j in range(len(work.inputs)):
                work.inputs[j] = grid.inputs[i, j] + s * step * grid.slopes[i, j]
            status = max(status, set_real(c, references.inputs, work.inputs))
        if c.interpolates_inputs and len(work.inputs) > 0 and status < DISCARD:
            status = set_real_input_derivatives(c, references.inputs, work.orders, grid.slopes[i])
        if status < DISCARD:
            status = do_step(c, start + s * step, step)
    return status
