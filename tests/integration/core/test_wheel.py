"""The wheel, built as a user builds it: one for all platforms, with the libraries of each; and an
installation in place, with that of this machine."""

import ctypes
import os
import shutil
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest
from support.shared_libraries import read_library

from workers.core import build

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
FOLDER = "workers/core/binaries/"
PAIRS = [(kind, platform) for kind in build.KINDS for platform in build.PLATFORMS]
EXPORTS = {"core": "core_simulate", "wrapper": "fmi2DoStep"}
"""A function that each kind must have."""
BYTES = 550_000
NEEDS = {
    "linux": ("libc.so.6", "libm.so.6", "libdl.so.2"),
    "windows": ("kernel32.dll", "api-ms-win-crt-"),
    "darwin": ("/usr/lib/libSystem.B.dylib",),
}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    before = files_of_the_tree()
    pip(sys.executable, "wheel", ROOT, "--no-deps", "-w", folder)
    assert files_of_the_tree() == before, "it leaves nothing there"
    (path,) = folder.iterdir()
    return path


def pip(python, *arguments, **surroundings):
    command = [str(python), "-m", "pip", *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env=os.environ | surroundings
    )
    for package in ("ziglang", "hatchling"):
        if f"No matching distribution found for {package}" in done.stderr:
            pytest.skip(f"this needs the package {package}, which cannot be had here")
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    return said


def files_of_the_tree():
    paths = {path for folder in ("workers", "scripts") for path in (ROOT / folder).rglob("*")}
    return {path for path in (*paths, *ROOT.iterdir()) if "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def libraries(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if name.startswith(FOLDER)]
        return {name.removeprefix(FOLDER): archive.read(name) for name in names}


def test_one_wheel_is_for_all(wheel, libraries):
    assert wheel.name.endswith("-py3-none-any.whl")
    assert set(libraries) == {build.carried_path(*pair).name for pair in PAIRS}


@pytest.mark.parametrize(("kind", "platform"), PAIRS)
def test_a_library_is_for_its_platform(libraries, kind, platform):
    content = libraries[build.carried_path(kind, platform).name]
    found = read_library(content)
    assert found.platform == platform
    assert EXPORTS[kind] in found.exports
    system = platform.split("-")[1]
    foreign = {name for name in found.needs if not name.lower().startswith(NEEDS[system])}
    if system == "darwin":
        foreign = found.needs - set(NEEDS[system])
        assert found.system == (11, 0)
        assert found.name == f"@rpath/{kind}.dylib"
        assert found.is_signed or platform.startswith("x86_64")  # Intel processors ask for none
    elif system == "linux":
        assert (2, 0) < found.system <= (2, 17)
    assert not foreign
    assert len(content) < BYTES
    assert str(ROOT).encode() not in content


def test_its_library_has_the_bits_of_this_machines_compiler(wheel, tmp_path):
    if build.this_platform() not in build.PLATFORMS:
        pytest.skip(f"no wheel has a library for {build.this_platform()}")
    unpacked = tmp_path / "wheel"
    zipfile.ZipFile(wheel).extractall(unpacked)
    ours = hashes(ROOT, tmp_path / "own")
    theirs = hashes(unpacked, tmp_path / "carried", PATH="")  # no compiler: it must be carried
    assert len(ours.splitlines()) > 10
    assert theirs == ours


def hashes(packages, cache, **surroundings):
    """A hash of each of some simulations by the core of the packages in a folder."""
    paths = os.pathsep.join([str(packages), str(ROOT / "tests"), str(ROOT / "scripts")])
    given = {"PYTHONPATH": paths, "CLUSTER_EST_CACHE": str(cache)}
    script = ROOT / "tests" / "support" / "simulation_hashes.py"
    done = subprocess.run(
        [sys.executable, "-P", str(script), "effects"], capture_output=True, text=True, check=False,
        cwd=cache.parent, env=os.environ | given | surroundings,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(shutil.which("cc") is None, reason="a C compiler, to do with and without it")
@pytest.mark.parametrize("with_compiler", [True, False])
def test_an_installation_in_place_has_the_library_of_its_machine(tmp_path, with_compiler):
    tree = tmp_path / "tree"
    for name in ("cluster_est", "workers", "scripts"):
        ignored = shutil.ignore_patterns("__pycache__", "binaries")
        shutil.copytree(ROOT / name, tree / name, ignore=ignored)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree)
    venv.create(tmp_path / "venv", with_pip=True)
    (python,) = (tmp_path / "venv").glob("*/python")
    path = {} if with_compiler else {"PATH": str(python.parent), "CC": ""}
    said = pip(python, "install", "-v", "--no-deps", "-e", tree, **path)
    made = sorted((tree / "workers" / "core" / "binaries").iterdir())
    here = build.this_platform()
    assert [each.name for each in made] == [build.carried_path(k, here).name for k in build.KINDS]
    for library, function in zip(made, ("core_simulate", "fmi2DoStep"), strict=True):
        assert hasattr(ctypes.CDLL(str(library)), function)
        assert f"building {library.name} with " in said
    assert ("ziglang" in said) is not with_compiler
