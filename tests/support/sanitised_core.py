"""The libraries of files in the place of those that are built, such as ones with sanitizers.

CORE_UNDER_TEST=FILE LD_PRELOAD=libasan.so python -m pytest -p support.sanitised_core tests/...

or WRAPPER_UNDER_TEST for that of exported FMUs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from workers.core import build, library
from workers.errors import ModelError

ROOT = Path(__file__).parents[2]
SANITISED = (
    "-std=c11", "-O1", "-g", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden",
    "-fno-math-errno", "-foptimize-sibling-calls", "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all", "-Wall", "-Wextra", "-Werror",
)  # fmt: skip
"""Flags of such a build."""


def assert_nothing_is_found(folder: Path, kind: str, tests: str) -> None:
    """Run tests in a process of their own, with the library of a kind built so."""
    surroundings = os.environ | {
        f"{kind.upper()}_UNDER_TEST": str(sanitised(folder, kind)),
        "LD_PRELOAD": preloaded(),
        "ASAN_OPTIONS": "detect_leaks=0",
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "support.sanitised_core"]
    done = subprocess.run(
        [*command, tests], capture_output=True, text=True, cwd=ROOT, env=surroundings, check=False
    )
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]


def sanitised(folder: Path, kind: str) -> Path:
    """Build a library so, or skip the test where there is no such compiler."""
    target = folder / f"{kind}.so"
    try:
        build.compile_to(target, build.sources(kind), SANITISED)
    except ModelError as error:
        if "sanitize" in str(error):
            pytest.skip("this compiler has no sanitizers")
        raise
    return target


def preloaded() -> str:
    """The sanitizer's library, which must be there before Python is."""
    asked = [build.compiler(), "-print-file-name=libasan.so"]
    return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()


def chosen() -> Path:
    return Path(os.environ["CORE_UNDER_TEST"])


def pytest_configure(config):
    if "CORE_UNDER_TEST" in os.environ:
        setattr(library, "built", chosen)  # noqa: B010
    if wrapper := os.environ.get("WRAPPER_UNDER_TEST"):
        found = build.library

        def replaced(kind: str, platform: str) -> Path:
            return Path(wrapper) if kind == "wrapper" else found(kind, platform)

        setattr(build, "library", replaced)  # noqa: B010
