"""The <ModelVariables> of a model description of FMI 2 or 3."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from xml.etree.ElementTree import Element

from workers.fmu.variable import KINDS, ModelVariable
from workers.fmu.xml import (
    NO_ELEMENT,
    XML_TYPES,
    RawVariable,
    ReadingNotes,
    Version,
    declared_types,
    flag,
    number,
    raw_variables,
    whole,
)

MAX_ELEMENTS = 1_000_000
"""Largest number of elements of all arrays together; further arrays are left out."""


class ArraySizes:
    """The dimensions of arrays, which are numbers or structural parameters."""

    def __init__(self, raws: list[RawVariable], structural: Mapping[str, int]) -> None:
        self._left = MAX_ELEMENTS
        self._known: dict[int, int] = {}
        for raw in raws:
            start = whole(raw.value.get("start"))
            given = structural.get(raw.name, start)
            if given is not None:
                self._known.setdefault(raw.reference, given)

    def shape(self, raw: RawVariable, notes: ReadingNotes) -> tuple[int, ...] | None:
        """Return the shape, () for a scalar; None, with a note, for an array to be left out."""
        sizes: list[int] = []
        for dimension in raw.own.findall("Dimension"):
            size = whole(dimension.get("start"))
            if size is None:
                size = self._known.get(_reference(dimension))
            if size is None or size < 0:
                notes.add("arrays of unknown size are left out", raw.name)
                return None
            sizes.append(size)
        if sizes:
            self._left -= math.prod(sizes)
        if sizes and self._left < 0:
            self._left += math.prod(sizes)
            notes.add(f"arrays are left out after {MAX_ELEMENTS} elements in all", raw.name)
            return None
        return tuple(sizes)


def _reference(element: Element) -> int:
    found = whole(element.get("valueReference"))
    return -1 if found is None else found


def elements_of(
    raw: RawVariable, scalar: ModelVariable, shape: tuple[int, ...], notes: ReadingNotes
) -> tuple[ModelVariable, ...]:
    """Return a variable for each element, with its start value."""
    texts = [] if scalar.kind in ("string", "binary", "clock") else _starts(raw, shape)
    starts: list[float | None] = [_start(text, scalar, notes) for text in texts]
    if not shape:
        return (replace(scalar, start=starts[0]) if starts else scalar,)
    size = math.prod(shape)
    if len(starts) not in (0, 1, size):
        notes.add(
            "start values are ignored if their number differs from that of the array's elements",
            raw.name,
        )
    if len(starts) != size:
        starts = [starts[0] if len(starts) == 1 else None] * size
    places = product(*(range(1, n + 1) for n in shape))
    return tuple(
        replace(
            scalar,
            name=f"{raw.name}[{','.join(map(str, place))}]",
            start=starts[i],
            shape=shape,
            element=i,
            size=size,
        )
        for i, place in enumerate(places)
    )


def _starts(raw: RawVariable, shape: tuple[int, ...]) -> list[str]:
    text = raw.value.get("start")
    if text is None:
        return []
    return text.split() if shape else [text]


def _start(text: str, scalar: ModelVariable, notes: ReadingNotes) -> float | None:
    if scalar.kind == "boolean" and text.strip().lower() in ("true", "false"):
        return float(flag(text))
    return number(text, notes, "start", scalar.name)


def renamed(elements: tuple[ModelVariable, ...], name: str) -> list[ModelVariable]:
    """Return the elements of a variable under another name, as aliases."""
    return [
        replace(v, name=name + v.name[v.name.rindex("[") :] if v.shape else name, alias_of=v.name)
        for v in elements
    ]


_CAUSALITIES = (
    "parameter", "calculatedParameter", "input", "output", "local", "independent",
    "structuralParameter",
)  # fmt: skip
_VARIABILITIES = ("constant", "fixed", "tunable", "discrete", "continuous")
_INITIALS = ("exact", "approx", "calculated")


@dataclass(frozen=True)
class DeclaredVariables:
    """All variables, and their names by the keys that the model description uses.

    Attributes
    ----------
    variables
        By name, with array elements and aliases as separate entries, in the order of the
        description.
    names_by_key
        Position of a variable (FMI 2, from 1) or value reference (FMI 3) -> names of its elements.
    """

    variables: dict[str, ModelVariable]
    names_by_key: dict[int, tuple[str, ...]]


def read_variables(
    root: Element, version: Version, structural: Mapping[str, int], notes: ReadingNotes
) -> DeclaredVariables:
    """Read all variables; those without a name, a type or a value reference are left out.

    Parameters
    ----------
    structural
        Values of structural parameters that differ from their start values.
    notes
        Receives notes on faults.
    """
    raws = raw_variables(root, version, notes)
    types = declared_types(root, version)
    sizes = ArraySizes(raws, structural)
    found: dict[str, ModelVariable] = {}
    names_by_key: dict[int, tuple[str, ...]] = {}
    for raw in raws:
        scalar = _scalar(raw, version, types, notes)
        shape = sizes.shape(raw, notes)
        if shape is None:
            continue
        elements = elements_of(raw, scalar, shape, notes)
        aliases = [a.get("name", "") for a in raw.own.findall("Alias")]
        names_by_key.setdefault(raw.key, tuple(v.name for v in elements))
        for variable in (*elements, *(a for n in aliases if n for a in renamed(elements, n))):
            if found.setdefault(variable.name, variable) is not variable:
                notes.add(
                    "a name that occurs twice refers to the first variable of that name",
                    variable.name,
                )
    _add_derivatives(raws, found, names_by_key, notes)
    _add_aliases(found, version)
    return DeclaredVariables(found, names_by_key)


def _scalar(
    raw: RawVariable, version: Version, types: Mapping[str, Element], notes: ReadingNotes
) -> ModelVariable:
    """Return the variable as a scalar and without a start value."""
    own, value, name = raw.own, raw.value, raw.name
    kind = KINDS[XML_TYPES[version][raw.tag]]
    wanted = value.get("declaredType")
    declared = types.get(wanted or "", NO_ELEMENT)
    if wanted and declared is NO_ELEMENT:
        notes.add("types that are not declared anywhere are ignored", name)

    def attribute(key: str) -> str | None:
        return value.get(key, declared.get(key))

    def limit(key: str) -> float | None:
        return number(attribute(key), notes, key, name)

    causality = _one_of(own, "causality", _CAUSALITIES, notes) or "local"
    variability = _one_of(own, "variability", _VARIABILITIES, notes)
    if variability is None and causality in (
        "parameter",
        "calculatedParameter",
        "structuralParameter",
    ):
        variability = "fixed"
    variability = variability or ("continuous" if kind == "real" else "discrete")
    low, high = _ordered(limit("min"), limit("max"), name, notes)
    nominal = limit("nominal")
    if attribute("nominal") is not None and not nominal:
        notes.add("a nominal value that is 0 or not a number counts as 1", name)
    return ModelVariable(
        name=name,
        reference=raw.reference,
        kind=kind,
        causality=causality,
        settable=_settable(own, value, causality, variability, notes),
        tunable=causality == "parameter" and variability == "tunable",
        unit=attribute("unit") or "",
        low=low,
        high=high,
        nominal=abs(nominal or 1.0),
        type=XML_TYPES[version][raw.tag],
        variability=variability,
        description=" ".join((own.get("description") or "").split()),
    )


def _ordered(
    low: float | None, high: float | None, name: str, notes: ReadingNotes
) -> tuple[float | None, float | None]:
    if low is not None and high is not None and low > high:
        notes.add("min and max are ignored if min is above max", name)
        return None, None
    return low, high


def _one_of(own: Element, key: str, known: tuple[str, ...], notes: ReadingNotes) -> str | None:
    text = own.get(key)
    if text is None or text in known:
        return text
    notes.add(f"attributes {key}, which FMI does not know, are ignored", own.get("name"))
    return None


def _settable(
    own: Element, value: Element, causality: str, variability: str, notes: ReadingNotes
) -> bool:
    """Return whether FMI allows a start value to be set before initialisation."""
    initial = _one_of(own, "initial", _INITIALS, notes)
    if variability == "constant" or causality in ("calculatedParameter", "independent"):
        return False
    if causality in ("parameter", "structuralParameter", "input"):
        return True
    return initial in ("exact", "approx") or (initial is None and value.get("start") is not None)


def _add_derivatives(
    raws: list[RawVariable],
    found: dict[str, ModelVariable],
    names_by_key: Mapping[int, tuple[str, ...]],
    notes: ReadingNotes,
) -> None:
    for raw in raws:
        text = raw.value.get("derivative")
        if text is None or raw.key not in names_by_key:
            continue
        key = whole(text)
        states = names_by_key.get(key, ()) if key is not None else ()
        rates = names_by_key[raw.key]
        if len(states) != len(rates):
            notes.add(
                "attributes derivative are ignored if they do not name a suitable variable",
                raw.name,
            )
            continue
        for rate, state in zip(rates, states, strict=True):
            found[rate] = replace(found[rate], derivative_of=state)


def _add_aliases(found: dict[str, ModelVariable], version: Version) -> None:
    """Add the names that share a value. In FMI 2, each type has its own value references."""
    names_by_value: dict[tuple[str, int, int], list[str]] = {}
    for v in found.values():
        family = v.type if version == "2.0" else ""
        names_by_value.setdefault((family, v.reference, v.element), []).append(v.name)
    for names in names_by_value.values():
        if len(names) > 1:
            aliases = tuple(names)  # one shared tuple, because thousands may alias a constant
            for name in names:
                found[name] = replace(found[name], aliases=aliases)
