"""The states of a model at the estimates, because residuals may depend on unmeasured states."""

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
"""Largest number of stored values of states: 8 MB. If there are more, every n-th measured time is
stored."""
MOST_RECORDED = 20_000_000
"""Largest number of values of states at all times of the simulations: 160 MB. If there are more,
fewer experiments are simulated."""
MOST_SECONDS = 60.0
"""Largest duration of the simulations at the estimates for which they are repeated."""


def with_states(result: Result, resources: Resources) -> Result:
    """Add the states at the estimates, which a search does not record.

    Up to `MOST_EXPERIMENTS` training experiments are simulated again in a separate process, with
    the states among the outputs. No states are added if the fit used segments, if the run was
    interrupted, if the simulations take long, or if the FMU's licence limits its instances.
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
    except ClusterEstError:  # then only the states are missing
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
    """Return the experiments to simulate again; see `with_states`."""
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
    """Return an experiment with the states as additional outputs without samples."""
    known = {output.variable for output in experiment.outputs}
    none = np.zeros(0)
    added = [Output(name, none, none) for name in states if name not in known]
    return replace(experiment, outputs=(*experiment.outputs, *added))


def _times(experiment: Experiment) -> FloatArray:
    """Return all measured times."""
    measured = [output.times for output in experiment.outputs]
    return np.unique(np.concatenate([np.zeros(0), *measured]))
