"""FMUs with a spoiled description or a spoiled archive. Their native code is never touched."""

from __future__ import annotations

import functools
import io
import stat
import warnings
import zipfile
from collections.abc import Callable
from xml.etree import ElementTree

from hypothesis import strategies as st

from fuzzing.base import COMMANDS, CONFIGS, Input, damaged

XML = "modelDescription.xml"
CONFIG = b"""
model.fmu = "x.fmu"
parameters.m = { start = 1.0, bounds = [0.1, 10.0] }
parameters.k = { start = 25.0, bounds = [1.0, 200.0], scale = "log" }
values.c = 0.6

[[experiments]]
id = "a"
data = "a.csv"
time = "time"
inputs.F = "force"
outputs.y = "position"
"""
ROWS = b"time,force,position\n0,1,0\n0.1,1,0.01\n0.2,0,0.02\n0.3,0,0.01\n"
_TEXTS = [
    "", "0", "-1", "1", "2", "3", "99", "4294967295", "4294967296", "9" * 400, "1.5", "1e999",
    "nan", "inf", "-inf", "true", "yes", "x", "m", "der(x)", "y", "a" * 70000, "../x", "/", ".",
    "input", "output", "parameter", "local", "independent", "calculatedParameter", "constant",
    "fixed", "tunable", "discrete", "continuous", "exact", "approx", "calculated", "kg", "%s",
]  # fmt: skip
TEXTS = st.one_of(
    st.text(st.characters(min_codepoint=32, max_codepoint=0x2FFF), max_size=4),
    st.sampled_from(_TEXTS),
)
TAGS = ["Real", "Integer", "Boolean", "String", "Enumeration", "Unknown", "ScalarVariable", "x"]
BOMB = b"<!DOCTYPE a [<!ENTITY b '" + b"b" * 1000 + b"'>" + b"".join(
    b"<!ENTITY %c '%s'>" % (c, b"&%c;" % (c - 1) * 30) for c in range(ord("c"), ord("k"))
) + b"]>"  # fmt: skip
DOCTYPES = [
    BOMB, b"<!DOCTYPE a SYSTEM 'file:///no/such.dtd'>", b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///']>",
    b"<!DOCTYPE a [<!ENTITY k '&k;'>]>", b"<!DOCTYPE a [",
]  # fmt: skip
PATHS = [
    "../x", "/x", "a/../../x", "C:\\x", "..\\x", "binaries", "binaries/linux64", XML + "/x",
    "a" * 300, "x\x00y", "", "/", ".", "resources/\n", XML, "con", "~",
    "binaries/linux64/mass_spring_damper.so/x",
]  # fmt: skip
BIG = bytes(70 * 2**20)


@functools.cache
def _entries() -> dict[str, bytes]:
    with zipfile.ZipFile(CONFIGS / "models" / "mass_spring_damper.fmu") as opened:
        names = [n for n in opened.namelist() if n == XML or "linux64/" in n]
        return {name: opened.read(name) for name in names}


@functools.cache
def _bomb() -> bytes:
    """A large entry that packs well, written once."""
    return _packed({**_entries(), "resources/zeros": BIG})


def _packed(entries: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method, compresslevel=1) as archive:
        for name, content in entries.items():
            info = zipfile.ZipInfo(name)
            info.compress_type = method
            with archive.open(info, "w") as entry:  # allows any name
                entry.write(content)
    return packed.getvalue()


@st.composite
def descriptions(draw: st.DrawFn) -> Input:
    """An FMU whose description was spoiled in up to three places."""
    root = ElementTree.fromstring(_entries()[XML])
    for _ in range(draw(st.integers(1, 3))):
        _spoil(draw, root)
    content = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    if draw(st.integers(0, 4)) == 0:
        content = _damaged_text(draw, content)
    return _input(draw, "description", _packed({**_entries(), XML: content}, zipfile.ZIP_STORED))


@st.composite
def archives(draw: st.DrawFn) -> Input:
    """An FMU whose zip file was spoiled."""
    hows: dict[str, Callable[[st.DrawFn], bytes]] = {
        "entries": _other_entries,
        "link": _link,
        "bomb": lambda draw: _bomb(),
    }
    how = draw(st.sampled_from(["bytes", "bytes", "entries", "entries", "entries", "link", "bomb"]))
    if how == "bytes":
        content = damaged(draw, _packed(_entries(), draw(st.sampled_from([0, 8, 12, 14]))))
    else:
        content = hows[how](draw)
    return _input(draw, "archive", content)


