"""The contract of a probe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

from workers.evaluate import Evaluator


class FmuProbe(ABC):
    """Asks for more than a simulation: what `cluster-est check` wants to know of an FMU."""

    @abstractmethod
    def answer(self, evaluator: Evaluator) -> Any:
        """Find it out with an FMU that was just loaded; what is returned travels back.

        Raises
        ------
        ModelError
            If it cannot be found out; travels back too.
        """


def resident_bytes(process: int | str) -> int:
    """Bytes that a process has in memory; 0 where the system does not say."""
    try:
        pages = int(Path(f"/proc/{process}/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return 0
    return pages * 4096
