"""Dormand-Prince 5(4), adaptive, with a step that ends at every time of the grid.

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
    STEP_TOO_SMALL,
    TOO_MANY_STEPS,
    failed,
)
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.progress import note_steps
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD, ERROR
from workers.kernels.model_exchange.evaluation import (
    current_derivatives,
    derivatives_at,
    record_outputs,
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

# c, a and b - b^ of the Butcher tableau; the last row of a is b.
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
INTERPOLANT = np.array(
    [
        [1, -8048581381 / 2820520608, 8663915743 / 2820520608, -12715105075 / 11282082432],
        [0, 0, 0, 0],
        [0, 131558114200 / 32700410799, -68118460800 / 10900136933, 87487479700 / 32700410799],
        [0, -1754552775 / 470086768, 14199869525 / 1410260304, -10690763975 / 1880347072],
        [0, 127303824393 / 49829197408, -318862633887 / 49829197408, 701980252875 / 199316789632],
        [0, -282668133 / 205662961, 2019193451 / 616988883, -1453857185 / 822651844],
        [0, 40617522 / 29380423, -110615467 / 29380423, 69997945 / 29380423],
    ]
)
"""Of order 4 within a step, see `dense_output` in `workers.kernels.model_exchange.events`. Source:
L. F. Shampine, Math. Comp. 46 (1986) 135-150, doi:10.1090/S0025-5718-1986-0815836-3."""
SAFETY, SHRINK, GROW = 0.9, 0.2, 5.0


@kernel
def dormand_prince_batch(  # type: ignore[no-untyped-def]
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
    time, proposed = times[0], 0.0
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
            code, time, proposed, steps_left = adaptive_steps(
                c, references, settings, hooks, grid, i, time, proposed, settings.max_steps, work
            )
            steps += settings.max_steps - steps_left
    note_steps(work, steps)
    return code, time


@inlined
def adaptive_steps(  # type: ignore[no-untyped-def]
    c, references, settings, hooks, grid, i, time, proposed, steps_left, work, forward=None
):
    """Step from the present time, which the FMU is set to, to grid time i + 1.

    Returns (code, time, step to try next, steps left). A proposed step of 0 stands for none. With
    `forward`, sensitivities are integrated too, up to the first event.
    """
    last, repeated_events = grid.times[i + 1], 0
    resolution = time_resolution(time, last)
    while True:
        begin = time
        end = min(last, work.next_event[0])
        if (
            abs(work.next_event[0] - last) <= resolution
        ):  # not once before the grid time and once after
            end = work.next_event[0]
        code = FINISHED
        if end > begin:
            code, time, proposed, steps_left = _to_next_event(
                c, references, settings, hooks, grid, i, begin, end, proposed, steps_left, work,
                forward,
            )  # fmt: skip
        if code == EVENT or (code == FINISHED and time >= work.next_event[0]):
            if forward is not None:
                return HAS_EVENTS, time, proposed, steps_left
            repeated_events = repeated_events + 1 if time - begin <= resolution else 0
            code = handle_event(
                c, references, settings, hooks, grid, i, i, time, repeated_events, work
            )
            proposed = 0.0
        if code != FINISHED or last - time <= resolution:
            return code, time, proposed, steps_left


@inlined
def _to_next_event(  # type: ignore[no-untyped-def]
    c, references, settings, hooks, grid, i, time, last, proposed, steps_left, work, forward
):
    """Step up to a time or a state event. Returns (code, time, step to try next, steps left)."""
    resolution = time_resolution(time, last)
    status, proposed = _first_stage(c, settings, hooks, time, proposed, resolution, work)
    if status >= DISCARD:
        return failed(STEP, status), time, proposed, steps_left
    while steps_left > 0:
        proposed = min(proposed, settings.step) if settings.step > 0.0 else proposed
        remaining = last - time
        final = proposed >= remaining * (1.0 - 1e-10)
        step = remaining if final else min(proposed, 0.5 * remaining)
        status, error, fraction = _try_step(
            c, references, settings, hooks, grid, i, time, step, work
        )
        steps_left -= 1
        if status >= ERROR:
            return failed(STEP, status), time, proposed, steps_left
        next_step = step * step_factor(status, error)
        if status >= DISCARD or not error <= 1.0:
            proposed = next_step
            if proposed < resolution:
                return STEP_TOO_SMALL, time, proposed, steps_left
            continue
        if forward is not None:
            status = advance_sensitivities(c, references, hooks, grid, i, time, step, work, forward)
            if status >= DISCARD:
                return failed(SENSITIVITIES, status), time, proposed, steps_left
        code = _accept_step(c, fraction, work)
        time = last if final and fraction > 1.0 else time + step * min(fraction, 1.0)
        proposed = max(proposed, next_step) if final else next_step
        if code != FINISHED or final:
            return code, time, proposed, steps_left
    return TOO_MANY_STEPS, time, proposed, steps_left


@inlined
def _first_stage(c, settings, hooks, time, proposed, resolution, work):  # type: ignore[no-untyped-def]
    """Evaluate the first stage, and propose a step. Returns (status, step)."""
    status = current_derivatives(c, hooks, time, work.states, work, work.stages[0])
    if proposed == 0.0 and status < DISCARD:
        proposed = initial_step(work.states, work.stages[0], settings.rtol, work.atols)
    if (
        not proposed >= resolution
    ):  # or not a number, after an overflow: a step of 0 would never end
        proposed = resolution
    return status, proposed


@inlined
def _accept_step(c, fraction, work):  # type: ignore[no-untyped-def]
    """Accept a step, or its part up to an event. Returns FINISHED, EVENT or a code of failure."""
    for j in range(len(work.states)):
        work.states[j] = work.trial[j]
        work.stages[0, j] = work.stages[6, j]
    code = complete_step(c, work)
    return EVENT if code == FINISHED and fraction <= 1.0 else code


@inlined
def _try_step(c, references, settings, hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """Try a step and look for events in it. Returns (status, error, part up to an event or 2)."""
    status, error = evaluate_stages(c, references, settings, hooks, grid, i, time, step, work)
    fraction = 2.0
    if c.n_indicators > 0 and status < DISCARD and error <= 1.0:
        status, fraction = find_event(
            c, references, hooks, grid, i, time, step, dense_output, INTERPOLANT, work
        )
    return status, error, fraction


@inlined
def evaluate_stages(c, references, settings, hooks, grid, i, time, step, work):  # type: ignore[no-untyped-def]
    """Evaluate the six stages after the first, and the new states, into `trial`.

    Returns (status, error). The error is scaled: the step meets the tolerance if it is at most 1.
    """
    x, trial, k = work.states, work.trial, work.stages
    status = 0
    for stage in range(1, 7):
        for j in range(len(x)):
            total_slope = 0.0
            for earlier in range(stage):
                total_slope += WEIGHTS[stage, earlier] * k[earlier, j]
            trial[j] = x[j] + step * total_slope
        if status < DISCARD:
            stage_time = time + NODES[stage] * step
            status = derivatives_at(
                c, references, hooks, grid, i, stage_time, trial, work, k[stage]
            )
    total = 0.0
    for j in range(len(x)):
        estimate = 0.0
        for stage in range(7):
            estimate += ERROR_WEIGHTS[stage] * k[stage, j]
        scale = work.atols[j] + settings.rtol * max(abs(x[j]), abs(trial[j]))
        total += (step * estimate / scale) ** 2
    return status, sqrt(total / max(1, len(x)))


@inlined
def step_factor(status, error):  # type: ignore[no-untyped-def]
    """Return the factor by which to change the step after a try."""
    if status >= DISCARD or not isfinite(error):
        return SHRINK
    if error == 0.0:
        return GROW
    return min(GROW, max(SHRINK, SAFETY * error**-0.2))


@inlined
def initial_step(states, derivatives, rtol, atols):  # type: ignore[no-untyped-def]
    """Return a hundredth of the time in which the states would change by their own scale."""
    size, speed = 0.0, 0.0
    for j in range(len(states)):
        scale = atols[j] + rtol * abs(states[j])
        size += (states[j] / scale) ** 2
        speed += (derivatives[j] / scale) ** 2
    if size < 1e-10 or speed < 1e-10:
        return 1e-6
    return 0.01 * sqrt(size / speed)
