"""What the FMUs lack, a file for each field of engineering, as the systems are."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect
from closed_loop_benchmark.effects import drives, mechanical, process, thermal

_FIELDS = (mechanical, drives, thermal, process)

SINGLE: dict[str, tuple[Effect, ...]] = {s: e for f in _FIELDS for s, e in f.SINGLE.items()}
"""Effects of forms that a library should have, by system."""

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {s: p for f in _FIELDS for s, p in f.PAIRS.items()}
"""Labels of two of those that act at once, by system."""

OUTSIDE: dict[str, tuple[Effect, ...]] = {s: e for f in _FIELDS for s, e in f.OUTSIDE.items()}
"""Effects of forms that no library has, by system."""
