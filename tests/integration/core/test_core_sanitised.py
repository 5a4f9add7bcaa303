"""The core with AddressSanitizer and UndefinedBehaviorSanitizer: nothing is found in any test."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.sanitised_core import preloaded, sanitised

ROOT = Path(__file__).parents[3]
TESTS = (
    "tests/unit/workers/core",
    "tests/integration/core/test_core_loops.py",
    "tests/integration/core/test_core_failures.py",
    "tests/integration/fmus/test_linearisation.py",
    "tests/integration/fmus/test_sensitivities.py",
    "tests/integration/effects/test_effects.py",
    "tests/integration/fits/test_process_noise.py",
)


@pytest.mark.slow
@pytest.mark.parametrize("tests", TESTS)
def test_nothing_is_found(tmp_path, tests):
    surroundings = os.environ | {
        "CORE_UNDER_TEST": str(sanitised(tmp_path, "core", own_functions=True)),
        "LD_PRELOAD": preloaded(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "support.sanitised_core"]
    done = subprocess.run(
        [*command, tests], capture_output=True, text=True, cwd=ROOT, env=surroundings, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
