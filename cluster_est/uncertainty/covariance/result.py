"""The uncertainty of estimates from derivatives."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_est.uncertainty.covariance.directions import UndeterminedDirection
from cluster_est.uncertainty.covariance.noise_covariance import NoiseBasis
from workers.messages import FloatArray
from workers.messages.equality import by_content


@dataclass(frozen=True)
class ConfidenceInterval:
    """Of one unknown, in physical units; NaN where it is held or the data do not determine it.

    Attributes
    ----------
    std_error, lower95, upper95
        By what `Uncertainty.basis` says of the noise.
    at_bound
        "lower" or "upper" where a bound holds it.
    error_white, error_autoregression, error_experiments
        The standard error if the noise is white, if it is an autoregression, and from the scatter
        of the experiments; NaN for what was not taken into account.
    error_uniform
        What `error_white` would be if priors scattered as the measurements do: the curvature of the
        cost alone says it. NaN where there are no priors.
    """

    std_error: float
    lower95: float
    upper95: float
    at_bound: str
    error_white: float = np.nan
    error_autoregression: float = np.nan
    error_experiments: float = np.nan
    error_uniform: float = np.nan


@dataclass(frozen=True)
class DerivedInterval:
    """Of a parameter that follows from others, to first order."""

    label: str
    value: float
    std_error: float
    lower95: float
    upper95: float


@by_content
@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty of a solution, to first order.

    Attributes
    ----------
    intervals
        One for each unknown, in their order.
    derived
        Of parameters that follow from others.
    shared, local
        Labels of the free unknowns that several experiments may depend on, and of the others.
    correlations : (shared, shared)
        NaN where the data do not determine one of the two.
    local_correlations : (local, shared)
        Those of two local unknowns are left out: their number is the square of the experiments'.
    directions
        That the data do not determine, or hardly.
    variance, degrees
        s^2 in units of the cost's own weights, and n - k; NaN where there is no covariance.
    basis, basis_degrees
        What the standard errors and intervals take for the noise, and their degrees of freedom.
    notes
        Sentences on omissions, and their reasons.
    """

    intervals: tuple[ConfidenceInterval, ...]
    derived: tuple[DerivedInterval, ...]
    shared: tuple[str, ...]
    local: tuple[str, ...]
    correlations: FloatArray = field(repr=False)
    local_correlations: FloatArray = field(repr=False)
    directions: tuple[UndeterminedDirection, ...]
    variance: float
    degrees: int
    notes: tuple[str, ...]
    basis: NoiseBasis = NoiseBasis.WHITE
    basis_degrees: float = np.nan

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on directions that the data do not determine, and the notes."""
        return (*(direction.sentence for direction in self.directions), *self.notes)
