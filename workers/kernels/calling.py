"""Calling C functions from compiled loops by their address.

A ctypes function handed to numba costs half a millisecond for each entry and cannot be cached on
disk. An address is only an integer: it is turned into a function pointer inside the compiled code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import njit
from numba.core import types
from numba.extending import intrinsic

kernel = njit(nogil=True, cache=True, _nrt=False)
"""Compiles a loop, and without reference counting: atomic counters around every call would cost
several times the call. Nothing can be allocated inside; numba refuses to compile it."""

inlined = njit(inline="always")
"""Compiles a helper into each loop that uses it."""


def c_function(returns: Any, *arguments: Any) -> Callable[..., Any]:
    """Make a compiled caller of the C functions with this signature.

    Parameters
    ----------
    returns, *arguments
        numba scalar types. A pointer travels as `types.intp`.

    Returns
    -------
    callable
        `call(address, values)` for use inside compiled code, `values` being a tuple.
    """

    @intrinsic
    def call(typing_context: Any, address: Any, values: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
            pointer, packed = operands
            prototype = ir.FunctionType(
                context.get_value_type(returns), [context.get_value_type(a) for a in arguments]
            )
            cast = [
                context.cast(builder, builder.extract_value(packed, i), given, wanted)
                for i, (given, wanted) in enumerate(zip(values.types, arguments, strict=True))
            ]
            return builder.call(builder.inttoptr(pointer, prototype.as_pointer()), cast)

        return returns(types.intp, values), generate

    return call  # type: ignore[no-any-return]


@intrinsic
def address_of(typing_context: Any, array: Any) -> Any:
    """Give the address of an array's first element, without touching its reference count.

    The array must outlive the use of the address: it has to be an argument of the outermost
    compiled function, because numba frees a local array after its last visible use.
    """

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        layout = context.make_array(signature.args[0])(context, builder, operands[0])
        return builder.ptrtoint(layout.data, context.get_value_type(types.intp))

    return types.intp(array), generate
