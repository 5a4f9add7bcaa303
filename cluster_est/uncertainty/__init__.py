"""The uncertainty of estimates.

`assess` needs no simulation. It computes the covariance, intervals, correlations and the directions
that the data do not determine from the Jacobian at the solution. `examine` also simulates a few
points if they are necessary. `profiles` and `bootstrap` refit, and `sample_posterior` draws from
the posterior; they use the same queue as any search.
"""

from __future__ import annotations

from cluster_est.uncertainty.bootstrap import (
    BootstrapInterval,
    BootstrapResult,
    bootstrap,
    check_bootstrap,
)
from cluster_est.uncertainty.covariance.covariance import assess, intervals, not_assessed
from cluster_est.uncertainty.covariance.derivatives import (
    assess_held_out,
    examine,
    linearise,
    sharpen,
)
from cluster_est.uncertainty.covariance.local_uncertainty import (
    ConfidenceInterval,
    DerivedInterval,
    Uncertainty,
    UndeterminedDirection,
)
from cluster_est.uncertainty.posterior import check_posterior, sample_posterior
from cluster_est.uncertainty.posterior_draws import (
    PosteriorInterval,
    PosteriorResult,
    PredictedBand,
    predicted_bands,
)
from cluster_est.uncertainty.profile_points import ProfilePoint, ProfileResult
from cluster_est.uncertainty.profiles import check_profiles, profiles, select
from cluster_est.uncertainty.uncertainty_settings import UncertaintySettings

__all__ = [
    "BootstrapInterval",
    "BootstrapResult",
    "ConfidenceInterval",
    "DerivedInterval",
    "PosteriorInterval",
    "PosteriorResult",
    "PredictedBand",
    "ProfilePoint",
    "ProfileResult",
    "Uncertainty",
    "UncertaintySettings",
    "UndeterminedDirection",
    "assess",
    "assess_held_out",
    "bootstrap",
    "check_bootstrap",
    "check_posterior",
    "check_profiles",
    "examine",
    "intervals",
    "linearise",
    "not_assessed",
    "predicted_bands",
    "profiles",
    "sample_posterior",
    "select",
    "sharpen",
]
