"""The contract of a probe."""

from __future__ import annotations

from abc import ABC, abstractmethod
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
