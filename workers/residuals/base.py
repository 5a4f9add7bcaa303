"""The contract of a kind of residual."""

from __future__ import annotations

from abc import ABC, abstractmethod

from workers.grid import Grid
from workers.messages import FloatArray


class ResidualKind(ABC):
    """Compares simulated outputs with measured ones.

    Its number of residuals must be the same for every point, because methods subtract them.
    """

    @abstractmethod
    def residuals(self, grid: Grid, outputs: FloatArray) -> FloatArray:
        """Compare a batch of simulations with the measurements of their experiment.

        Parameters
        ----------
        grid
            The experiment; n times.
        outputs : (points, n, outputs)
            What was simulated; not finite where a simulation stopped early.

        Returns
        -------
        (points, k)
            The residuals of each point.
        """
