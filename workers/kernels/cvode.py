"""CVODE: backward differences of order 1 to 5, for stiff models.

(decision on knots here)
"""

from __future__ import annotations

from math import isfinite
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types import float64, int32, intp
from numba.extending import intrinsic

from workers.kernels.calling import address_of, c_function, inlined, kernel
from workers.kernels.dormand_prince import dormand_prince_batch
from workers.kernels.failure import (
    FINISHED,
    OUTPUT,
    STEP,
    STEP_TOO_SMALL,
    TOO_MANY_STEPS,
    failed,
)
from workers.kernels.fmi2 import DISCARD, ERROR, Component, Constants, References, Workspace
from workers.kernels.hooks import Hooks, take_inputs, take_point
from workers.kernels.initialise import Settings
from workers.kernels.model_exchange import (
    complete_step,
    go_to,
    record_outputs,
    slopes_here,
    start,
)
from workers.kernels.sundials import Integrator
from workers.grid import Grid
from workers.messages import FloatArray, IntArray

MADE_WITH, INTERVAL, WORST = 0, 1, 2
"""Places in `Cvode.notes`."""
ANOTHER = -1
"""Returned where the integrator was made for another right-hand side."""
ONE_STEP = 2
MODE = [0]

_init = c_function(int32, intp, intp, float64, intp)
_reinit = c_function(int32, intp, float64, intp)
_set_tolerances = c_function(int32, intp, float64, intp)
_set_linear_solver = c_function(int32, intp, intp, intp)
_set_pointer = c_function(int32, intp, intp)
_set_number = c_function(int32, intp, float64)
_integrate = c_function(int32, intp, float64, intp, intp, int32)
_interpolate = c_function(int32, intp, float64, int32, intp)
_values = c_function(intp, intp)


class CvodeBatch:
    """A batch function with an integrator for each number of states, made once and reused."""

    def __init__(self) -> None:
        self._integrators: dict[int, Integrator] = {}

    def __call__(
        self,
        c: Component,
        references: References,
        constants: Constants,
        settings: Settings,
        hooks: Hooks,
        grid: Grid,
        points: FloatArray,
        work: Workspace,
        outputs: FloatArray,
        codes: IntArray,
        stopped_at: FloatArray,
    ) -> int:
        """Simulate one experiment for many points; arguments as in `co_simulate_batch`."""
        rest = (
            c, references, constants, settings, hooks, grid, points, work, outputs, codes,
            stopped_at,
        )  # fmt: skip
        states = len(work.states)
        if states == 0:  # nothing to integrate, which CVODE cannot
            return int(dormand_prince_batch(*rest))
        tried = ANOTHER
        while tried == ANOTHER:
            if states not in self._integrators:
                self._integrators[states] = Integrator(states)
            tried = int(cvode_batch(MODE[0], self._integrators[states].cvode, *rest))
            if tried == ANOTHER:
                del self._integrators[states]
        return tried


@kernel
def cvode_batch(  # type: ignore[no-untyped-def]
    mode, s, c, references, constants, settings, hooks, grid, points, work, outputs, codes, stopped_at
):
    """Simulate with the integrator `s`; ANOTHER if it was made for other types of arguments."""
    function, data = _right_hand_side((s, c, references, hooks, grid, work))
    if s.notes[MADE_WITH] == 0:
        s.notes[MADE_WITH] = function
        _init(s.init, (s.memory, function, grid.times[0], s.states))
        _set_linear_solver(s.set_linear_solver, (s.memory, s.solver, s.matrix))
    if s.notes[MADE_WITH] != function:
        return ANOTHER
    for j in range(len(s.atols)):
        s.atols[j] = settings.atols[j]
    _set_tolerances(s.set_tolerances, (s.memory, settings.rtol, s.tolerances))
    _set_number(s.set_max_step, (s.memory, settings.step))
    _set_pointer(s.set_user_data, (s.memory, data))
    for p in range(len(points)):
        take_point(hooks, p, work)
        codes[p], stopped_at[p] = _cvode(
            mode, s, c, references, constants, settings, hooks, grid, points[p], work, outputs[p]
        )
        if codes[p] != FINISHED:
            return p + 1
    return len(points)


