"""Starts for the states behind gaps: as an output measures them, else carried on through the gap.

A record that was split is simulated once as a whole, with its inputs drawn through its gaps. Where
it then stands behind a gap is near enough to begin a search with.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.problem.gaps import begins_at
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.runner import Runner
from cluster_est.shooting.first_states import line_between
from workers.messages import Experiment, FloatArray, Input, Output, OwnStart, Trajectory


def with_carried_states(environment: RunEnvironment, problem: Problem) -> Problem:
    """Return a problem whose parts behind gaps start as their simulated records stand there.

    A part of which nothing is found keeps its starts.

    Parameters
    ----------
    environment
        Whose workers simulate; nothing of it is logged.
    problem
        As `split_at_gaps` has left it.

    Raises
    ------
    ModelError, ExecutorError
        If there are no workers to be had.
    """
    wholes = {name: whole for name in _split_records(problem) if (whole := _whole(problem, name))}
    if not wholes or noise_names(problem):
        return problem
    through = replace(problem, experiments=tuple(wholes.values()), gaps=())
    everything = tuple(range(len(wholes)))
    space = make_space(through, everything)
    known = None if environment.earlier is None else environment.earlier.reset
    with environment.source.lease(through, environment.resources, known) as (pool, _):
        outcomes = Runner(pool).simulate(
            space.physical(space.start), everything, "trajectory", "gaps", problem.effects
        )
    paths = {name: found.trajectory for name, found in zip(wholes, outcomes, strict=True)}
    return replace(
        problem,
        experiments=tuple(
            _begun(each, path) if (path := paths.get(each.record_id)) is not None else each
            for each in problem.experiments
        ),
    )


def _split_records(problem: Problem) -> list[str]:
    return list(dict.fromkeys(e.record_id for e in problem.experiments if e.own_starts))


def _whole(problem: Problem, record: str) -> Experiment | None:
    """Return a split record as one experiment up to its last part; None without its beginning.

    It records the states, and the outputs, where outputs were measured and where parts begin.
    """
    parts = [e for e in problem.experiments if e.record_id == record]
    first = next((e for e in parts if not e.own_starts), None)
    if first is None:
        return None
    states = [own.variable for part in parts for own in part.own_starts]
    outputs = [output.variable for part in parts for output in part.outputs]
    behind = [part.start for part in parts if part.own_starts]
    stop = max(behind)
    measured = [output.times for part in parts for output in part.outputs]
    times = np.unique(np.concatenate([*measured, behind]))
    times = times[(times >= first.start) & (times <= stop)]
    looked_at = dict.fromkeys([*states, *outputs])
    return replace(
        first,
        id=record,
        record="",
        role="train",
        stop=stop,
        inputs=_together([part.inputs for part in parts]),
        signals=_together([part.signals for part in parts]),
        outputs=tuple(Output(name, times, np.zeros(len(times))) for name in looked_at),
        gaps="bridge",
    )


def _together(given: Sequence[tuple[Input, ...]]) -> tuple[Input, ...]:
    """Return the inputs of the parts of a record as those of the record."""
    found = []
    for own in given[0]:
        same = [other for inputs in given for other in inputs if other.variable == own.variable]
        times, first = np.unique(np.concatenate([i.times for i in same]), return_index=True)
        values = np.concatenate([i.values for i in same])[first]
        found.append(replace(own, times=times, values=values))
    return tuple(found)


def _begun(part: Experiment, path: Trajectory) -> Experiment:
    """Return a part with starts for what is its own, from the simulation of its record."""
    columns = {name: path.values[:, i] for i, name in enumerate(path.variables)}
    at = int(np.searchsorted(path.times, part.start))
    starts = tuple(_start(own, part, columns, at) for own in part.own_starts)
    return replace(part, own_starts=starts)


def _start(own: OwnStart, part: Experiment, columns: Mapping[str, FloatArray], at: int) -> OwnStart:
    state = columns.get(own.variable)
    outputs = [output for output in part.outputs if begins_at(output, part.start)]
    if state is None or at >= len(state) or own.variable in [o.variable for o in outputs]:
        return own
    start = float(state[at])
    for output in outputs:
        line = line_between(columns[output.variable], state)
        if line is not None:
            start = line[0] + line[1] * float(output.values[0])
            break
    if not np.isfinite(start):
        return own
    return replace(own, start=min(max(start, own.lower), own.upper))
