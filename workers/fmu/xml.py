"""The XML of a model description, read with care: its variables, types and units.

Harmless faults are corrected.
"""

from __future__ import annotations

import codecs
import math
import re
from dataclasses import dataclass
from typing import Literal
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from workers.errors import ModelError
from workers.fmu.variable import KINDS, Type

XML = "modelDescription.xml"

_MULTIBYTE = ("gb18030", "gbk", "gb2312", "big5", "cp932", "shift_jis", "euc_jp", "cp949", "euc_kr")
"""Encodings that expat cannot read itself, in the names of Python's codecs."""
_DECLARED = re.compile(rb"""<\?xml[^>]*encoding\s*=\s*["']([\w.:-]{1,40})["']""")
_FORBIDDEN = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_BARE_AMPERSAND = re.compile(r"&(?!#?\w{1,20};)")
_END = "</fmiModelDescription>"
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_NOT_FINITE = re.compile(r"[+-]?inf(inity)?|nan", re.IGNORECASE)
_WHOLE = re.compile(r"[+-]?\d{1,20}", re.ASCII)
_SHOWN = 3


class ReadingNotes:
    """Notes on tolerated faults; the same fault of many variables gives one note."""

    def __init__(self, file: str) -> None:
        self.file = file
        self._names: dict[str, list[str]] = {}

    def add(self, what: str, name: str | None = None) -> None:
        """Add a note, and the name of the variable concerned."""
        names = self._names.setdefault(what, [])
        if name is not None:
            names.append(name)

    def messages(self) -> tuple[str, ...]:
        return tuple(f"{self.file}: {what}{_listed(names)}" for what, names in self._names.items())


def _listed(names: list[str]) -> str:
    if not names:
        return ""
    more = len(names) - _SHOWN
    shown = ", ".join(repr(name[:80]) for name in names[:_SHOWN])
    return f": {shown}" + (f" and {more} more" if more > 0 else "")


def parse(file: str, content: bytes, notes: ReadingNotes) -> Element:
    """Return a tree of elements and attributes; text between tags has no meaning in FMI.

    Raises
    ------
    ModelError
        If it is not XML even after correction, or if it declares entities, which may expand to any
        size.
    """
    try:
        return _tree(file, content, None)
    except (expat.ExpatError, LookupError, ValueError) as error:
        first = error
    for codec in _codecs(content):
        try:
            tree = _tree(file, _mended(content.decode(codec)).encode(), "utf-8")
        except (expat.ExpatError, ValueError):
            continue
        notes.add(
            f"its {XML} is not well-formed XML and was corrected; check names that look wrong"
        )
        return tree
    raise ModelError(
        f"{file}: its {XML} must be XML, but cannot be read ({first_line(first)}); export it again"
    ) from first


def _tree(file: str, content: bytes, encoding: str | None) -> Element:
    builder = TreeBuilder()
    parser = expat.ParserCreate(encoding)

    def refuse(*_: object) -> None:
        raise ModelError(
            f"{file}: its {XML} must not declare entities, but does, which is not safe to read; "
            "remove its DOCTYPE, or export it again"
        )

    def start(tag: str, attributes: dict[str, str]) -> None:
        builder.start(tag.rpartition(":")[2], attributes)

    parser.EntityDeclHandler = refuse
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: builder.end(tag.rpartition(":")[2])
    parser.Parse(content, True)
    return builder.close()


