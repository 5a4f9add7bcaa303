"""Calling C functions from compiled loops by their address.

A ctypes function handed to numba costs half a millisecond for each entry and cannot be cached on
disk. An address is only an integer: it is turned into a function pointer inside the compiled code.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


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
    def call(_typing_context: Any, _address: Any, values: Any) -> Any:
        def generate(context: Any, builder: Any, _signature: Any, operands: Any) -> Any:
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
def address_of(_typing_context: Any, array: Any) -> Any:
    """Give the address of an array's first element, without touching its reference count.

    The array must outlive the use of the address: it has to be an argument of the outermost
    compiled function, because numba frees a local array after its last visible use.
    """

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        layout = context.make_array(signature.args[0])(context, builder, operands[0])
        return builder.ptrtoint(layout.data, context.get_value_type(types.intp))

    return types.intp(array), generate


@intrinsic
def peek(_typing_context: Any, _address: Any, like: Any) -> Any:
    """Read the number at an address, in the type of another number."""

    def generate(context: Any, builder: Any, _signature: Any, operands: Any) -> Any:
        pointer = builder.inttoptr(operands[0], context.get_value_type(like).as_pointer())
        return builder.load(pointer)

    return like(types.intp, like), generate


@intrinsic
def poke(_typing_context: Any, _address: Any, value: Any) -> Any:
    """Write a number to an address, in its own type."""

    def generate(context: Any, builder: Any, _signature: Any, operands: Any) -> Any:
        pointer = builder.inttoptr(operands[0], context.get_value_type(value).as_pointer())
        builder.store(operands[1], pointer)
        return context.get_dummy_value()

    return types.void(types.intp, value), generate


@intrinsic
def is_fmi_2(_typing_context: Any, component: Any) -> Any:
    """Return whether an instance is of FMI 2.0: a constant for the compiler.

    Its type says so; see `workers.kernels.fmi.component`.
    """
    constant = int(not component.target.instance_class.__name__.endswith("3"))

    def generate(context: Any, _builder: Any, _signature: Any, _operands: Any) -> Any:
        return context.get_constant(types.boolean, constant)

    return types.boolean(component), generate
