"""The bits of whole simulations, which are the same on every processor: recorded once."""

import os
import subprocess
import sys
from pathlib import Path

import fmpy
import pytest

from workers.core import build

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
SCRIPT = ROOT / "tests" / "support" / "simulation_hashes.py"
WITHOUT_FMA = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-FMA4"}
RECORDED = """
fmu none f7316ac1ce528e56
fmu lag 7880af0bb6af17b5
fmu sine fe8e9b8cb1b82f3e
rk4 none 127f82b976276ece
rk4 coulomb c80e52475604ad2c
rk4 stribeck 978159acd108696a
rk4 power 2993c6f5e97d1b41
rk4 lag c2031e8778eb8d19
rk4 sine 4f507d743422d9a2
dormand_prince none 88d9cc2fe0e4c8f4
dormand_prince coulomb 738dc1d1e2ba6bed
dormand_prince stribeck 1bca40a5273bff02
dormand_prince power b63f602cc30d19fe
dormand_prince lag 45fd210e6a1207b5
dormand_prince sine 016080f60207f4e0
"""


@pytest.mark.skipif(
    fmpy.platform != "linux64" or not (build.HERE / "elementary.c").is_file(),
    reason="the FMU's binary for 64-bit Linux, and the core's own elementary functions",
)
@pytest.mark.parametrize(
    "surroundings", [{}, pytest.param(WITHOUT_FMA, marks=pytest.mark.slow)], ids=["", "without FMA"]
)
def test_simulations_have_the_recorded_bits(surroundings):
    paths = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    done = subprocess.run(
        [sys.executable, str(SCRIPT)], capture_output=True, text=True, check=True, cwd=ROOT,
        env=os.environ | paths | surroundings,
    )  # fmt: skip
    assert done.stdout == RECORDED.lstrip()
