"""Reading a config for a command: what its author should know of it goes to this terminal."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from cluster_est.cli.printing import say
from cluster_est.config import reader
from cluster_est.config.former_keys import former_keys
from cluster_est.config.reader import Config


def read_config(path: Path, overrides: list[str] | None = None) -> Config:
    """Read and check a config file, and name the keys that have no effect any more.

    Parameters
    ----------
    path, overrides
        As for `cluster_est.config.reader.read_config`.

    Raises
    ------
    ConfigError
        As there.
    """
    config = reader.read_config(path, overrides)
    for sentence in former_keys(config):
        say(Console(stderr=True), f"cluster-est: {sentence}")
    return config