@kernel
def _cvode(mode, s, c, references, constants, settings, hooks, grid, point, work, record):  # type: ignore[no-untyped-def]
    times = grid.times
    code = start(c, references, constants, hooks, grid, point, work)
    if code != FINISHED:
        return code, times[0]
    steps_left, stop = settings.max_steps, 0
    for j in range(len(s.y)):
        s.y[j] = work.states[j]
    for i in range(len(times)):
        status = record_outputs(c, references, hooks, grid, i, work, record[i])
        if status >= DISCARD:
            return failed(OUTPUT, status), times[i]
        if i + 1 == len(times):
            break
        if i == stop:
            again = i == 0 or _breaks(grid, i, mode)
            stop = _next_stop(grid, i, mode)
            s.notes[INTERVAL] = i
            if again:
                s.notes[WORST] = 0
                s.time[0] = times[i]
                _reinit(s.reinit, (s.memory, times[i], s.states))
            _set_number(s.set_stop_time, (s.memory, times[stop]))
        while s.time[0] < times[i + 1]:
            if steps_left <= 0:
                return TOO_MANY_STEPS, s.time[0]
            steps_left -= 1
            flag = _integrate(
                s.integrate, (s.memory, times[stop], s.states, address_of(s.time), ONE_STEP)
            )
            if flag < 0:
                worst = s.notes[WORST]
                return (failed(STEP, worst) if worst >= ERROR else STEP_TOO_SMALL), s.time[0]
        if s.time[0] == times[i + 1]:
            for j in range(len(s.y)):
                work.states[j] = s.y[j]
        else:
            _interpolate(s.interpolate, (s.memory, times[i + 1], 0, s.tolerances))
            for j in range(len(s.y)):
                work.states[j] = s.atols[j]
    return FINISHED, times[-1]

@kernel
def _breaks(grid, i, mode):
    jump, kink = False, False
    for j in range(grid.inputs.shape[1]):
        jump |= grid.inputs[i,j] != grid.inputs[i-1,j] and grid.slopes[i-1,j] == 0
        kink |= grid.slopes[i,j] != grid.slopes[i-1,j]
    if mode == 0:   # tstop all, reinit at jumps
        return jump
    if mode == 1:
        return jump or kink
    if mode == 2:  #  all free
        return False
    return jump

@kernel
def _next_stop(grid, i, mode):
    n = len(grid.times)
    if mode <= 1:
        return i + 1
    if mode == 2:
        return n - 1
    for k in range(i + 1, n):
        if _breaks(grid, k, mode):
            return k
    return n - 1


def _slopes(t, y, ydot, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """The right-hand side as CVODE calls it: 0, 1 to be asked again closer by, -1 to give up."""
    if s.notes[WORST] >= ERROR:
        return -1
    states = _at(_values(s.values, (y,)), s.y)
    result = _at(_values(s.values, (ydot,)), s.y)
    i = s.notes[INTERVAL]
    while i + 2 < len(grid.times) and t > grid.times[i + 1]:
        i += 1
    while i > 0 and t < grid.times[i]:
        i -= 1
    s.notes[INTERVAL] = i
    take_inputs(grid, i, t, work)
    status = go_to(c, references, hooks, t, states, work)
    if status < DISCARD:
        status = max(status, slopes_here(c, hooks, t, states, work, result))
    s.notes[WORST] = status
    if status >= ERROR:
        return -1
    if status >= DISCARD:
        return 1
    for j in range(len(result)):
        if not isfinite(result[j]):
            return 1
    return 0


@intrinsic
def _at(typing_context: Any, address: Any, like: Any) -> Any:
    """An array like another one, whose first element is at an address."""

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        layout = context.make_array(like)(context, builder, operands[1])
        layout.data = builder.inttoptr(operands[0], layout.data.type)
        return layout._getvalue()

    return like(types.intp, like), generate


@intrinsic
def _right_hand_side(typing_context: Any, shared: Any) -> Any:
    """The address of `_slopes` as a C function, and that of what it shares with the caller.

    The function is compiled into the caller, for the very types that it shares, and is cached with
    it. What is shared stands on the caller's stack: it is gone when the caller returns.
    """

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        data = cgutils.alloca_once_value(builder, operands[0])
        word = context.get_value_type(types.intp)
        number, status = context.get_value_type(types.float64), context.get_value_type(types.int32)
        function = ir.Function(
            builder.module,
            ir.FunctionType(status, [number, word, word, word]),
            builder.module.get_unique_name("cvode_right_hand_side"),
        )
        function.linkage = "internal"
        inner = ir.IRBuilder(function.append_basic_block())
        given = inner.load(inner.inttoptr(function.args[3], data.type))
        taken = [inner.extract_value(given, n) for n in range(len(shared))]
        asked = types.int32(types.float64, types.intp, types.intp, *shared)
        compiled = context.compile_subroutine(inner, _slopes, asked)
        _, answer = context.call_internal_no_propagate(
            inner, compiled.fndesc, asked, [*function.args[:3], *taken]
        )
        inner.ret(answer)
        addresses = [builder.ptrtoint(p, word) for p in (function, data)]
        return context.make_tuple(builder, signature.return_type, addresses)

    return types.UniTuple(types.intp, 2)(shared), generate
