"""The bits of whole simulations, which are the same on every processor: recorded once."""

import os
import subprocess
import sys
from pathlib import Path

import fmpy
import pytest

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "tests" / "support" / "simulation_hashes.py"
RECORDED = Path(__file__).with_name("simulation_hashes.txt")
WITHOUT_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4"}


@pytest.mark.skipif(fmpy.platform != "linux64", reason="the FMU's binary for 64-bit Linux")
@pytest.mark.parametrize(
    "surroundings", [{}, pytest.param(WITHOUT_FMA, marks=pytest.mark.slow)], ids=["", "without FMA"]
)
def test_simulations_have_the_recorded_bits(surroundings):
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    done = subprocess.run(
        [sys.executable, str(SCRIPT)], capture_output=True, text=True, check=True, cwd=ROOT,
        env=os.environ | paths | surroundings,
    )  # fmt: skip
    recorded = RECORDED.read_text(encoding="utf-8").splitlines()
    found = done.stdout.splitlines()
    assert sorted({*found} - {*recorded}) == [], "new or other bits: record them with --record"
    assert found == recorded
