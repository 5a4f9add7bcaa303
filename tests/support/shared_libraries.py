"""What a shared library is for, what it needs and what it offers, from its bytes.

ELF by pyelftools; PE and Mach-O by their published layouts (Microsoft's PE format; Apple's
mach-o/loader.h).
"""

from __future__ import annotations

import hashlib
import io
import struct
from dataclasses import dataclass
from typing import Any

from elftools.elf.elffile import ELFFile

MACHINES = {0x8664: "x86_64", 0x01000007: "x86_64", 0x0100000C: "aarch64"}
LC_SYMTAB, LC_LOAD_DYLIB, LC_ID_DYLIB, LC_CODE_SIGNATURE, LC_BUILD_VERSION = 2, 12, 13, 29, 50


@dataclass(frozen=True)
class SharedLibrary:
    """`platform` in FMI 3.0's names; `system`: the oldest one that it runs on, where that is in it;
    `name`: what those that link to it look for; `is_signed`: with the right hash of each page,
    without which macOS ends a process on Apple silicon."""

    platform: str
    needs: frozenset[str]
    exports: frozenset[str]
    system: tuple[int, ...] = ()
    name: str = ""
    is_signed: bool = False


def read_library(content: bytes) -> SharedLibrary:
    if content[:4] == b"\x7fELF":
        return _elf(content)
    return _pe(content) if content[:2] == b"MZ" else _mach_o(content)


def _elf(content):
    elf: Any = ELFFile(io.BytesIO(content))
    machine = {"EM_X86_64": "x86_64", "EM_AARCH64": "aarch64"}[elf["e_machine"]]
    versions, exports = set(), set()
    for _, auxiliaries in elf.get_section_by_name(".gnu.version_r").iter_versions():
        for auxiliary in auxiliaries:
            system, _, number = auxiliary.name.partition("_")
            assert system == "GLIBC"
            versions.add(tuple(map(int, number.split("."))))
    for symbol in elf.get_section_by_name(".dynsym").iter_symbols():
        if symbol["st_shndx"] != "SHN_UNDEF" and symbol["st_info"]["bind"] == "STB_GLOBAL":
            exports.add(symbol.name)
    tags = elf.get_section_by_name(".dynamic").iter_tags()
    needs = {tag.needed for tag in tags if tag.entry.d_tag == "DT_NEEDED"}
    return SharedLibrary(f"{machine}-linux", frozenset(needs), frozenset(exports), max(versions))


def _pe(content):
    (header,) = struct.unpack_from("<I", content, 60)
    assert content[header : header + 4] == b"PE\0\0"
    machine, n_sections, _, _, _, n_optional = struct.unpack_from("<HHIIIH", content, header + 4)
    optional = header + 24
    assert struct.unpack_from("<H", content, optional) == (0x20B,)  # 64 bits
    directories = optional + 112
    sections = [
        struct.unpack_from("<8xIIII", content, optional + n_optional + 40 * i)
        for i in range(n_sections)
    ]

    def at(address):
        """The place in the file of an address in memory."""
        for size, start, _, place in sections:
            if start <= address < start + size:
                return place + address - start
        raise AssertionError(address)

    def text(address):
        return content[at(address) :].split(b"\0", 1)[0].decode()

    exported, _, imported = struct.unpack_from("<III", content, directories)
    n_names, _, names = struct.unpack_from("<III", content, at(exported) + 24)
    addresses = struct.unpack_from(f"<{n_names}I", content, at(names))
    needs, place = set(), at(imported)
    while (name := struct.unpack_from("<12xI", content, place)[0]) != 0:
        needs.add(text(name))
        place += 20
    exports = frozenset(map(text, addresses))
    return SharedLibrary(f"{MACHINES[machine]}-windows", frozenset(needs), exports)


def _mach_o(content):
    magic, machine, _, _, n_commands, _ = struct.unpack_from("<6I", content)
    assert magic == 0xFEEDFACF
    needs, exports, own, is_signed = set(), set(), "", False
    system: tuple[int, ...] = ()
    place = 32
    for _ in range(n_commands):
        command, size, first, second = struct.unpack_from("<4I", content, place)
        if command in (LC_LOAD_DYLIB, LC_ID_DYLIB):
            name = content[place + first : place + size].split(b"\0", 1)[0].decode()
            needs |= {name} if command == LC_LOAD_DYLIB else set()
            own = name if command == LC_ID_DYLIB else own
        elif command == LC_SYMTAB:
            (texts,) = struct.unpack_from("<I", content, place + 16)
            for i in range(second):
                index, kind, section, _, _ = struct.unpack_from("<IBBHQ", content, first + 16 * i)
                if kind & 0x11 == 1 and section:  # external, not private, and defined here
                    name = content[texts + index :].split(b"\0", 1)[0].decode()
                    exports.add(name.removeprefix("_"))
        elif command == LC_BUILD_VERSION:
            system = (second >> 16, second >> 8 & 255)
        elif command == LC_CODE_SIGNATURE:
            is_signed = _has_valid_signature(content, content[first : first + second])
        place += size
    platform = f"{MACHINES[machine]}-darwin"
    return SharedLibrary(platform, frozenset(needs), frozenset(exports), system, own, is_signed)


def _has_valid_signature(content, blobs):
    magic, _, n_blobs = struct.unpack_from(">III", blobs)
    assert magic == 0xFADE0CC0
    for i in range(n_blobs):
        _, place = struct.unpack_from(">II", blobs, 12 + 8 * i)
        if struct.unpack_from(">I", blobs, place) == (0xFADE0C02,):  # the directory of hashes
            hashes, _, _, n_pages, end = struct.unpack_from(">5I", blobs, place + 16)
            n, kind, _, log_page = struct.unpack_from(">4B", blobs, place + 36)
            assert kind == 2  # SHA-256
            pages = [content[p : min(p + 2**log_page, end)] for p in range(0, end, 2**log_page)]
            found = b"".join(hashlib.sha256(page).digest() for page in pages)
            return found == blobs[place + hashes : place + hashes + n * n_pages]
    return False
