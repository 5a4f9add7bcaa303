"""The classic Runge-Kutta method of order 4 with a fixed step.

The cheapest choice for smooth, non-stiff models whose inputs are sampled more finely than their
dynamics. It never checks its own error: compare once with half the step.

Reference: W. Kutta, Zeitschrift fuer Mathematik und Physik 46 (1901) 435-453.
"""

from __future__ import annotations

from workers.kernels.calling import inlined, kernel
from workers.kernels.failure import FINISHED, OUTPUT, STEP, TOO_MANY_STEPS, failed
from workers.kernels.fmi2 import DISCARD
from workers.kernels.hooks import take_point
from workers.kernels.initialise import n_steps
from workers.kernels.model_exchange import (
    complete_step,
    derivative,
    go_to,
    record_outputs,
    slopes_here,
    start,
)


@kernel
def rk4_batch(  # type: ignore[no-untyped-def]
    c, references, constants, settings, hooks, grid, points, work, outputs, codes, stopped_at
):
    """Simulate one experiment for many points; arguments as in `co_simulate_batch`."""
    for p in range(len(points)):
        take_point(hooks, p, work)
        codes[p], stopped_at[p] = _rk4(
            c, references, constants, settings, hooks, grid, points[p], work, outputs[p]
        )
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@kernel
def _rk4(c, references, constants, settings, hooks, grid, point, work, record):  # type: ignore[no-untyped-def]
    times = grid.times
    code = start(c, references, constants, hooks, grid, point, work)
    if code != FINISHED:
        return code, times[0]
    steps_left = settings.max_steps
    for i in range(len(times)):
        status = record_outputs(c, references, hooks, grid, i, work, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        length = times[i + 1] - times[i]
        steps = n_steps(length, settings.step, steps_left)
        if steps > steps_left:
            return TOO_MANY_STEPS, times[i]
        steps_left -= steps
        step = length / steps
        for s in range(steps):
            time = times[i] + s * step
            status = _step(c, references, hooks, grid, i, time, step, s > 0, work)
            if status >= DISCARD:
                return failed(STEP, status), time
            code = complete_step(c, work)
            if code != FINISHED:
                return code, time + step
    return FINISHED, times[-1]


@inlined
def _step(c, references, hooks, grid, i, time, step, moved, work):  # type: ignore[no-untyped-def]
    """One step from `time`; at a grid time the FMU already stands there (`moved` is False)."""
    x, trial, k = work.states, work.trial, work.stages
    if moved:
        status = derivative(c, references, hooks, grid, i, time, x, work, k[0])
    else:
        status = slopes_here(c, hooks, time, x, work, k[0])
    for stage in range(1, 4):
        reach = step if stage == 3 else 0.5 * step
        for j in range(len(x)):
            trial[j] = x[j] + reach * k[stage - 1, j]
        if status < DISCARD:
            status = derivative(c, references, hooks, grid, i, time + reach, trial, work, k[stage])
    for j in range(len(x)):
        x[j] += step / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
    if c.completes_steps and status < DISCARD:
        status = max(status, go_to(c, references, hooks, time + step, x, work))
    return status
