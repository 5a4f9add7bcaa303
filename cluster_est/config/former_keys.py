"""Keys of earlier versions that are accepted for one more, with a sentence."""

from __future__ import annotations

from collections.abc import Iterator

from cluster_est.config.sections.sections import Config


def former_keys(config: Config) -> Iterator[str]:
    """Say what such keys in a config do now."""
    if config.executor.patience is not None:
        yield (
            "executor.patience: has no effect any more, because how long simulations take depends "
            "on the machine and its load; model.max_steps ends one by its steps, executor.stall "
            "one that stands still, executor.timeout one that takes too long; remove the key"
        )
