"""The memory of a process, as the system counts it."""

from __future__ import annotations

from pathlib import Path


def resident_bytes(process: int | str) -> int:
    """Bytes that a process has in memory; 0 where the system does not say."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * 4096
