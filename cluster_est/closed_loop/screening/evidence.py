"""Candidates and their evidence: rows of findings.parquet."""

from __future__ import annotations

import enum
from dataclasses import dataclass

import numpy as np


class CandidateStage(enum.StrEnum):
    """The stage that a candidate reached; a member's text is what findings.parquet carries."""

    SET_ASIDE = "set aside"
    """The declared parameters confound it."""
    SCREENED = "screened"
    TRIED = "tried"
    REFITTED = "refitted"
    ACCEPTED = "accepted"


@dataclass(frozen=True)
class CandidateEvidence:
    """One candidate and its evidence, a row of findings.parquet.

    Attributes
    ----------
    step
        1 for the search for the first effect, and so on.
    site, form, family, variables
        Of the effect: "der(v)", "coulomb", "friction", ("v",).
    statistic, freedom
        Score statistic and its degrees of freedom.
    log_p
        Natural logarithm of its own p-value, before any correction for the number of candidates.
    explained
        Share of the residual sum of squares that its direction carries.
    distinct
        Norm of its direction outside the declared parameters, over that before.
    stage
        The last one that it reached.
    criterion
        Bayesian information criterion of its refit minus that of the model without it; NaN where
        it was not refitted.
    confounded_with
        For one set aside: the declared parameter whose sensitivity is most like its direction.
    """

    step: int
    site: str
    form: str
    family: str
    variables: tuple[str, ...]
    statistic: float
    freedom: int
    log_p: float
    explained: float
    distinct: float
    stage: CandidateStage
    criterion: float = np.nan
    confounded_with: str = ""