def _input(draw: st.DrawFn, kind: str, content: bytes) -> Input:
    files = (("config.toml", CONFIG), ("a.csv", ROWS), ("x.fmu", content))
    arguments = draw(COMMANDS)
    if draw(st.booleans()):
        arguments = (*arguments, "model.interface=co_simulation")
    return Input(kind, arguments, files)


def _spoil(draw: st.DrawFn, root: ElementTree.Element) -> None:
    parents = [element for element in root.iter() if len(element)]
    parent = draw(st.sampled_from(parents))
    at = draw(st.integers(0, len(parent) - 1))
    # the root as often as all that is in it
    element = root if draw(st.integers(0, 9)) == 0 else parent[at]
    action = draw(st.sampled_from(["drop", "repeat", "tag", "deep", *["attribute"] * 8]))
    if action == "drop":
        parent.remove(parent[at])
    elif action == "repeat":
        parent.append(parent[at])
    elif action == "tag":
        element.tag = draw(st.sampled_from(TAGS))
    elif action == "deep":
        for _ in range(draw(st.sampled_from([2, 300]))):
            element = ElementTree.SubElement(element, "x")
    else:
        _spoil_attribute(draw, element)


def _spoil_attribute(draw: st.DrawFn, element: ElementTree.Element) -> None:
    names = [
        *element.attrib,
        "derivative",
        "start",
        "min",
        "max",
        "nominal",
        "declaredType",
        "initial",
    ]
    name = draw(st.sampled_from(names))
    how = draw(st.sampled_from(["drop", "rename", "value", "value", "value"]))
    if how == "value":
        element.set(name, draw(TEXTS))
    else:
        value = element.attrib.pop(name, "")
        if how == "rename":
            element.set(name + "s", value)


def _damaged_text(draw: st.DrawFn, content: bytes) -> bytes:
    how = draw(st.sampled_from(["bytes", "doctype", "encoding", "declaration"]))
    first, _, rest = content.partition(b"\n")
    if how == "bytes":
        return damaged(draw, content)
    if how == "doctype":
        named = rest.replace(b'unit="kg"', b'unit="&j;"') if draw(st.booleans()) else rest
        return first + draw(st.sampled_from(DOCTYPES)) + named
    if how == "encoding":
        codec = draw(st.sampled_from(["utf-16", "utf-32", "cp037", "utf-7"]))
        return rest.decode().encode(codec, "xmlcharrefreplace")
    names = [
        b"utf-16",
        b"no-such",
        b"latin-1",
        b"",
        b"utf-7",
        b"idna",
        b"rot13",
        b"base64",
        b"punycode",
    ]
    return b"<?xml version='1.0' encoding='" + draw(st.sampled_from(names)) + b"'?>" + rest


def _other_entries(draw: st.DrawFn) -> bytes:
    """Entries dropped, renamed, added or there twice."""
    entries = dict(_entries())
    name = draw(st.sampled_from(sorted(entries)))
    how = draw(st.sampled_from(["drop", "rename", "add", "add", "empty", "repeat"]))
    if how == "drop":
        del entries[name]
    elif how == "rename":
        entries[draw(st.sampled_from(PATHS))] = entries.pop(name)
    elif how == "add":
        entries[draw(st.sampled_from(PATHS))] = b"x"
    elif how == "empty":
        entries[name] = b""
    packed = io.BytesIO(_packed(entries))
    if how == "repeat":
        with zipfile.ZipFile(packed, "a") as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            archive.writestr(name, entries[name])
    return packed.getvalue()


def _link(draw: st.DrawFn) -> bytes:
    packed = io.BytesIO(_packed(_entries()))
    kind = draw(st.sampled_from([stat.S_IFLNK, stat.S_IFIFO, stat.S_IFBLK, stat.S_IFDIR]))
    with zipfile.ZipFile(packed, "a") as archive:
        entry = zipfile.ZipInfo(draw(st.sampled_from(["resources/link", "binaries/linux64/l.so"])))
        entry.external_attr = (kind | 0o777) << 16
        archive.writestr(
            entry, draw(st.sampled_from(["/etc", "../../..", "mass_spring_damper.so"]))
        )
    return packed.getvalue()
