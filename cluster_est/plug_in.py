"""What is asked of every class that somebody adds: a method, a cost, an executor."""

from __future__ import annotations

from inspect import get_annotations


def check_class_attributes(derived: type) -> None:
    """Refuse a class that sets a `ClassVar` of its base as if it were one of its options.

    Without `ClassVar` a dataclass takes `name: str = "fair"` for a field: an option that a config
    could change, and that comes before the options without a default.

    Parameters
    ----------
    derived
        A class that is being made, as `__init_subclass__` is given it.

    Raises
    ------
    TypeError
        With the line to write, when the class is imported.
    """
    declared = {
        name: annotation
        for base in derived.__mro__[1:]
        for name, annotation in get_annotations(base).items()
        if "ClassVar" in str(annotation)
    }
    for name, annotation in get_annotations(derived).items():
        if name in declared and "ClassVar" not in str(annotation):
            raise TypeError(
                f"{derived.__module__}.{derived.__qualname__}.{name}: must be declared for the "
                f"class but is an option; write {name}: {declared[name]}"
            )
