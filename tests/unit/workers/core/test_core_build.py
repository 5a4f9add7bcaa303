"""Which libraries are built for which platforms, where they are found, and what is said if not."""

import os
import platform
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from workers.core import build, library
from workers.errors import ModelError

MUSL = "x86_64-linux-musl"


@pytest.fixture(autouse=True)
def nothing_built(tmp_path, monkeypatch):
    monkeypatch.setattr(build, "BINARIES", tmp_path / "binaries")
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "cache"))
    (tmp_path / "binaries").mkdir()


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(build, "zig", lambda: None)


@pytest.fixture
def calls(monkeypatch):
    """Commands of compilers, which are not run but make a file."""
    made = []

    def run(command, **_):
        made.append(command)
        Path(command[command.index("-o") + 1]).write_bytes(b"library")
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    return made


def on(monkeypatch, system, machine, python="", glibc="glibc 2.36"):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    monkeypatch.setattr(sysconfig, "get_platform", lambda: python)

    def confstr(name):
        if not glibc:
            raise ValueError("unrecognized configuration name")
        return glibc

    monkeypatch.setattr(os, "confstr", confstr, raising=False)


def test_the_table_has_all_platforms_of_a_wheel():
    linux, windows, mac = "linux-gnu.2.17", "windows-gnu", "macos.11.0"
    assert {
        "x86_64-linux": f"x86_64-{linux}",
        "aarch64-linux": f"aarch64-{linux}",
        "x86_64-windows": f"x86_64-{windows}",
        "x86_64-darwin": f"x86_64-{mac}",
        "aarch64-darwin": f"aarch64-{mac}",
    } == build.PLATFORMS
    suffixes = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}
    for name in build.PLATFORMS:
        assert build.suffix(name) == suffixes[name.split("-")[1]]


def test_every_source_is_built():
    there = {path.name for path in build.HERE.rglob("*.c")}
    built = {path.name for kind in build.KINDS for path in build.sources(kind)}
    assert built == there


@pytest.mark.parametrize(
    ("here", "name"),
    [
        (("linux", "x86_64"), "x86_64-linux"),
        (("linux", "aarch64"), "aarch64-linux"),
        (("linux", "x86_64", "", ""), MUSL),
        (("darwin", "x86_64"), "x86_64-darwin"),
        (("darwin", "arm64"), "aarch64-darwin"),
        (("win32", "AMD64", "win-amd64"), "x86_64-windows"),
        (("win32", "ARM64", "win-arm64"), "aarch64-windows"),
        (("win32", "ARM64", "win-amd64"), "x86_64-windows"),
    ],
)
def test_this_platform(monkeypatch, here, name):
    on(monkeypatch, *here)
    assert build.this_platform() == name


@pytest.mark.parametrize(
    ("here", "name"),
    [
        (("linux", "x86_64", "", ""), MUSL),
        (("win32", "ARM64", "win-arm64"), "aarch64-windows"),
        (("linux", "riscv64"), "riscv64-linux"),
    ],
)
def test_a_platform_without_a_library_is_told_what_to_do(monkeypatch, no_compiler, here, name):
    build.carried_path("core", "aarch64-linux").write_bytes(b"")
    on(monkeypatch, *here)
    with pytest.raises(ModelError) as caught:
        build.built()
    said = str(caught.value)
    assert said.startswith(f"{build.BINARIES}: must have the library core of this version for")
    assert f"for {name}, but has it for aarch64-linux, and there is no C compiler" in said
    assert "Install gcc (Debian: apt install gcc; Alpine: apk add gcc musl-dev)" in said
    assert said.endswith(
        "wheels of cluster-est contain the library for " + ", ".join(build.PLATFORMS)
    )


def test_where_a_library_is_carried_no_compiler_is_needed(no_compiler):
    place = build.carried_path("core", build.this_platform())
    assert not build.is_built()
    place.write_bytes(b"library")
    assert build.is_built()
    assert build.built() == place


