"""What a run depends on, as hashes and versions: whether two runs must give the same bits."""

from __future__ import annotations

import json
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from workers.messages import content_hash

DECISIVE = ("cluster-est", "cma", "numba", "numpy", "pymoo", "scipy", "sympy")
"""Libraries on whose versions bits depend."""
LIBRARIES = (*DECISIVE, "fmpy", "pyarrow", "ray")
FORMAT = "2"
UNHASHED = ("executor", "budget", "log")
"""Sections of a config that change no result."""


def versions() -> dict[str, str]:
    """Versions of what a result may depend on."""
    found = {"python": platform.python_version(), "platform": sys.platform}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def hash_config(parts: dict[str, Any], unused: str) -> str:
    """Hash of a config without what changes no result: where and for how long, and one section."""
    kept = {k: v for k, v in parts.items() if k not in (*UNHASHED, unused)}
    return content_hash([json.dumps(kept, sort_keys=True, default=str)])
