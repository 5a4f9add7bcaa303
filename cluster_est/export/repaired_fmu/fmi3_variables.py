"""Variables of FMI 3.0 as those of FMI 2.0: fewer types, and elements in place of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable, Type

_SAME: tuple[Type, ...] = ("Float64", "Int32", "Boolean", "String")
"""Types that FMI 2.0 has under another name."""
_LEAST, _MOST = -(2.0**31), 2.0**31 - 1.0
"""Of the integers of FMI 2.0."""


@dataclass(frozen=True)
class TranslatedVariable:
    """A variable of the original that FMI 2.0 knows otherwise.

    Attributes
    ----------
    first, size
        References of its elements in the exported FMU: so many from the first on.
    type, reference
        In the original.
    starts
        Start values of the elements of an array that can be set, () for others.
    """

    first: int
    size: int
    type: Type
    reference: int
    starts: tuple[float, ...]


@dataclass(frozen=True)
class FlatDescription:
    """A description in which each variable is one of FMI 2.0.

    Attributes
    ----------
    description
        With references of the exported FMU.
    translated
        In the order of their first references.
    left_out
        Names of variables that FMI 2.0 cannot express.
    """

    description: ModelDescription
    translated: tuple[TranslatedVariable, ...] = ()
    left_out: tuple[str, ...] = ()


def flatten(description: ModelDescription, structure: Mapping[str, int]) -> FlatDescription:
    """Give each element of an array a reference, and leave out what FMI 2.0 has no type for.

    A description of FMI 2.0 stays as it is.

    Parameters
    ----------
    structure
        Values of structural parameters that differ from their start values.
    """
    if description.version == "2.0":
        return FlatDescription(description)
    groups: dict[int, list[ModelVariable]] = {}
    for variable in description.variables.values():
        groups.setdefault(variable.reference, []).append(variable)
    free = 1 + max(groups, default=0)
    kept: dict[str, ModelVariable] = {}
    translated, left_out = [], list[str]()
    for reference, group in groups.items():
        own = [v for v in group if v.alias_of is None]
        if not _expressible(own):
            left_out += [v.name for v in group]
            continue
        one = own[0]
        first = reference if one.size == 1 else free
        free += one.size if one.size > 1 else 0
        if one.size > 1 or one.type not in _SAME:
            starts = tuple(v.start or 0.0 for v in own) if one.size > 1 and one.settable else ()
            translated.append(TranslatedVariable(first, one.size, one.type, reference, starts))
        for v in group:
            start = structure.get(v.name, v.start)
            kept[v.name] = replace(v, reference=first + v.element, start=start)
    ordered = {name: kept[name] for name in description.variables if name in kept}
    translated.sort(key=lambda each: each.first)
    return FlatDescription(
        replace(description, variables=ordered), tuple(translated), tuple(left_out)
    )


def _expressible(elements: list[ModelVariable]) -> bool:
    """Return whether FMI 2.0 can express it, as far as its start values show."""
    kind, size = elements[0].kind, elements[0].size
    if kind == "integer":
        return all(_LEAST <= (v.start or 0.0) <= _MOST for v in elements)
    return kind in ("real", "boolean") or (kind == "string" and size == 1)


def fits(limit: float | None) -> bool:
    """Return whether a limit of integers is one of FMI 2.0."""
    return limit is not None and _LEAST <= limit <= _MOST
