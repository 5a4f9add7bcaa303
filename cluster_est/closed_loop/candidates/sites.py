"""Sites where something could be missing and would be seen, and the forms that may stand there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.thresholds import CandidateThresholds
from cluster_est.problem.problem import Problem
from workers.effects.forms import FORMS, EffectForm
from workers.effects.site import EffectSite, open_pairs, open_sites
from workers.fmu.description import ModelDescription


def candidate_sites(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    settings: LoopSettings,
) -> list[EffectSite]:
    """Return all sites, those of a user's choice if there is one."""
    pairs = pair_sites(problem, description, trajectories, settings)
    return [*single_sites(problem, description, trajectories, settings), *pairs]


def single_sites(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    settings: LoopSettings,
) -> list[EffectSite]:
    """Return the sites that are no pairs of states."""
    train = [problem.experiments[e] for e in problem.indices("train")]
    driven = {given.variable for e in train for given in e.inputs}
    driven = {name for name in driven if all(trajectory.has(name) for trajectory in trajectories)}
    measured = {output.variable for e in train for output in e.outputs}
    estimated = {p.target for p in problem.parameters if not p.fixed}
    wanted = {
        "derivative": _moving(description, trajectories, settings),
        "input": driven,
        "parameter": estimated - set(description.states),
        "output": set(),
    }
    offered = open_sites(description, problem.model.interface, measured)
    sites = [site for site in offered if site.target in wanted[site.kind]]
    sites += [EffectSite("output", name) for name in sorted(measured)]
    return [site for site in sites if not settings.sites or str(site) in settings.sites]


def pair_sites(
    problem: Problem,
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    settings: LoopSettings,
) -> list[EffectSite]:
    """Return the pairs of states between which a force could be missing, in either order."""
    moving = _moving(description, trajectories, settings)
    sites: list[EffectSite] = []
    for site in open_pairs(description, problem.model.interface):
        if set(site.targets) <= moving:
            sites += [site, EffectSite("pair", *reversed(site.targets))]
    return [site for site in sites if not settings.sites or str(site) in settings.sites]


def forms_at(
    site: EffectSite, problem: Problem, description: ModelDescription, settings: LoopSettings
) -> list[EffectForm]:
    """Return the forms to try at a site, those of a user's choice if there is one."""
    exchange = problem.model.interface == "model_exchange"
    stops = exchange or description.variable_steps
    return [
        form
        for (kind, name), form in FORMS.items()
        if kind == site.kind
        and (not settings.forms or name in settings.forms)
        and (stops or not form.memory)  # it has kinks between the samples
    ]


def _moving(
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    settings: LoopSettings,
) -> set[str]:
    tolerance = settings.thresholds.candidates.kinematic
    return set(description.states) - kinematic_states(trajectories, tolerance)


def kinematic_states(
    trajectories: Sequence[LinearisedTrajectory],
    tolerance: float = CandidateThresholds.kinematic,
) -> set[str]:
    """States whose derivative is another state: nothing can be missing there."""
    found: set[str] = set()
    for trajectory in trajectories[:1]:
        linear = trajectory.linear
        if linear is None:
            continue
        for i, name in enumerate(linear.state_names):
            j = int(np.argmax(linear.A[0, i]))
            row = np.abs(linear.A[:, i] - np.eye(len(linear.state_names))[j]).max()
            driven = np.abs(linear.B[:, i]).max(initial=0.0)
            size = np.abs(linear.derivatives[:, i]).max()
            gap = np.abs(linear.derivatives[:, i] - linear.states[:, j]).max()
            if i != j and gap <= tolerance * size and max(row, driven) < 1e-4:
                found.add(name)
    return found
