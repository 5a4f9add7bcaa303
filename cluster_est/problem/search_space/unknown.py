"""One number that a method moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.priors import Prior


def scope_of(label: str, name: str) -> str:
    """Return the experiment or group in a parameter's label: "exp5" of "x0[exp5]"; "" if shared.

    The name itself may have brackets, as elements of arrays do.
    """
    return label.removeprefix(name)[1:-1]


@dataclass(frozen=True)
class Unknown:
    """One number that a method moves.

    Attributes
    ----------
    label
        "k", or "x0[exp5]" where the parameter has a value of its own there.
    parameter
        Whose value it is.
    column
        Its place in `Model.parameters`.
    experiments
        Positions, in the space, of the experiments that it acts on.
    start
        Physical value that the search starts from.
    size
        Of a noticeable change, where something better is known than the start's own size; else 0.
    """

    label: str
    parameter: Parameter
    column: int
    experiments: tuple[int, ...]
    start: float
    size: float = 0.0

    @property
    def scope(self) -> str:
        """The experiment or group whose value it is; "" where all share it."""
        return scope_of(self.label, self.parameter.name)

    @property
    def log(self) -> bool:
        return self.parameter.scale == "log"

    @property
    def prior(self) -> Prior | None:
        return self.parameter.prior

    def prior_residual(self, searched: float) -> float:
        """Return how far a value in search coordinates lies from its prior, in its sigmas."""
        return 0.0 if self.prior is None else self.prior.residual(self.to_physical(searched))

    def prior_slope(self, searched: float) -> float:
        """Return the derivative of `prior_residual`."""
        if self.prior is None:
            return 0.0
        value = self.to_physical(searched)
        return self.prior.slope(value) * (value if self.log else 1.0)

    def to_search(self, physical: float) -> float:
        if not self.log:
            return physical
        return math.log(physical) if physical > 0.0 else -math.inf

    def to_physical(self, searched: float) -> float:
        if not self.log:
            return searched
        # the exponential of a bound's logarithm may lie just outside the bound
        return min(max(math.exp(min(searched, 709.0)), self.parameter.lower), self.parameter.upper)

    @property
    def typical(self) -> float:
        """The size of a noticeable change, where nothing better is known.

        1 for a logarithm; else the start's own size, or a tenth of the range for a start of 0.
        A fit measures the last one and keeps it in `size`.
        """
        if self.log:
            return 1.0
        if self.size > 0.0:
            return self.size
        if self.start != 0.0:
            return abs(self.start)
        width = self.parameter.upper - self.parameter.lower
        return 0.1 * width if math.isfinite(width) else 1.0
