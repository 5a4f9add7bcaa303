"""Whether stability, rather than accuracy, limits the steps of the Dormand-Prince method.

The two last stages of a step stand at the same time. How much their derivatives differ for how much
their states differ estimates the largest eigenvalue; where it times the step stays at the border
of the region of stability, a model is stiff.

Reference: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II,
doi:10.1007/978-3-642-05221-7, section IV.2.
"""

from __future__ import annotations

from math import sqrt

from workers.kernels.fmi.calling import inlined, kernel
from workers.kernels.fmi.failure import FINISHED, STEP, STEP_TOO_SMALL, failed
from workers.kernels.fmi.hooks import take_point
from workers.kernels.fmi.values import DISCARD, ERROR
from workers.kernels.model_exchange.moving import derivative
from workers.kernels.model_exchange.solver_steps import complete_step, start
from workers.kernels.solvers.dormand_prince import WEIGHTS, _factor, _first_step, _stages

BORDER = 3.25
IN_A_ROW, PARDON = 15, 6
"""Steps at the border after which a model counts as stiff, and steps off it that forgive those."""


@kernel
def stiffness(c, references, starts, settings, hooks, grid, point, work):  # type: ignore[no-untyped-def]
    """Follow a simulation for at most `settings.max_steps` steps.

    Parameters
    ----------
    point : (k,)
        Start values of the reals. The others are as in `co_simulate_batch`.

    Returns
    -------
    (stiff, code)
        Whether, and what went wrong, if anything did (see `workers.kernels.fmi.failure`).
    """
    take_point(hooks, 0, work)
    code = start(c, references, starts, settings, hooks, grid, point, work)
    if code != FINISHED:
        return False, code
    time, i, at_border, off_border, proposed = grid.times[0], 0, 0, 0, 0.0
    for _ in range(settings.max_steps):
        status = derivative(c, references, hooks, grid, i, time, work.states, work, work.stages[0])
        if status >= DISCARD:
            return False, failed(STEP, status)
        if proposed == 0.0:
            proposed = _first_step(work.states, work.stages[0], settings.rtol, work.atols)
        code, step, proposed = _step(c, references, settings, hooks, grid, i, time, proposed, work)
        if code != FINISHED:
            return False, code
        at_border, off_border = _count(step * _eigenvalue(step, work), at_border, off_border)
        if at_border == IN_A_ROW:
            return True, FINISHED
        time = min(time + step, grid.times[i + 1])
        i += 1 if time == grid.times[i + 1] else 0
        for j in range(len(work.states)):
            work.states[j] = work.trial[j]
        code = complete_step(c, work)
        if code != FINISHED or i + 1 == len(grid.times):
            break
    return False, code


@kernel
def _step(c, references, settings, hooks, grid, i, time, proposed, work):  # type: ignore[no-untyped-def]
    """Try until a step is accepted. Returns the code, its length, and the length to try next."""
    while True:
        if settings.step > 0.0:
            proposed = min(proposed, settings.step)
        step = min(proposed, grid.times[i + 1] - time)
        if not time + step > time:
            return STEP_TOO_SMALL, step, proposed
        status, error = _stages(c, references, settings, hooks, grid, i, time, step, work)
        if status >= ERROR:
            return failed(STEP, status), step, proposed
        wanted = step * _factor(status, error)
        if status < DISCARD and error <= 1.0:
            return FINISHED, step, max(wanted, proposed) if step < proposed else wanted
        proposed = wanted


@inlined
def _count(distance, at_border, off_border):  # type: ignore[no-untyped-def]
    if distance > BORDER:
        return at_border + 1, 0
    return 0 if off_border + 1 == PARDON else at_border, off_border + 1


@inlined
def _eigenvalue(step, work):  # type: ignore[no-untyped-def]
    """Its estimate from the last two stages of a step."""
    above, below = 0.0, 0.0
    for j in range(len(work.states)):
        slope = 0.0
        for stage in range(5):
            slope += WEIGHTS[5, stage] * work.stages[stage, j]
        sixth = work.states[j] + step * slope
        above += (work.stages[6, j] - work.stages[5, j]) ** 2
        below += (work.trial[j] - sixth) ** 2
    return sqrt(above / below) if below > 0.0 else 0.0
