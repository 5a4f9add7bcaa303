"""Array variables of FMI 3: their shapes, and one variable for each element."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from xml.etree.ElementTree import Element

from workers.fmu.parsing.elements import RawVariable
from workers.fmu.parsing.xml import ReadingNotes, flag, number, whole
from workers.fmu.variable import ModelVariable

MAX_ELEMENTS = 1_000_000
"""Elements of all arrays together. What is beyond has no names."""


class ArraySizes:
    """The dimensions of arrays, which may be numbers or structural parameters."""

    def __init__(self, raws: list[RawVariable], structural: Mapping[str, int]) -> None:
        self._left = MAX_ELEMENTS
        self._known: dict[int, int] = {}
        for raw in raws:
            start = whole(raw.value.get("start"))
            given = structural.get(raw.name, start)
            if given is not None:
                self._known.setdefault(raw.reference, given)

    def shape(self, raw: RawVariable, notes: ReadingNotes) -> tuple[int, ...] | None:
        """Return its shape, () for a scalar; None, with a note, for an array to be left out."""
        sizes: list[int] = []
        for dimension in raw.own.findall("Dimension"):
            size = whole(dimension.get("start"))
            if size is None:
                size = self._known.get(_reference(dimension))
            if size is None or size < 0:
                notes.add("arrays whose size cannot be found are left out", raw.name)
                return None
            sizes.append(size)
        if sizes:
            self._left -= math.prod(sizes)
        if sizes and self._left < 0:
            self._left += math.prod(sizes)
            notes.add(f"arrays beyond {MAX_ELEMENTS} elements in all are left out", raw.name)
            return None
        return tuple(sizes)


def _reference(element: Element) -> int:
    found = whole(element.get("valueReference"))
    return -1 if found is None else found


def elements_of(
    raw: RawVariable, scalar: ModelVariable, shape: tuple[int, ...], notes: ReadingNotes
) -> tuple[ModelVariable, ...]:
    """Return one variable for each element, with its start value."""
    texts = [] if scalar.kind in ("string", "binary", "clock") else _starts(raw, shape)
    starts: list[float | None] = [_start(text, scalar, notes) for text in texts]
    if not shape:
        return (replace(scalar, start=starts[0]) if starts else scalar,)
    size = math.prod(shape)
    if len(starts) not in (0, 1, size):
        notes.add("start values that are not as many as the array's elements are ignored", raw.name)
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
