"""Start values for the states after gaps, from measured outputs or from a simulation.

A record that was split is simulated once as a whole, with its inputs interpolated in the gaps. The
simulated states after a gap are accurate enough as start values of a search.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.gaps import begins_at
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.runner import Runner
from cluster_est.shooting.first_states import SAME_FIRST_STATE, line_between
from workers.messages import Experiment, FloatArray, Input, Output, OwnStart, Trajectory


def with_carried_states(environment: RunEnvironment, problem: Problem) -> Problem:
    """Return a problem whose parts after gaps start with the states of the simulated records.

    A part without such states keeps its start values.

    Parameters
    ----------
    environment
        Environment whose workers run the simulations, which are not logged.
    problem
        Problem from `split_at_gaps`.

    Raises
    ------
    ModelError, ExecutorError
        If no workers can be started.
    ProblemError
        If the model does not start with the given states.
    """
    wholes = {name: whole for name in _split_records(problem) if (whole := _whole(problem, name))}
    if not wholes or noise_names(problem):
        return problem
    probes = [_probe(next(e for e in problem.experiments if e.own_starts))]
    through = replace(problem, experiments=(*wholes.values(), *probes), gaps=())
    everything = tuple(range(len(through.experiments)))
    space = make_space(through, everything)
    values, count = space.physical(space.start), len(wholes)
    known = None if environment.earlier is None else environment.earlier.reset
    with environment.source.lease(through, environment.resources, known) as (pool, _):
        runner = Runner(pool)
        outcomes = runner.simulate(
            values[:count], everything[:count], "trajectory", "gaps", problem.effects
        )
        paths = {name: found.trajectory for name, found in zip(wholes, outcomes, strict=True)}
        carried = replace(
            problem,
            experiments=tuple(
                _begun(each, path) if (path := paths.get(each.record_id)) is not None else each
                for each in problem.experiments
            ),
        )
        part = next(e for e in carried.experiments if e.own_starts)
        inside = [p.target for p in through.parameters if not p.auxiliary]
        for own in part.own_starts:
            values[count:, inside.index(own.variable)] = own.start
        (begun,) = runner.simulate(
            values[count:], everything[count:], "trajectory", "gaps", problem.effects
        )
    check_begin(part, begun.trajectory)
    return carried


def _probe(part: Experiment) -> Experiment:
    """Return the first interval of a part, with the states as outputs."""
    measured = np.concatenate([output.times for output in part.outputs])
    end = float(np.min(measured[measured > part.start], initial=part.stop))
    times = np.array([part.start, end])
    outputs = tuple(Output(own.variable, times, np.zeros(2)) for own in part.own_starts)
    return replace(part, stop=end, outputs=outputs, role="train")


def check_begin(part: Experiment, path: Trajectory | None) -> None:
    """Refuse a model that computes its initial states and ignores the given values."""
    if path is None:
        return
    for own in part.own_starts:
        is_ = float(path.values[0, path.variables.index(own.variable)])
        if abs(is_ - own.start) > SAME_FIRST_STATE * max(abs(own.start), abs(is_), 1e-12):
            raise ProblemError(
                f"experiment {part.id!r}: must begin with the given states after a gap, but "
                f"{own.variable!r} was set to {own.start:.6g} and began at {is_:.6g}; export the "
                'model with fixed start values, or set gaps = "bridge" or another stop in '
                f"experiment {part.record_id!r}"
            )


def _split_records(problem: Problem) -> list[str]:
    return list(dict.fromkeys(e.record_id for e in problem.experiments if e.own_starts))


def _whole(problem: Problem, record: str) -> Experiment | None:
    """Return a split record as one experiment up to its last part; None without a first part.

    States and outputs are recorded at the measured times and at the starts of the parts.
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
    """Return the inputs of a record, joined from those of its parts."""
    found = []
    for own in given[0]:
        same = [other for inputs in given for other in inputs if other.variable == own.variable]
        times, first = np.unique(np.concatenate([i.times for i in same]), return_index=True)
        values = np.concatenate([i.values for i in same])[first]
        found.append(replace(own, times=times, values=values))
    return tuple(found)


def _begun(part: Experiment, path: Trajectory) -> Experiment:
    """Return a part with start values from the simulation of its record."""
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
