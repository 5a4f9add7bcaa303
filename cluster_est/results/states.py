"""The states of a model where a fit stands: residuals may depend on what nobody has measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.errors import ClusterEstError
from cluster_est.problem.search_space import make_space
from cluster_est.results.curves import StatePaths
from cluster_est.results.result import Result
from cluster_est.results.solver_error.measure import positions_of_few, simulate_with_solver
from cluster_est.running.resources import Resources
from workers.messages import Experiment, FloatArray, Output

MOST_KEPT = 1_000_000
"""Values of all states that are kept: 8 MB. Of more, every n-th measured time."""
MOST_RECORDED = 20_000_000
"""Values of all states at all times of the simulations: 160 MB. Of more, fewer experiments."""
MOST_SECONDS = 60.0
"""That the simulations took at the estimates, up to which they are repeated."""


def with_states(result: Result, resources: Resources) -> Result:
    """Add the states at the estimates, which a search does not record.

    Up to `MOST_EXPERIMENTS` training experiments are simulated once more, in a process of their
    own, with the states among the outputs. None are added where no whole record was fitted, the run
    was interrupted, that would take long, or the licence of the FMU limits its instances.
    """
    problem, chosen = result.problem, _chosen(result)
    if not chosen or resources.instances is not None:
        return result
    description, solver = problem.describe(), problem.model.solver
    states = description.states
    runs = tuple(_recording(problem.experiments[e], states) for e in chosen)
    space = make_space(problem, chosen, result.x)
    try:
        outcomes = simulate_with_solver(
            problem, runs, space.physical(space.start), solver, "trajectory", resources, beside=None
        )
    except ClusterEstError:  # the curves at the estimates say so too
        return result
    units = tuple(description.variables[name].unit for name in states)
    every = -(-sum(len(_times(run)) for run in runs) * len(states) // MOST_KEPT)
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        times, path = _times(run)[:: max(1, every)], outcome.trajectory
        if path is not None and len(times):
            values = np.column_stack([path.at(name, times) for name in states])
            found.append(StatePaths(run.id, states, units, times, values))
    return replace(result, states=tuple(found))


def _chosen(result: Result) -> tuple[int, ...]:
    """Return the experiments that are simulated once more; none where that is not worth it."""
    states = len(result.problem.describe().states)
    segmented = result.shooting is not None and not result.shooting.joined
    if not states or segmented or result.interrupted:
        return ()
    train = result.problem.indices("train")
    outcomes = {each.experiment: each.outcome for each in result.simulations}
    found, recorded, seconds = [], 0, 0.0
    for experiment in (train[position] for position in positions_of_few(len(train))):
        outcome = outcomes[experiment]
        seconds += outcome.seconds
        recorded += 0 if outcome.trajectory is None else len(outcome.trajectory.times) * states
        if recorded <= MOST_RECORDED:
            found.append(experiment)
    return tuple(found) if seconds <= MOST_SECONDS else ()


def _recording(experiment: Experiment, states: tuple[str, ...]) -> Experiment:
    """Return an experiment whose simulation records the states, as outputs without samples."""
    known = {output.variable for output in experiment.outputs}
    none = np.zeros(0)
    added = [Output(name, none, none) for name in states if name not in known]
    return replace(experiment, outputs=(*experiment.outputs, *added))


def _times(experiment: Experiment) -> FloatArray:
    """Return the times at which anything was measured."""
    measured = [output.times for output in experiment.outputs]
    return np.unique(np.concatenate([np.zeros(0), *measured]))
