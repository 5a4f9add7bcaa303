"""Dormand-Prince 5(4), adaptive, standing on every time of the grid.

The default for model exchange. Because no step crosses a kink of an input, the error estimate is
right and the tolerance is met; because the last stage of a step is the first of the next, a step
costs six derivatives.

References: J. R. Dormand, P. J. Prince, J. Comput. Appl. Math. 6 (1980) 19-26,
doi:10.1016/0771-050X(80)90013-3. Step control and starting step: E. Hairer, S. P. Norsett,
G. Wanner, Solving Ordinary Differential Equations I, doi:10.1007/978-3-540-78862-1, section II.4.
"""

from __future__ import annotations

from math import isfinite, sqrt

import numpy as np

from workers.kernels.calling import inlined, kernel
from workers.kernels.failure import FINISHED, OUTPUT, STEP, STEP_TOO_SMALL, TOO_MANY_STEPS, failed
from workers.kernels.fmi2 import DISCARD, ERROR
from workers.kernels.hooks import take_point
from workers.kernels.model_exchange import (
    complete_step,
    derivative,
    record_outputs,
    slopes_here,
    start,
)

NODES = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
WEIGHTS = np.array(
    [
        [0, 0, 0, 0, 0, 0],
        [1 / 5, 0, 0, 0, 0, 0],
        [3 / 40, 9 / 40, 0, 0, 0, 0],
        [44 / 45, -56 / 15, 32 / 9, 0, 0, 0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0, 0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0],
        [35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
ERROR_WEIGHTS = np.array(
    [71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40]
)
SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0


@kernel
def dormand_prince_batch(  # type: ignore[no-untyped-def]
    c, references, constants, settings, hooks, grid, points, work, outputs, codes, stopped_at
):
    """Simulate one experiment for many points; arguments as in `co_simulate_batch`."""
    for p in range(len(points)):
        take_point(hooks, p, work)
        codes[p], stopped_at[p] = _dormand_prince(
            c, references, constants, settings, hooks, grid, points[p], work, outputs[p]
        )
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@kernel
def _dormand_prince(c, references, constants, settings, hooks, grid, point, work, record):  # type: ignore[no-untyped-def]
    times, k = grid.times, work.stages
    code = start(c, references, constants, hooks, grid, point, work)
    if code != FINISHED:
        return code, times[0]
    proposed, steps_left = 0.0, settings.max_steps
    for i in range(len(times)):
        status = record_outputs(c, references, hooks, grid, i, work, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        status = slopes_here(c, hooks, times[i], work.states, work, k[0])
        if status >= DISCARD:
            return failed(STEP, status), times[i]
        if i == 0:
            proposed = _first_step(work.states, k[0], settings)
        code, reached, proposed, steps_left = _advance(
            c, references, settings, hooks, grid, i, proposed, steps_left, work
        )
        if code != FINISHED:
            return code, reached
    return FINISHED, times[-1]


@kernel
def _advance(c, references, settings, hooks, grid, i, proposed, steps_left, work):  # type: ignore[no-untyped-def]
    """From grid time i to the next. Returns (code, time, step to try next, steps left)."""
    time, last = grid.times[i], grid.times[i + 1]
    shortest = 16.0 * np.finfo(np.float64).eps * max(abs(time), abs(last))
    if not proposed >= shortest:  # or not a number, after an overflow: a step of 0 would never end
        proposed = shortest
    while True:
        if steps_left <= 0:
            return TOO_MANY_STEPS, time, proposed, steps_left
        if settings.step > 0.0:
            proposed = min(proposed, settings.step)
        remaining = last - time
        final = proposed >= remaining * (1.0 - 1e-10)
        step = remaining if final else min(proposed, 0.5 * remaining)
        status, error = _try_step(c, references, settings, hooks, grid, i, time, step, work)
        steps_left -= 1
        if status >= ERROR:
            return failed(STEP, status), time, proposed, steps_left
        if status >= DISCARD or not error <= 1.0:
            proposed = step * _factor(status, error)
            if proposed < shortest:
                return STEP_TOO_SMALL, time, proposed, steps_left
            continue
        time = last if final else time + step
        for j in range(len(work.states)):
            work.states[j] = work.trial[j]
            work.stages[0, j] = work.stages[6, j]
        wanted = step * _factor(status, error)
        proposed = max(proposed, wanted) if final else wanted
        code = complete_step(c, work)
        if code != FINISHED or final:
            return code, time, proposed, steps_left


@inlined
def _try_step(c, references, settings, hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """Six stages after the first. Leaves the new states in `trial`; returns (status, error).

    The error is scaled: the step meets the tolerance if it is at most 1.
    """
    x, trial, k = work.states, work.trial, work.stages
    status = 0
    for stage in range(1, 7):
        for j in range(len(x)):
            slope = 0.0
            for before in range(stage):
                slope += WEIGHTS[stage, before] * k[before, j]
            trial[j] = x[j] + step * slope
        if status < DISCARD:
            reach = time + NODES[stage] * step
            status = derivative(c, references, hooks, grid, i, reach, trial, work, k[stage])
    total = 0.0
    for j in range(len(x)):
        estimate = 0.0
        for stage in range(7):
            estimate += ERROR_WEIGHTS[stage] * k[stage, j]
        scale = settings.atols[j] + settings.rtol * max(abs(x[j]), abs(trial[j]))
        total += (step * estimate / scale) ** 2
    return status, sqrt(total / max(1, len(x)))


@inlined
def _factor(status, error):  # type: ignore[no-untyped-def]
    """By how much to change the step after a try."""
    if status >= DISCARD or not isfinite(error):
        return SHRINK
    if error == 0.0:
        return GROW
    return min(GROW, max(SHRINK, SAFETY * error**-0.2))


@inlined
def _first_step(states, derivatives, settings):  # type: ignore[no-untyped-def]
    """A hundredth of the time in which the states would change by their own scale."""
    size, speed = 0.0, 0.0
    for j in range(len(states)):
        scale = settings.atols[j] + settings.rtol * abs(states[j])
        size += (states[j] / scale) ** 2
        speed += (derivatives[j] / scale) ** 2
    if size < 1e-10 or speed < 1e-10:
        return 1e-6
    return 0.01 * sqrt(size / speed)
