"""The uncertainty of estimates.

`assess` needs no simulation: covariance, intervals, correlations and the directions that the data
do not determine, from the Jacobian at the solution. `examine` simulates a few points for it
where that tells more. `profiles` and `bootstrap` refit, on the same queue as any search, and
`sample_posterior` draws there.
"""

from __future__ import annotations

from cluster_est.uncertainty.bootstrap import (
    BootstrapInterval,
    BootstrapResult,
    bootstrap,
    check_bootstrap,
)
from cluster_est.uncertainty.covariance.covariance import assess, intervals, not_assessed
from cluster_est.uncertainty.covariance.derivatives import examine, linearise, sharpen
from cluster_est.uncertainty.covariance.directions import UndeterminedDirection
from cluster_est.uncertainty.covariance.result import (
    ConfidenceInterval,
    DerivedInterval,
    Uncertainty,
)
from cluster_est.uncertainty.posterior.density import check_posterior
from cluster_est.uncertainty.posterior.posterior import sample_posterior
from cluster_est.uncertainty.posterior.prediction import PredictedBand, predicted_bands
from cluster_est.uncertainty.posterior.result import PosteriorInterval, PosteriorResult
from cluster_est.uncertainty.profiles.profile import check_profiles, profiles, select
from cluster_est.uncertainty.profiles.result import ProfilePoint, ProfileResult
from cluster_est.uncertainty.settings import UncertaintySettings

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
