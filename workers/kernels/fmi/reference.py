"""Named tuples that compiled functions hand on by their address, as C hands on structures.

numba hands a tuple on as all the fields of all its arrays: over two hundred numbers for what a loop
needs, which every function takes apart and puts together again. To compile that took most of the
time of compiling a loop, and to do it at each call a tenth of the time of a short simulation.
"""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    infer_getattr,
    intrinsic,
    lower_getattr_generic,
    models,
    register_model,
)


class Reference(types.Type):
    """The type of the address of a named tuple, whose fields are read as those of the tuple are."""

    def __init__(self, target: Any) -> None:
        self.target = target
        super().__init__(name=f"reference({target})")

    def field(self, name: str) -> Any:
        """Return the type of a field: that of a nested tuple is a reference to it, too."""
        field = self.target.types[self.target.fields.index(name)]
        return Reference(field) if _is_named_tuple(field) else field


def _is_named_tuple(candidate: Any) -> bool:
    return isinstance(candidate, types.containers.BaseNamedTuple)


@register_model(Reference)
class _ReferenceModel(models.PrimitiveModel):
    def __init__(self, manager: Any, reference: Any) -> None:
        target = manager.lookup(reference.target).get_value_type()
        super().__init__(manager, reference, target.as_pointer())


@infer_getattr
class _ReferenceFields(AttributeTemplate):
    key = Reference

    def generic_resolve(self, reference: Any, name: str) -> Any:
        return reference.field(name) if name in reference.target.fields else None


@lower_getattr_generic(Reference)
def _field(_context: Any, builder: Any, reference: Any, address: Any, name: str) -> Any:
    field = cgutils.gep_inbounds(builder, address, 0, reference.target.fields.index(name))
    return field if isinstance(reference.field(name), Reference) else builder.load(field)


@intrinsic
def by_reference(_typing_context: Any, tuples: Any) -> Any:
    """Return references to copies of named tuples, which lie on the caller's stack.

    They must not be used any more once the caller has returned; what is no named tuple is returned
    as it is.
    """
    wanted = [Reference(one) if _is_named_tuple(one) else one for one in tuples]

    def generate(context: Any, builder: Any, signature: Any, operands: Any) -> Any:
        values = cgutils.unpack_tuple(builder, operands[0])
        copies = [
            cgutils.alloca_once_value(builder, value) if _is_named_tuple(one) else value
            for one, value in zip(tuples, values, strict=True)
        ]
        return context.make_tuple(builder, signature.return_type, copies)

    return types.containers.Tuple(wanted)(tuples), generate
