"""The identity of a run: its kind, its config, and the hashes and versions on which it depends."""

from __future__ import annotations

import enum
import json
import platform
import sys
from collections.abc import Collection
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Self

from cluster_est.config.sections import Config
from cluster_est.problem.problem import Problem
from cluster_est.running.resources import LogSettings
from cluster_est.toml import to_toml
from workers.messages import content_hash

DECISIVE = ("cluster-est", "cma", "numpy", "piqp", "pymoo", "scipy", "sympy")
"""Packages whose versions may change the bits of a result."""
LIBRARIES = (*DECISIVE, "fmpy", "pyarrow", "ray")
FORMAT = "2"
UNHASHED = ("executor", "budget", "log")
"""Sections of a config that do not change a result."""
UNHASHED_MODEL = ("units",)
"""Keys of the section `model` that do not change a number."""


class RunKind(enum.Enum):
    """The kinds of runs, each of which does not use some sections of its config."""

    FIT = "fit"
    CLOSED_LOOP = "close-loop"
    SENSITIVITY = "sensitivity"
    DESIGN = "design"

    @property
    def unused_sections(self) -> tuple[str, ...]:
        """The sections of a config that a run of this kind does not use."""
        if self is RunKind.FIT:
            return ("closed_loop", "sensitivity")
        if self is RunKind.CLOSED_LOOP:
            return ("method", "sensitivity")
        return ("closed_loop", "method", "multistart", "uncertainty")


@dataclass(frozen=True)
class RunIdentity:
    """Everything that distinguishes a run from others, known before it begins.

    Attributes
    ----------
    kind
        Kind of the run.
    problem
        Problem of the run.
    config_text, config_hash
        The resolved config as TOML, and the hash of the parts that determine the result.
    seed
        Seed of the run's random generators.
    base
        Folder to which paths in the config are relative; None without a config.
    log
        Amount of data to keep of each simulation.
    config_file
        The file of the config that was given, to name it in later steps; None without a config.
    """

    kind: RunKind
    problem: Problem
    config_text: str
    config_hash: str
    seed: int
    base: Path | None = None
    log: LogSettings = field(default_factory=LogSettings)
    config_file: Path | None = None

    @classmethod
    def of(
        cls, kind: RunKind, config: Config, base: Path, problem: Problem, file: Path | None = None
    ) -> Self:
        """Return the identity of a run of a resolved config."""
        tree = config.model_dump(mode="json", exclude_defaults=False)
        return cls(
            kind,
            problem,
            to_toml(config.model_dump(mode="python")),
            hash_config(tree, kind.unused_sections),
            _seeds(config)[kind],
            base,
            config.log,
            file,
        )


def versions() -> dict[str, str]:
    """Return the versions on which a result may depend."""
    found = {"python": platform.python_version(), "platform": sys.platform}
    for library in LIBRARIES:
        try:
            found[library] = version(library)
        except PackageNotFoundError:
            continue
    return found


def _seeds(config: Config) -> dict[RunKind, int]:
    return {
        RunKind.FIT: config.method.seed,
        RunKind.CLOSED_LOOP: config.closed_loop.seed,
        RunKind.SENSITIVITY: config.sensitivity.seed,
    }


def hash_config(parts: dict[str, Any], unused: Collection[str]) -> str:
    """Return the hash of a config without sections that do not change a result or are unused."""
    kept = {k: v for k, v in parts.items() if k not in (*UNHASHED, *unused)}
    if "model" in kept:
        kept["model"] = {k: v for k, v in kept["model"].items() if k not in UNHASHED_MODEL}
    return content_hash([json.dumps(kept, sort_keys=True, default=str)])
