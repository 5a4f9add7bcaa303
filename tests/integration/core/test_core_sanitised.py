"""The core with AddressSanitizer and UndefinedBehaviorSanitizer: nothing is found in any test."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.sanitised_core import preloaded, sanitised

ROOT = Path(__file__).parents[3]
TESTS = (
    ("tests/unit/workers/core", True),
    ("tests/unit/workers/core", False),
    ("tests/integration/core/test_core_loops.py", False),
    ("tests/integration/core/test_core_effects.py", False),
    ("tests/integration/core/test_core_failures.py", True),
)
"""With the core's own elementary functions, or those of the C library as the compiled loops."""


@pytest.mark.slow
@pytest.mark.parametrize(("tests", "own_functions"), TESTS)
def test_nothing_is_found(tmp_path, tests, own_functions):
    surroundings = os.environ | {
        "CORE_UNDER_TEST": str(sanitised(tmp_path, "core", own_functions=own_functions)),
        "LD_PRELOAD": preloaded(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "support.sanitised_core"]
    command += ["-k", "not bits_of_its_compiled"] if own_functions else []
    done = subprocess.run(
        [*command, tests], capture_output=True, text=True, cwd=ROOT, env=surroundings, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
