"""The identity of a run: its kind, its config, and the hashes and versions that it depends on."""

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
"""Libraries on whose versions bits depend."""
LIBRARIES = (*DECISIVE, "fmpy", "pyarrow", "ray")
FORMAT = "2"
UNHASHED = ("executor", "budget", "log")
"""Sections of a config that change no result."""
UNHASHED_MODEL = ("units",)
"""Keys of its section `model` that change no number."""


class RunKind(enum.Enum):
    """The kinds of runs, each of which leaves some sections of its config unused."""

    FIT = "fit"
    CLOSED_LOOP = "close-loop"
    SENSITIVITY = "sensitivity"
    DESIGN = "design"

    @property
    def unused_sections(self) -> tuple[str, ...]:
        """The sections of a config that do not concern it."""
        if self is RunKind.FIT:
            return ("closed_loop", "sensitivity")
        if self is RunKind.CLOSED_LOOP:
            return ("method", "sensitivity")
        return ("closed_loop", "method", "multistart", "uncertainty")


@dataclass(frozen=True)
class RunIdentity:
    """Everything that tells a run from others, known before it begins.

    Attributes
    ----------
    kind
        Of the run.
    problem
        What is run.
    config_text, config_hash
        The resolved config as TOML, and the hash of what determines the result.
    seed
        Of the run's random generators.
    base
        The folder that the config's paths start from; None without a config.
    log
        How much of each simulation is kept.
    """

    kind: RunKind
    problem: Problem
    config_text: str
    config_hash: str
    seed: int
    base: Path | None = None
    log: LogSettings = field(default_factory=LogSettings)

    @classmethod
    def of(cls, kind: RunKind, config: Config, base: Path, problem: Problem) -> Self:
        """Return the identity of what a resolved config describes."""
        tree = config.model_dump(mode="json", exclude_defaults=False)
        return cls(
            kind,
            problem,
            to_toml(config.model_dump(mode="python")),
            hash_config(tree, kind.unused_sections),
            _seeds(config)[kind],
            base,
            config.log,
        )


def versions() -> dict[str, str]:
    """Return versions of what a result may depend on."""
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
    """Return the hash of a config without sections that change no result, and without some more."""
    kept = {k: v for k, v in parts.items() if k not in (*UNHASHED, *unused)}
    if "model" in kept:
        kept["model"] = {k: v for k, v in kept["model"].items() if k not in UNHASHED_MODEL}
    return content_hash([json.dumps(kept, sort_keys=True, default=str)])