def _codecs(content: bytes) -> list[str]:
    """Return encodings to try: the declared one, UTF-8, Windows-1252, Latin-1."""
    declared = _DECLARED.search(content[:200])
    known = []
    if declared:
        try:
            known = [codecs.lookup(declared.group(1).decode("ascii")).name]
        except (LookupError, ValueError):
            known = []
    wide = content[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return [
        *(name for name in known if name in _MULTIBYTE),
        *(["utf-16"] if wide else []),
        *("utf-8-sig", "cp1252", "latin-1"),
    ]


def _mended(text: str) -> str:
    """Remove text before and after the document, and characters that XML forbids."""
    start, end = max(text.find("<"), 0), text.rfind(_END)
    inside = text[start : end + len(_END)] if end >= 0 else text[start:]
    return _BARE_AMPERSAND.sub("&amp;", _FORBIDDEN.sub(" ", inside))


def first_line(error: BaseException) -> str:
    """Return the first line of an error's text, or the name of its type."""
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def number(text: str | None, notes: ReadingNotes, what: str, name: str) -> float | None:
    """Read a floating-point number; return None if it is missing or not finite.

    `what` is the attribute and `name` the variable, for a note about an unreadable number.
    """
    if text is None:
        return None
    plain = text.strip()
    if _NUMBER.fullmatch(plain):
        value = float(plain)
        return value if math.isfinite(value) else None
    if not _NOT_FINITE.fullmatch(plain):
        notes.add(f"attributes {what} that are not numbers are ignored", name)
    return None


def whole(text: str | None) -> int | None:
    """Read an integer; return None if the text is not an integer."""
    plain = (text or "").strip()
    return int(plain) if _WHOLE.fullmatch(plain) else None


def flag(text: str | None) -> bool:
    """Read a Boolean. Some Python tools write "True"."""
    return (text or "").strip().lower() in ("true", "1")


Version = Literal["2.0", "3.0"]

XML_TYPES: dict[Version, dict[str, Type]] = {
    "2.0": {
        "Real": "Float64",
        "Integer": "Int32",
        "Enumeration": "Int32",
        "Boolean": "Boolean",
        "String": "String",
    },
    "3.0": {name: name for name in KINDS},
}
"""Names of types in the XML, and their types."""
NO_ELEMENT = Element("nothing")


@dataclass(frozen=True)
class RawVariable:
    """A variable's own element in the XML, and that of its type (in FMI 3, the same)."""

    own: Element
    value: Element
    tag: str
    key: int
    """Position (FMI 2) or value reference (FMI 3) that other parts of the XML refer to."""
    name: str
    reference: int


def raw_variables(root: Element, version: Version, notes: ReadingNotes) -> list[RawVariable]:
    """Return the usable variables; in FMI 2, the others still count for positions."""
    section = root.find("ModelVariables")
    types = XML_TYPES[version]
    found = []
    if section is None:
        notes.add("it has no <ModelVariables>")
    elements = [] if section is None else list(section)
    if version == "2.0":
        elements = [e for e in elements if e.tag == "ScalarVariable"]
    for position, own in enumerate(elements, start=1):
        value: Element | None = own
        if version == "2.0":
            value = next((child for child in own if child.tag in types), None)
        name, reference = own.get("name"), whole(own.get("valueReference"))
        label = name or f"variable {position}"
        if value is None or value.tag not in types:
            notes.add("variables whose type FMI does not know are left out", label)
        elif not name:
            notes.add("variables without a name are left out", label)
        elif reference is None or not 0 <= reference < 2**32:
            notes.add("variables without a valueReference of at most 32 bits are left out", label)
        else:
            key = position if version == "2.0" else reference
            found.append(RawVariable(own, value, value.tag, key, name, reference))
    return found


def declared_types(root: Element, version: Version) -> dict[str, Element]:
    """Return the element with the attributes of each declared type, by its name."""
    found = {}
    for definition in root.iterfind("TypeDefinitions/*"):
        holds = definition
        if version == "2.0":
            holds = next(
                (child for child in definition if child.tag in XML_TYPES[version]), NO_ELEMENT
            )
        found[definition.get("name", "")] = holds
    return found


BASE_UNITS = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""The base units, in the order of the powers of a definition."""


@dataclass(frozen=True)
class UnitDefinition:
    """A unit as defined by the FMU, by powers of the SI base units and the radian.

    Attributes
    ----------
    powers
        In the order of `BASE_UNITS`.
    offset
        Offset of its zero in the base unit: 273.15 for degrees Celsius.
    """

    powers: tuple[int, ...]
    offset: float = 0.0


def read_units(root: Element, notes: ReadingNotes) -> dict[str, UnitDefinition]:
    """Read the units with a definition in base units, by name; the others are only names."""
    found: dict[str, UnitDefinition] = {}
    for unit in root.findall("UnitDefinitions/Unit"):
        name, base = unit.get("name"), unit.find("BaseUnit")
        if not name or base is None:
            continue
        powers = [whole(base.get(key, "0")) for key in BASE_UNITS]
        offset = number(base.get("offset"), notes, "offset", name)
        if None in powers:
            notes.add("units with powers that are not integers are used only as names", name)
            continue
        found.setdefault(name, UnitDefinition(tuple(p or 0 for p in powers), offset or 0.0))
    return found