def test_sources_that_are_changed_are_another_version(tmp_path, monkeypatch, no_compiler):
    (tmp_path / "core.c").write_text("int one;")
    monkeypatch.setattr(build, "HERE", tmp_path)
    build.carried_path("core", build.this_platform()).write_bytes(b"")
    assert build.is_built()
    (tmp_path / "core.c").write_text("int two;")
    assert not build.is_built()
    with pytest.raises(ModelError, match="but has it for no platform"):
        build.built()


def test_a_library_for_another_platform_is_built_by_zig(monkeypatch, calls):
    on(monkeypatch, "linux", "x86_64")
    monkeypatch.setattr(build, "zig", lambda: ("zig", "cc"))
    first = build.library("core", "aarch64-darwin")
    assert first.suffix == ".dylib"
    assert first.read_bytes() == b"library"
    assert build.library("core", "aarch64-darwin") == first
    (command,) = calls
    assert command[:4] == ["zig", "cc", "-target", "aarch64-macos.11.0"]
    assert "-Wl,-install_name,@rpath/core.dylib" in command


def test_without_zig_there_is_none_for_another_platform(monkeypatch, no_compiler):
    on(monkeypatch, "linux", "x86_64")
    with pytest.raises(
        ModelError, match=r"for x86_64-windows, but .* the package ziglang to build"
    ):
        build.library("core", "x86_64-windows")
    with pytest.raises(ModelError, match="for x86_64-freebsd, but has it for no platform; wheels"):
        build.library("core", "x86_64-freebsd")
    with pytest.raises(ModelError, match="for x86_64-windows, but has it for no platform; install"):
        build.compile_for("x86_64-windows", Path("core.dll"))


@pytest.mark.parametrize(("glibc", "target"), [("glibc 2.36", "x86_64-linux-gnu.2.17"), ("", MUSL)])
def test_zig_takes_the_place_of_a_compiler(monkeypatch, no_compiler, calls, glibc, target):
    on(monkeypatch, "linux", "x86_64", glibc=glibc)
    monkeypatch.setattr(build, "zig", lambda: ("zig", "cc"))
    assert build.built().read_bytes() == b"library"
    (command,) = calls
    assert command[:4] == ["zig", "cc", "-target", target]
    assert "-ffp-contract=off" in command


def test_a_chosen_compiler_has_a_library_of_its_own(monkeypatch, calls):
    monkeypatch.setenv("CC", sys.executable)
    chosen = build.built()
    monkeypatch.delenv("CC")
    monkeypatch.setattr(build, "COMPILERS", (sys.executable,))
    assert build.built() != chosen
    assert len(calls) == 2


def test_a_missing_compiler_says_what_to_do(no_compiler):
    with pytest.raises(ModelError, match=r"there is no C compiler to build it\. Install gcc"):
        build.compiler()


@pytest.mark.parametrize(
    "damage",
    [
        lambda file: file.write_bytes(b""),
        lambda file: file.write_bytes(file.read_bytes()[:3]),
        lambda file: file.write_bytes(b"another"),
        lambda file: file.with_name(f"{file.name}.sha256").unlink(),
        lambda file: file.with_name(f"{file.name}.sha256").write_bytes(b"\xff"),
    ],
    ids=["empty", "cut", "swapped", "no digest", "no text"],
)
def test_a_cached_library_is_built_anew_where_it_is_not_as_it_was_built(calls, damage):
    built = build.built()
    assert build.built() == built
    assert len(calls) == 1
    damage(built)
    assert not build.is_built()
    assert build.built().read_bytes() == b"library"
    assert len(calls) == 2


def test_a_file_that_is_no_library_is_named(tmp_path):
    file = tmp_path / "core.so"
    file.write_bytes(b"text")
    with pytest.raises(ModelError, match=r"core\.so: must be a library for this machine, but"):
        library.load(str(file))
