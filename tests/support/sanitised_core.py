"""The core of a file in the place of the one that is built, such as one with sanitizers.

CORE_UNDER_TEST=FILE LD_PRELOAD=libasan.so python -m pytest -p support.sanitised_core tests/...
"""

from __future__ import annotations

import os
from pathlib import Path

from workers.core import library

SANITISED = (
    "-std=c11", "-O1", "-g", "-ffp-contract=off", "-fPIC", "-shared", "-fvisibility=hidden",
    "-fno-math-errno", "-foptimize-sibling-calls", "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all", "-Wall", "-Wextra", "-Werror",
)  # fmt: skip
"""Flags of such a build."""


def chosen(*, own_functions: bool = True) -> Path:
    return Path(os.environ["CORE_UNDER_TEST"])


def pytest_configure(config):
    setattr(library, "built", chosen)  # noqa: B010
