"""What a fit says of its priors: what they add to the cost, and which of them it contradicts."""

from __future__ import annotations

from collections.abc import Sequence

from cluster_est.problem.problem import Problem
from cluster_est.results.tables.row_types import Estimate

FAR = 2.0
"""Standard deviations from the centre of a prior beyond which an estimate contradicts it: one of
twenty lies there by chance."""


def prior_sentences(problem: Problem, estimates: Sequence[Estimate]) -> tuple[str, ...]:
    """Say what the priors add to the cost, and which estimates lie far from theirs.

    Parameters
    ----------
    problem
        Whose parameters have priors, or none.
    estimates
        All values of a fit; those of held-out data count in no cost of the training data.
    """
    priors = {p.name: p.prior for p in problem.parameters if p.prior is not None}
    known = [(e, priors[e.parameter], e.estimated_on) for e in estimates if e.parameter in priors]
    if not known:
        return ()
    train = [prior.residual(each.value) for each, prior, on in known if on == "train"]
    added = sum(residual**2 for residual in train)
    said = []
    if train:
        one = len(train) == 1
        named = (
            "a prior, which counts like a measurement, adds"
            if one
            else (f"{len(train)} priors, which count like measurements, add")
        )
        said = [f"{named} {added:.3g} to the cost"]
    for each, prior, _ in known:
        residual = prior.residual(each.value)
        if abs(residual) > FAR:
            where = "above" if residual > 0.0 else "below"
            said.append(
                f"{each.label} = {each.value:.4g} lies {abs(residual):.2g} standard deviations "
                f"{where} its prior ({prior.said()}): the measurements say another value"
            )
    return tuple(said)
