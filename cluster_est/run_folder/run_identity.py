"""What a run is and depends on: its kind, its config, hashes and versions."""

from __future__ import annotations

import enum
import json
import platform
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from cluster_est.config.reader import Config
from cluster_est.config.toml import to_toml
from cluster_est.problem.problem import Problem
from workers.messages import content_hash

DECISIVE = ("cluster-est", "cma", "numba", "numpy", "pymoo", "scipy", "sympy")
"""Libraries on whose versions bits depend."""
LIBRARIES = (*DECISIVE, "fmpy", "pyarrow", "ray")
FORMAT = "2"
UNHASHED = ("executor", "budget", "log")
"""Sections of a config that change no result."""


class RunKind(enum.Enum):
    """What a run does with its config; each kind leaves one section of it unused."""

    FIT = "fit"
    CLOSED_LOOP = "close-loop"

    @property
    def unused_section(self) -> str:
        """The section of a config that does not concern it."""
        return "closed_loop" if self is RunKind.FIT else "method"


class RunStatus(enum.StrEnum):
    """How a run stands, as run.json says it."""

    RUNNING = "running"
    DONE = "done"
    NOT_CONVERGED = "not converged"
    INTERRUPTED = "interrupted"
    FAILED = "failed"


@dataclass(frozen=True)
class RunIdentity:
    """What a run is, before it has done anything.

    Attributes
    ----------
    kind
        A fit or a closed loop.
    config, base
        The resolved config, and the folder that its paths start from.
    problem
        What the config describes.
    """

    kind: RunKind
    config: Config
    base: Path
    problem: Problem

    @property
    def config_text(self) -> str:
        """The resolved config as TOML."""
        return to_toml(self.config.model_dump(mode="python"))

    @property
    def config_hash(self) -> str:
        """Hash of what determines the result."""
        tree = self.config.model_dump(mode="json", exclude_defaults=False)
        return hash_config(tree, self.kind.unused_section)

    @property
    def seed(self) -> int:
        """Of the run's random generators."""
        fit = self.kind is RunKind.FIT
        return self.config.method.seed if fit else self.config.closed_loop.seed


def versions() -> dict[str, str]:
    """Return versions of what a result may depend on."""
    found = {"python": platform.python_version(), "platform": sys.platform}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def hash_config(parts: dict[str, Any], unused: str) -> str:
    """Return the hash of a config without sections that change no result, and without one more."""
    kept = {k: v for k, v in parts.items() if k not in (*UNHASHED, unused)}
    return content_hash([json.dumps(kept, sort_keys=True, default=str)])
