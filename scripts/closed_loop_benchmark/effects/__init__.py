"""What the FMUs lack, a file for each field of engineering, as the systems are."""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect
from closed_loop_benchmark.effects import (
    biological,
    crane_and_kiln,
    drives,
    hydraulic_and_electrical,
    mechanical,
    process,
    thermal,
)
from closed_loop_benchmark.effects.combined import TEXTBOOK_PAIRS, TRIPLES

__all__ = ["OUTSIDE", "PAIRS", "SINGLE", "TEXTBOOK", "TRIPLES"]

_FIELDS = (mechanical, drives, thermal, process)

SINGLE: dict[str, tuple[Effect, ...]] = {s: e for f in _FIELDS for s, e in f.SINGLE.items()}
"""Effects of forms that a library should have, by system."""

PAIRS: dict[str, tuple[tuple[str, str], ...]] = {
    **{s: p for f in _FIELDS for s, p in f.PAIRS.items()},
    **TEXTBOOK_PAIRS,
}
"""Labels of two that act at once, by system."""

OUTSIDE: dict[str, tuple[Effect, ...]] = {s: e for f in _FIELDS for s, e in f.OUTSIDE.items()}
"""Effects of forms that no library has, by system."""

_BOOKS = (crane_and_kiln, biological, hydraulic_and_electrical)

TEXTBOOK: dict[str, tuple[Effect, ...]] = {s: e for f in _BOOKS for s, e in f.TEXTBOOK.items()}
"""Effects that were taken from textbooks of physics, whatever a library has, by system."""
