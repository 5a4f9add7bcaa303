"""What the last fit leaves in doubt: it is said, and bars the verdict "found".

An effect may stand in for what lies beyond the bound of a declared parameter. A law whose shape is
at the end of its range is another law, of which it is a piece: saturation with a knee far beyond
the data is a line. A fit that ended far from its minimum has no intervals to judge an effect by.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict
from cluster_est.problem.display import in_a_row
from cluster_est.results.fit_tables import Estimate
from cluster_est.results.result import Result


def doubted(
    judged: ReasonedVerdict, added: Collection[str], before: Result, after: Result
) -> tuple[ReasonedVerdict, tuple[str, ...]]:
    """Say what the last fit leaves in doubt: then not all was found, whatever is left.

    Parameters
    ----------
    judged
        The verdict so far.
    added
        Names of the effects that are claimed; without any there is nothing to be barred.
    before, after
        Last fits of the declared model, and with the effects.

    Returns
    -------
    ReasonedVerdict, sentences
    """
    fits = {"the declared model": before}
    if added:
        fits["the model with the effects"] = after
    slow = {model: _not_converged(model, fit) for model, fit in fits.items() if not fit.success}
    if not added:
        return judged, tuple(slow.values())
    far = [] if _at_its_minimum(after) else [slow["the model with the effects"]]
    said = (*_at_bounds(added, after), *far)
    if said and judged.verdict is Verdict.FOUND:
        reason = "; ".join([judged.reason, *said])
        judged = replace(judged, verdict=Verdict.PARTIAL, reason=reason)
    return judged, tuple(dict.fromkeys([*slow.values(), *said]))


def _at_bounds(added: Collection[str], after: Result) -> list[str]:
    """Say which declared parameters and which coefficients of effects stand at a bound."""
    names = tuple(f"{name}." for name in added)
    at_bound = [each for each in after.estimates if each.at_bound]
    own = [_held(each) for each in at_bound if each.label.startswith(names)]
    declared = [_held(each) for each in at_bound if not each.label.startswith(names)]
    said = []
    if declared:
        said.append(
            f"the fit with the effects ends with {in_a_row(declared)}: an effect may compensate "
            "for a value that the bound excludes, so widen the bound unless it is a physical limit"
        )
    if own:
        said.append(
            f"the fit ends with {in_a_row(own)}: at the end of its range, a law behaves like a "
            "part of another law, so the name of the effect is in doubt"
        )
    return said


def _at_its_minimum(fit: Result) -> bool:
    """Return whether the data cannot tell the last point of a fit from the minimum.

    Its derivatives promise that the squares still fall by no more than those of one standard error,
    as where noise of the simulations hides the last steps.
    """
    jacobian, at = fit.solution.jacobian, fit.solution.at
    if fit.success:
        return True
    if jacobian is None or at is None or len(at.residuals) != len(jacobian):
        return False
    residuals, degrees = at.residuals, len(jacobian) - jacobian.shape[1]
    step = np.linalg.lstsq(jacobian, -residuals, rcond=1e-12)[0]
    fall = residuals @ residuals - np.sum((residuals + jacobian @ step) ** 2)
    return bool(degrees > 0 and fall <= residuals @ residuals / degrees)


def _held(each: Estimate) -> str:
    return f"{each.label} at its {each.at_bound} bound, {each.value:.6g} {each.unit}".rstrip()


def _not_converged(model: str, fit: Result) -> str:
    """Say that a fit reached no solution, so that its values are not the best."""
    why = str(fit.solution.ending).partition(";")[0]
    return (
        f"the last fit of {model} did not converge ({why}): the values, intervals and errors are "
        "those of the last point that the fit reached"
    )
