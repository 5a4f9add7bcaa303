"""Sites where something could be missing and would be seen, and the forms that may stand there."""

from __future__ import annotations

from collections.abc import Sequence

from cluster_est.closed_loop.candidates.kinematics import CONSTANT, integrated_states
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
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
    if not noise_names(problem):  # beside a filter nothing acts on what is measured
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
    kinks = (exchange or description.variable_steps) and not noise_names(problem)
    return [
        form
        for (kind, name), form in FORMS.items()
        if kind == site.kind
        and (name in settings.forms if settings.forms else not form.finer_than)
        and (kinks or not form.memory)  # between the samples
    ]


def _moving(
    description: ModelDescription,
    trajectories: Sequence[LinearisedTrajectory],
    settings: LoopSettings,
) -> set[str]:
    """The states in whose derivative something may be missing: where dx/dt = v, nothing can be."""
    tolerance = settings.thresholds.candidates.kinematic
    integrated = integrated_states(trajectories, tolerance)
    exact = {x for x, (_, factor) in integrated.items() if abs(factor - 1.0) < CONSTANT}
    return set(description.states) - exact
