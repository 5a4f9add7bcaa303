"""The derivatives of a model and their Jacobian as C functions, for CVODE, which calls back."""

from __future__ import annotations

from math import isfinite
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.compiler import Flags
from numba.core.types import intp
from numba.extending import intrinsic

from workers.kernels.fmi.calling import c_function
from workers.kernels.fmi.compiling import inlined
from workers.kernels.fmi.functions import get_directional_derivative
from workers.kernels.fmi.hooks import interpolate_inputs
from workers.kernels.fmi.values import DISCARD, ERROR
from workers.kernels.model_exchange.evaluation import current_derivatives, set_time_and_states
from workers.kernels.solvers.sundials import INTERVAL, STATUS

_values = c_function(intp, intp)


@inlined
def set_at_solver_time(time, states, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """Set time, states, and the inputs of that time. Returns the worst status.

    At the time of a jump, the inputs are those of the side of the last call.
    """
    i = s.flags[INTERVAL]
    while i + 2 < len(grid.times) and time > grid.times[i + 1]:
        i += 1
    while i > 0 and time < grid.times[i]:
        i -= 1
    s.flags[INTERVAL] = i
    interpolate_inputs(grid, i, time, work)
    return set_time_and_states(c, references, hooks, time, states, work)


def _right_hand_side(time, y, ydot, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """Evaluate dx/dt for CVODE. Returns 0, 1 for a recoverable failure, -1 for another."""
    if s.flags[STATUS] >= ERROR:
        return -1
    states = _array_at(_values(s.vector_data, (y,)), s.y)
    derivatives = _array_at(_values(s.vector_data, (ydot,)), s.y)
    status = set_at_solver_time(time, states, s, c, references, hooks, grid, work)
    if status < DISCARD:
        status = max(status, current_derivatives(c, hooks, time, states, work, derivatives))
    s.flags[STATUS] = status
    if status >= ERROR:
        return -1
    if status >= DISCARD:
        return 1
    for j in range(len(derivatives)):
        if not isfinite(derivatives[j]):
            return 1
    return 0


def _jacobian(time, y, _ydot, matrix, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """Evaluate the Jacobian for CVODE, a column for each state. Returns as the right-hand side."""
    n, directional = len(s.y), s.jacobian
    columns = _values(s.matrix_data, (matrix,))
    status = set_at_solver_time(
        time, _array_at(_values(s.vector_data, (y,)), s.y), s, c, references, hooks, grid, work
    )
    for j in range(n):
        column = _array_at(columns + 8 * n * j, s.y)
        directional.known[0] = directional.states[j]
        if status < DISCARD:
            status = max(
                status,
                get_directional_derivative(
                    c, directional.derivatives, directional.known, 1, directional.seed, column
                ),
            )
    s.flags[STATUS] = status
    if status >= ERROR:
        return -1
    return 1 if status >= DISCARD else 0


@intrinsic
def callbacks(_typing_context: Any, shared: Any) -> Any:
    """Return the addresses of `_right_hand_side` and `_jacobian`, and of what the caller shares.

    `shared` is a tuple of what follows `ydot`, or `matrix`. The functions are compiled into the
    caller for the very types of it, and cached on disk with the caller. What is shared lies on the
    caller's stack: nothing may be integrated any more once the caller has returned.
    """

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        data = cgutils.alloca_once_value(builder, operands[0])
        derivatives = _callback(context, builder, _right_hand_side, 2, 0, data, shared)
        jacobian = _callback(context, builder, _jacobian, 3, 3, data, shared)
        word = context.get_value_type(types.intp)
        addresses = [builder.ptrtoint(pointer, word) for pointer in (derivatives, jacobian, data)]
        return context.make_tuple(builder, signature.return_type, addresses)

    return types.containers.UniTuple(types.intp, 3)(shared), generate


def _callback(
    context: Any, builder: Any, body: Any, words: int, unused: int, data: Any, shared: Any
) -> Any:
    """Make a C function of a time, some words, the address of `data`, and unused words."""
    word = context.get_value_type(types.intp)
    number, status = context.get_value_type(types.float64), context.get_value_type(types.int32)
    function = ir.Function(
        builder.module,
        ir.FunctionType(status, [number, *[word] * (words + 1 + unused)]),
        builder.module.get_unique_name(body.__name__),
    )
    function.linkage = "internal"
    inner = ir.IRBuilder(function.append_basic_block())
    given = inner.load(inner.inttoptr(function.args[1 + words], data.type))
    signature_types = types.int32(types.float64, *[types.intp] * words, *shared)
    flags = Flags()
    flags.forceinline = True  # to hand over the many fields of what is shared takes microseconds
    compiled = context.compile_subroutine(inner, body, signature_types, flags=flags)
    _, status_value = context.call_internal_no_propagate(
        inner,
        compiled.fndesc,
        signature_types,
        [*function.args[: 1 + words], *(inner.extract_value(given, n) for n in range(len(shared)))],
    )
    inner.ret(status_value)
    return function


@intrinsic
def _array_at(_typing_context: Any, _address: Any, like: Any) -> Any:
    """Return an array like another one, whose first element is at an address."""

    def generate(context: Any, builder: Any, _signature: Any, operands: Any) -> Any:
        layout = context.make_array(like)(context, builder, operands[1])
        layout.data = builder.inttoptr(operands[0], layout.data.type)
        return layout._getvalue()

    return like(types.intp, like), generate
