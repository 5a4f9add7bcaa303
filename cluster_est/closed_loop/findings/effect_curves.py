"""Curves of the effects that were found, beside what the residuals ask for without a form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import (
    LinearisedTrajectory,
    integrated_states,
    pooled,
)
from cluster_est.closed_loop.findings.free_values import free_values
from cluster_est.closed_loop.fitter import FittedModel
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.errors import ClusterEstError
from cluster_est.results.fit_tables import EffectCurve
from cluster_est.results.result import Result
from cluster_est.results.shapes.effect_shapes import effect_shapes, with_evidence
from workers.effects.site import EffectSite, difference, split_variable
from workers.messages import FloatArray


def effect_curves(
    workbench: LoopWorkbench, fitted: FittedModel, result: Result
) -> tuple[EffectCurve, ...]:
    """Compute the curves of all effects of a model that the loop has added to.

    Parameters
    ----------
    workbench, fitted
        The model with the effects, where the search ended: its experiments are simulated once more,
        for the range of their signals and for the directions of free values.
    result
        Of its last fit: values of the coefficients, and their covariance.
    """
    if not fitted.added:
        return ()
    try:
        trajectories = workbench.trajectories(fitted)
    except ClusterEstError as error:
        why = f"its experiments cannot be simulated ({error})"
        return tuple(EffectCurve(c.effect.name, str(c.site), why_not=why) for c in fitted.added)

    def visited(site: EffectSite, name: str) -> FloatArray:
        found = [arguments(each, site, name) for each in trajectories]
        return np.concatenate([each for each in found if each is not None] or [np.zeros(0)])

    curves = effect_shapes(result, workbench.description, visited)
    sites = {c.effect.name: c.site for c in fitted.added}
    # free values follow from the linear systems, which a filter that corrects the states changes
    residuals = None if workbench.filtered else fitted.residuals
    return tuple(_shown(each, sites.get(each.effect), trajectories, residuals) for each in curves)


def arguments(trajectory: LinearisedTrajectory, site: EffectSite, name: str) -> FloatArray | None:
    """Values of an effect's argument along an experiment; of its own signal, before effects act.

    None where the experiment does not have it.
    """
    if name == "time":
        return trajectory.times
    if site.kind == "input" and name == site.target and name in trajectory.driven:
        return trajectory.driven[name]
    if site.kind == "output" and name == site.target:
        known = name in trajectory.names
        return trajectory.outputs[:, trajectory.names.index(name)] if known else None
    return pooled([trajectory], name) if trajectory.has(name) else None


def _shown(
    curve: EffectCurve,
    site: EffectSite | None,
    trajectories: Sequence[LinearisedTrajectory],
    residuals: FloatArray | None,
) -> EffectCurve:
    """A curve with its free values, where these can be had; not for one sign of a variable."""
    if curve.why_not or curve.positive or site is None:
        return curve
    values = [arguments(each, site, curve.variable) for each in trajectories]
    found = None if residuals is None else free_values(site, trajectories, values, residuals)
    curve = replace(curve, integral_of=_integral_of(curve.variable, trajectories))
    return curve if found is None else with_evidence(curve, *found)


def _integral_of(name: str, trajectories: Sequence[LinearisedTrajectory]) -> str:
    """The state whose integral a variable is; of a difference that of both."""
    speeds = {x: v for x, (v, _) in integrated_states(trajectories).items()}
    parts = [speeds[x] for x in split_variable(name, speeds)]
    return difference(*parts) if len(parts) > 1 else "".join(parts)
