"""The key by which a log finds a simulation again."""

from __future__ import annotations

from workers.messages import Effect, FloatArray, content_hash


def simulation_key(
    model_key: str, experiment_key: str, effects: tuple[Effect, ...], values: FloatArray
) -> str:
    """Return the hash of all that a simulation's outcome depends on."""
    return content_hash([model_key, experiment_key, repr(effects), values.tobytes()])
