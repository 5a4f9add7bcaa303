"""The bits of whole simulations, which are the same on every processor: recorded once.

Elsewhere the FMUs are built from the same sources for that processor too; they add, multiply and
divide, and all functions, of effects, are the core's.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import fmpy
import pytest

from workers.core import build

ROOT = Path(__file__).parents[3]
SUPPORT = ROOT / "tests" / "support"
RECORDED = Path(__file__).with_name("simulation_hashes.txt")
WITHOUT_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4"}
ARM_LIBRARIES = Path(os.environ.get("QEMU_LD_PREFIX", "/usr/aarch64-linux-gnu"))
"""Where Debian has the C library of other processors, which FMUs and the core are linked to."""

pytestmark = pytest.mark.skipif(fmpy.platform != "linux64", reason="the FMUs' binaries for Linux")


def printed(script, *arguments, **surroundings):
    """What a script of `tests/support` prints."""
    folders = (ROOT, ROOT / "tests", ROOT / "scripts")
    paths = {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    done = subprocess.run(
        [sys.executable, str(SUPPORT / script), *arguments], capture_output=True, text=True,
        check=False, cwd=ROOT, env=os.environ | paths | surroundings,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout


def emulator(name, package):
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} runs what is built for another machine but is not there: {package}")
    if build.zig() is None:
        pytest.skip("the package ziglang builds for other machines but is not installed")
    return found


@pytest.mark.parametrize(
    "surroundings", [{}, pytest.param(WITHOUT_FMA, marks=pytest.mark.slow)], ids=["", "without FMA"]
)
def test_simulations_have_the_recorded_bits(surroundings):
    recorded = RECORDED.read_text(encoding="utf-8").splitlines()
    found = printed("simulation_hashes.py", **surroundings).splitlines()
    assert sorted({*found} - {*recorded}) == [], "new or other bits: record them with --record"
    assert found == recorded


@pytest.mark.slow
def test_so_they_have_on_arm(tmp_path):
    qemu = emulator("qemu-aarch64", "install qemu-user")
    if not ARM_LIBRARIES.is_dir():
        pytest.skip(f"{ARM_LIBRARIES} has no C library for ARM: install libc6-arm64-cross")
    there = printed("foreign_core.py", "aarch64-linux", tmp_path, qemu, "-L", ARM_LIBRARIES)
    assert there == RECORDED.read_text(encoding="utf-8")


@pytest.mark.slow
def test_so_they_have_on_windows(tmp_path):
    wine = emulator("wine", "install wine64")
    own = {"WINEPREFIX": str(tmp_path / "prefix"), "WINEDEBUG": "-all"}
    there = printed("foreign_core.py", "x86_64-windows", tmp_path, wine, **own)
    assert there == RECORDED.read_text(encoding="utf-8")
