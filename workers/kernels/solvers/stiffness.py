"""Detection of stiffness: stability, not accuracy, limits the steps of Dormand-Prince.

The two last stages of a step are at the same time. The distance of their derivatives over that of
their states estimates the largest eigenvalue; where its product with the step stays at the border
of the region of stability, a model is stiff.

Reference: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II,
doi:10.1007/978-3-642-05221-7, section IV.2.
"""

from __future__ import annotations

from math import sqrt

from workers.kernels.fmi.compiling import inlined, kernel, subroutine
from workers.kernels.fmi.failure import FINISHED, STEP, STEP_TOO_SMALL, failed
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD, ERROR
from workers.kernels.model_exchange.evaluation import derivatives_at
from workers.kernels.model_exchange.solver_steps import complete_step, start_simulation
from workers.kernels.solvers.dormand_prince import (
    WEIGHTS,
    evaluate_stages,
    initial_step,
    step_factor,
)

BORDER = 3.25
STIFF_STEPS, FORGIVING_STEPS = 15, 6
"""Steps at the border after which a model counts as stiff, and steps off it that forgive those."""


@kernel
def stiffness(c, references, starts, settings, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Simulate at most `settings.max_steps` steps, and tell whether the model is stiff.

    Parameters
    ----------
    point : (k,)
        Start values of the reals. The others are as in `co_simulate_batch`.

    Returns
    -------
    (stiff, code)
        True if it is; 0, or the code of a failure (see `workers.kernels.fmi.failure`).
    """
    c, references, starts, settings, hooks, grid, work = by_reference(
        (c, references, starts, settings, hooks, grid, work)
    )
    select_point(hooks, 0, work)
    code = start_simulation(c, references, starts, settings, hooks, grid, point, work)
    if code != FINISHED:
        return False, code
    time, i, at_border, off_border, proposed = grid.times[0], 0, 0, 0, 0.0
    for _ in range(settings.max_steps):
        status = derivatives_at(
            c, references, hooks, grid, i, time, work.states, work, work.stages[0]
        )
        if status >= DISCARD:
            return False, failed(STEP, status)
        if proposed == 0.0:
            proposed = initial_step(work.states, work.stages[0], settings.rtol, work.atols)
        code, step, proposed = _accepted_step(
            c, references, settings, hooks, grid, i, time, proposed, work
        )
        if code != FINISHED:
            return False, code
        at_border, off_border = _count_steps_at_border(
            step * _eigenvalue(step, work), at_border, off_border
        )
        if at_border == STIFF_STEPS:
            return True, FINISHED
        time = min(time + step, grid.times[i + 1])
        i += 1 if time == grid.times[i + 1] else 0
        for j in range(len(work.states)):
            work.states[j] = work.trial[j]
        code = complete_step(c, work)
        if code != FINISHED or i + 1 == len(grid.times):
            break
    return False, code


@subroutine
def _accepted_step(c, references, settings, hooks, grid, i, time, proposed, work):  # type: ignore[no-untyped-def]
    """Try steps until one is accepted. Returns (code, its length, length to try next)."""
    while True:
        if settings.step > 0.0:
            proposed = min(proposed, settings.step)
        step = min(proposed, grid.times[i + 1] - time)
        if not time + step > time:
            return STEP_TOO_SMALL, step, proposed
        status, error = evaluate_stages(c, references, settings, hooks, grid, i, time, step, work)
        if status >= ERROR:
            return failed(STEP, status), step, proposed
        next_step = step * step_factor(status, error)
        if status < DISCARD and error <= 1.0:
            return FINISHED, step, max(next_step, proposed) if step < proposed else next_step
        proposed = next_step


@inlined
def _count_steps_at_border(distance, at_border, off_border):  # type: ignore[no-untyped-def]
    if distance > BORDER:
        return at_border + 1, 0
    return 0 if off_border + 1 == FORGIVING_STEPS else at_border, off_border + 1


@inlined
def _eigenvalue(step, work):  # type: ignore[no-untyped-def]
    """Estimate the largest eigenvalue from the last two stages of a step."""
    derivative_distance, state_distance = 0.0, 0.0
    for j in range(len(work.states)):
        total = 0.0
        for stage in range(5):
            total += WEIGHTS[5, stage] * work.stages[stage, j]
        sixth = work.states[j] + step * total
        derivative_distance += (work.stages[6, j] - work.stages[5, j]) ** 2
        state_distance += (work.trial[j] - sixth) ** 2
    return sqrt(derivative_distance / state_distance) if state_distance > 0.0 else 0.0
