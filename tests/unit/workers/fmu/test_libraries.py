"""Libraries that an FMU needs and this machine lacks, read from files made here byte by byte."""

import platform
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.spoiled import FMU, LIBRARY

from workers.fmu.binary_dependencies import is_about_licence, load_failure, missing_libraries

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ELF is Linux's")

MACHINE = {"x86_64": 62, "aarch64": 183}[platform.machine()]


def elf(*needed: str, runpath: str = "", machine: int = MACHINE, wide: bool = True) -> bytes:
    """A library of the ELF format that holds nothing but what it needs."""
    names = b"\0"
    entries = []
    for tag, text in [*((1, name) for name in needed), *([(29, runpath)] if runpath else [])]:
        entries.append((tag, len(names)))
        names += text.encode() + b"\0"
    header, segment, entry = (64, 56, "QQ") if wide else (52, 32, "II")
    at = header + 2 * segment
    size = (len(entries) + 2) * struct.calcsize(entry)
    entries += [(5, 0x1000 + at + size), (0, 0)]  # addresses are 0x1000 above offsets
    length = at + size + len(names)

    def program(kind: int, offset: int, long: int) -> bytes:
        if wide:
            return struct.pack("<IIQQQQQQ", kind, 4, offset, 0x1000 + offset, 0, long, long, 8)
        return struct.pack("<IIIIIIII", kind, offset, 0x1000 + offset, 0, long, long, 4, 8)

    start = b"\x7fELF" + bytes([2 if wide else 1, 1, 1]) + bytes(9)
    layout = "<HHIQQQIHHHHHH" if wide else "<HHIIIIIHHHHHH"
    start += struct.pack(layout, 3, machine, 1, 0, header, 0, 0, header, segment, 2, 0, 0, 0)
    table = b"".join(struct.pack("<" + entry, *each) for each in entries)
    return start + program(1, 0, length) + program(2, at, size) + table + names


@pytest.fixture
def library(tmp_path):
    def write(content: bytes, name: str = "m.so") -> Path:
        (tmp_path / name).write_bytes(content)
        return tmp_path / name

    return write


def test_an_fmu_that_loads_lacks_nothing(tmp_path):
    with zipfile.ZipFile(FMU) as opened:
        path = Path(opened.extract(LIBRARY, tmp_path))
    assert missing_libraries(path) == ()
    assert load_failure(path) is None


def test_the_interpreter_lacks_nothing_that_the_loader_finds():
    listed = subprocess.run(["ldd", sys.executable], capture_output=True, text=True, check=False)
    if listed.returncode or "not found" in listed.stdout:
        pytest.skip("no ldd, or it finds something missing")
    assert missing_libraries(Path(sys.executable)) == ()


@pytest.mark.parametrize("wide", [True, False])
def test_what_is_missing_is_named(library, wide):
    path = library(elf("libc.so.6", "libno-such.so.3", "libnone.so.1", wide=wide))
    assert missing_libraries(path) == ("libno-such.so.3", "libnone.so.1")


def test_a_missing_library_is_a_sentence(library):
    assert load_failure(library(elf("libno-such.so.3"))) == (
        "it needs the shared library libno-such.so.3, which this machine lacks; install it"
    )
    assert load_failure(library(elf("libnone.so.1", "libno-such.so.3"))) == (
        "it needs the shared libraries libno-such.so.3 and libnone.so.1, which this machine "
        "lacks; install them"
    )


def test_a_library_beside_it_counts_if_it_is_looked_for_there(library):
    library(elf("libdeep.so"), "libbeside.so")
    assert missing_libraries(library(elf("libbeside.so", runpath="$ORIGIN"))) == ("libdeep.so",)
    path = library(elf("libbeside.so"))
    assert missing_libraries(path) == ("libbeside.so",)
    assert (
        "which are in the library's folder, where the system does not look; set LD_LIBRARY_PATH to"
        in (load_failure(path) or "")
    )


def test_the_users_folders_are_looked_in(library, tmp_path, monkeypatch):
    library(elf(), "libbeside.so")
    monkeypatch.setenv("LD_LIBRARY_PATH", f":{tmp_path}")
    assert missing_libraries(library(elf("libbeside.so"))) == ()


def test_libraries_that_need_each_other_end(library):
    library(elf("m.so", runpath="$ORIGIN"), "libother.so")
    assert missing_libraries(library(elf("libother.so", runpath="${ORIGIN}"))) == ()


def test_a_library_for_other_processors(library):
    said = load_failure(library(elf(machine=243))) or ""
    assert "is for riscv64 processors, but this machine has an" in said
    assert said.endswith("; export it for this machine")
    assert "is for x86 processors" in (load_failure(library(elf(machine=3, wide=False))) or "")


def test_a_library_for_a_newer_system(library):
    said = "/lib/libc.so.6: version `GLIBC_2.99' not found (required by m.so)"
    why = load_failure(library(elf("libc.so.6")), said) or ""
    assert why.startswith(
        "it was built for a newer system than this machine has (it needs GLIBC_2.99"
    )
    assert load_failure(library(elf("libc.so.6")), "another reason") is None


def test_what_is_no_library_says_nothing(library, tmp_path):
    whole = elf("libno-such.so.3")
    for content in (b"", b"MZ", b"\x7fELF", whole[:70], whole[:-5], b"\x7fELF\2\1" + b"\xff" * 90):
        assert missing_libraries(library(content)) == ()
    assert missing_libraries(tmp_path / "none.so") == ()
    assert load_failure(library(b"no library")) is None


def test_sections_that_are_damaged_mislead_nobody(library):
    whole = bytearray(elf("libno-such.so.3"))
    struct.pack_into("<Q", whole, 40, 64)  # sections where segments are
    struct.pack_into("<HHH", whole, 58, 64, 0, 0)  # as many as a damaged first one says
    assert missing_libraries(library(bytes(whole))) == ("libno-such.so.3",)


@settings(max_examples=30, deadline=None)
@given(
    st.booleans(),
    st.lists(st.tuples(st.integers(0, 400), st.integers(0, 255))),
    st.integers(0, 400),
)
def test_no_damage_ends_in_an_error(wide, changes, length):
    content = bytearray(elf("libc.so.6", "libno-such.so.3", runpath="$ORIGIN", wide=wide))
    for at, byte in changes:
        if at < len(content):
            content[at] = byte
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.so"
        path.write_bytes(content[:length])
        assert "" not in missing_libraries(path)
        load_failure(path)


@pytest.mark.parametrize(
    ("text", "is_refusal"),
    [
        ("No valid license found", True),
        ("Licence checkout failed: -5,357", True),
        ("Your LICENSE has expired.", True),
        ("FlexLM error -15: cannot connect to server", True),
        ("could not check out the feature", True),
        ("Licensed under the 2-clause BSD licence", False),
        ("GUID differs", False),
        ("cannot open the file params.txt", False),
    ],
)
def test_refusals_of_licences(text, is_refusal):
    assert is_about_licence(text) is is_refusal
