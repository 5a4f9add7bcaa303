"""The key by which a log finds a simulation again."""

from __future__ import annotations

import math

from workers.messages import Effect, FloatArray, content_hash


def simulation_key(
    model_key: str,
    experiment_key: str,
    effects: tuple[Effect, ...],
    values: FloatArray,
    bound: float = math.inf,
) -> str:
    """Return the hash of all that a simulation's outcome depends on.

    `bound` is the sum of squares above which it ends early.
    """
    parts: list[str | bytes] = [model_key, experiment_key, repr(effects), values.tobytes()]
    if bound < math.inf:
        parts.append(bound.hex())
    return content_hash(parts)
