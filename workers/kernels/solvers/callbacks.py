"""The derivatives of a model and their Jacobian as C functions, for CVODE, which calls back."""

from __future__ import annotations

from math import isfinite
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.compiler import Flags
from numba.core.types import intp
from numba.extending import intrinsic

from workers.kernels.fmi.calling import c_function, inlined
from workers.kernels.fmi.functions import get_directional_derivative
from workers.kernels.fmi.hooks import take_inputs
from workers.kernels.fmi.values import DISCARD, ERROR
from workers.kernels.model_exchange.moving import go_to, slopes_here
from workers.kernels.solvers.sundials import INTERVAL, STATUS

_values = c_function(intp, intp)


@inlined
def move(time, states, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """Tell the FMU where it is, with the inputs of that time. Returns the worst status.

    At the time of a jump, the inputs are those of the side that the FMU was on before.
    """
    i = s.notes[INTERVAL]
    while i + 2 < len(grid.times) and time > grid.times[i + 1]:
        i += 1
    while i > 0 and time < grid.times[i]:
        i -= 1
    s.notes[INTERVAL] = i
    take_inputs(grid, i, time, work)
    return go_to(c, references, hooks, time, states, work)


def _slopes(time, y, ydot, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """As CVODE asks for it. 0, or 1 to be asked again for another point, or -1 to give up."""
    if s.notes[STATUS] >= ERROR:
        return -1
    states = _at(_values(s.values, (y,)), s.y)
    slopes = _at(_values(s.values, (ydot,)), s.y)
    status = move(time, states, s, c, references, hooks, grid, work)
    if status < DISCARD:
        status = max(status, slopes_here(c, hooks, time, states, work, slopes))
    s.notes[STATUS] = status
    if status >= ERROR:
        return -1
    if status >= DISCARD:
        return 1
    for j in range(len(slopes)):
        if not isfinite(slopes[j]):
            return 1
    return 0


def _jacobian(time, y, ydot, matrix, s, c, references, hooks, grid, work):  # type: ignore[no-untyped-def]
    """As CVODE asks for it: a column for each state. The same answers as `_slopes` gives."""
    n, along = len(s.y), s.jacobian
    columns = _values(s.elements, (matrix,))
    status = move(time, _at(_values(s.values, (y,)), s.y), s, c, references, hooks, grid, work)
    for j in range(n):
        column = _at(columns + 8 * n * j, s.y)
        along.known[0] = along.states[j]
        if status < DISCARD:
            status = max(
                status,
                get_directional_derivative(c, along.slopes, along.known, 1, along.one, column),
            )
    s.notes[STATUS] = status
    if status >= ERROR:
        return -1
    return 1 if status >= DISCARD else 0


@intrinsic
def callbacks(typing_context: Any, shared: Any) -> Any:
    """The addresses of `_slopes` and `_jacobian` as C functions, and of what the caller shares.

    `shared` is a tuple of what follows `ydot`, or `matrix`. The functions are compiled into the
    caller for the very types of it, and cached on disk with the caller. What is shared lies on the
    caller's stack: nothing may be integrated any more once the caller has returned.
    """

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        data = cgutils.alloca_once_value(builder, operands[0])
        slopes = _callback(context, builder, _slopes, 2, 0, data, shared)
        jacobian = _callback(context, builder, _jacobian, 3, 3, data, shared)
        word = context.get_value_type(types.intp)
        addresses = [builder.ptrtoint(pointer, word) for pointer in (slopes, jacobian, data)]
        return context.make_tuple(builder, signature.return_type, addresses)

    return types.containers.UniTuple(types.intp, 3)(shared), generate


def _callback(
    context: Any, builder: Any, body: Any, words: int, unused: int, data: Any, shared: Any
) -> Any:
    """A C function of a time, some words, the address of `data`, and words that nobody uses."""
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
    asked = types.int32(types.float64, *[types.intp] * words, *shared)
    flags = Flags()
    flags.forceinline = True  # to hand over the many fields of what is shared takes microseconds
    compiled = context.compile_subroutine(inner, body, asked, flags=flags)
    _, answer = context.call_internal_no_propagate(
        inner,
        compiled.fndesc,
        asked,
        [*function.args[: 1 + words], *(inner.extract_value(given, n) for n in range(len(shared)))],
    )
    inner.ret(answer)
    return function


@intrinsic
def _at(typing_context: Any, address: Any, like: Any) -> Any:
    """An array like another one, whose first element is at an address."""

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        layout = context.make_array(like)(context, builder, operands[1])
        layout.data = builder.inttoptr(operands[0], layout.data.type)
        return layout._getvalue()

    return like(types.intp, like), generate
