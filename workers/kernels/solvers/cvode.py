"""CVODE: backward differences of order 1 to 5, for stiff models.

See `workers.kernels.solvers.cvode_steps` for how it treats inputs and events.

Reference: S. D. Cohen, A. C. Hindmarsh, CVODE, a stiff/nonstiff ODE solver in C, Comput. Phys. 10
(1996) 138-143, doi:10.1063/1.4822377.
"""

from __future__ import annotations

import numpy as np
from numba.core.types import float64, int32, intp

from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.calling import c_function
from workers.kernels.fmi.compiling import kernel, subroutine
from workers.kernels.fmi.early_end import begin_squares, is_above_bound
from workers.kernels.fmi.failure import (
    ENDED_EARLY,
    FINISHED,
    OUTPUT,
    failed,
)
from workers.kernels.fmi.hooks import select_point
from workers.kernels.fmi.progress import note_steps
from workers.kernels.fmi.reference import by_reference
from workers.kernels.fmi.values import DISCARD
from workers.kernels.model_exchange.evaluation import record_outputs
from workers.kernels.model_exchange.solver_steps import (
    handle_input_jump,
    start_simulation,
)
from workers.kernels.solvers.callbacks import callbacks
from workers.kernels.solvers.cvode_steps import advance_to, has_reached, set_next_stop, set_number
from workers.kernels.solvers.dormand_prince import dormand_prince_batch
from workers.kernels.solvers.sundials import (
    EVENT_DUE,
    NEXT_STOP,
    REPEATED_EVENTS,
    RIGHT_HAND_SIDE,
    STATUS,
    STEP_REPORTED,
    STEPS_LEFT,
    CvodeIntegrator,
    DirectionalJacobian,
    libraries,
)
from workers.messages import FloatArray
from workers.messages.types import STEPS

OTHER_RIGHT_HAND_SIDE = -1
"""Returned by the loop if the integrator was made with another right-hand side than its own."""

_init = c_function(int32, intp, intp, float64, intp)
_set_linear_solver = c_function(int32, intp, intp, intp)
_set_pointer = c_function(int32, intp, intp)


class CvodeBatch:
    """A batch function that has an integrator for each number of states, made once and reused.

    It must not be called by two threads at a time. `jacobian` may be set before each call: it is
    used where no effects act.

    Raises
    ------
    ModelError
        If there is no CVODE for this platform.
    """

    def __init__(self) -> None:
        libraries()
        self._integrators: dict[int, CvodeIntegrator] = {}
        self.jacobian = DirectionalJacobian.of()

    def __call__(self, arguments: KernelArguments, states: FloatArray | None = None) -> int:
        """Simulate one experiment for many points; returns how many, as `co_simulate_batch` does.

        Parameters
        ----------
        arguments
            What to simulate.
        states : (n, x), optional
            Filled with the states at each time of the grid, of the last point.
        """
        count = len(arguments.work.states)
        states_out = np.empty((0, count)) if states is None else states
        if count == 0:  # nothing to integrate, which CVODE refuses
            return int(dormand_prince_batch(*arguments))
        while True:
            if count not in self._integrators:
                self._integrators[count] = CvodeIntegrator(count)
            cvode = self._integrators[count].cvode._replace(jacobian=self.jacobian)
            tried = int(_cvode_batch(cvode, *arguments, states_out))
            if tried != OTHER_RIGHT_HAND_SIDE:
                return tried
            del self._integrators[count]


@kernel
def _cvode_batch(  # type: ignore[no-untyped-def]
    s, c, references, starts, settings, hooks, grid, points, bounds, work, outputs, codes,
    stopped_at, steps, states_out,
):  # fmt: skip
    s, c, references, starts, settings, hooks, grid, work = by_reference(
        (s, c, references, starts, settings, hooks, grid, work)
    )
    function, jacobian, data = callbacks((s, c, references, hooks, grid, work))
    if s.flags[RIGHT_HAND_SIDE] == 0:
        s.flags[RIGHT_HAND_SIDE] = function
        _init(s.init, (s.memory, function, grid.times[0], s.state_vector))
        _set_linear_solver(s.set_linear_solver, (s.memory, s.solver, s.matrix))
    if s.flags[RIGHT_HAND_SIDE] != function:
        return OTHER_RIGHT_HAND_SIDE
    set_number(s.set_max_step, (s.memory, settings.step))  # 0: no limit
    _set_pointer(s.set_user_data, (s.memory, data))
    use_jacobian = (
        len(s.jacobian.states) == len(s.y)
        and hooks.modify_inputs == 0
        and hooks.add_derivatives == 0
    )
    _set_pointer(s.set_jacobian, (s.memory, jacobian if use_jacobian else 0))  # 0: by differences
    for p in range(len(points)):
        select_point(hooks, p, work)
        begin_squares(bounds, p, work)
        codes[p], stopped_at[p] = _simulate(
            s, c, references, starts, settings, hooks, grid, points[p], work, outputs[p], states_out
        )
        steps[p] = work.progress[STEPS]
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@subroutine
def _simulate(s, c, references, starts, settings, hooks, grid, point, work, outputs, states_out):  # type: ignore[no-untyped-def]
    times, steps = grid.times, 0
    code = start_simulation(c, references, starts, settings, hooks, grid, point, work)
    s.flags[STATUS], s.flags[NEXT_STOP] = 0, 0
    s.flags[STEP_REPORTED], s.flags[EVENT_DUE], s.flags[REPEATED_EVENTS] = 1, 0, 0
    s.time[0] = times[0]
    for i in range(len(times)):
        time = s.time[0] if has_reached(s, times[i]) else times[i]
        if code == FINISHED:
            code = handle_input_jump(c, references, settings, hooks, grid, i, time, work)
        if code != FINISHED:
            return code, s.time[0]
        status = record_outputs(c, references, hooks, grid, i, time, work, outputs[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), time
        if is_above_bound(grid, i, outputs[i], work):
            return ENDED_EARLY, time
        for j in range(states_out.shape[1] if len(states_out) > 0 else 0):
            states_out[i, j] = work.states[j]
        if i + 1 < len(times):
            if i == s.flags[NEXT_STOP]:
                set_next_stop(s, settings, grid, i, work)
            s.flags[STEPS_LEFT] = settings.max_steps
            code = advance_to(s, c, references, settings, hooks, grid, i + 1, work)
            steps += settings.max_steps - s.flags[STEPS_LEFT]
    note_steps(work, steps)
    return code, s.time[0]
