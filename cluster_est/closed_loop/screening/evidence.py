"""Candidates and their evidence: rows of findings.parquet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CandidateEvidence:
    """One candidate and its evidence, a row of findings.parquet.

    Attributes
    ----------
    step
        1 for the search for the first effect, and so on.
    site, form, family, variables
        What it is: "der(v)", "coulomb", "friction", ("v",).
    statistic, freedom
        Score statistic and its degrees of freedom.
    log_p
        Natural logarithm of its own p-value, before any correction for the number of candidates.
    explained
        Share of the residual sum of squares that its direction carries.
    distinct
        Norm of its direction after removing what the declared parameters imitate, over that before.
    stage
        "screened", "tried", "refitted", "accepted" or "set aside" (parameters imitate it).
    criterion
        Bayesian information criterion of its refit minus that of the model without it; NaN where
        it was not refitted.
    imitated_by
        For one set aside: the declared parameter that imitates it best.
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
    stage: str
    criterion: float = np.nan
    imitated_by: str = ""
