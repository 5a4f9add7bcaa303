"""The search space of segments: the unknowns of the fit, then the initial states of segments.

The unknowns of the fit keep their order and labels, so the first entries of a point are a point of
the fit.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.problem.parameter import Parameter
from cluster_est.problem.search_space import SearchSpace
from cluster_est.problem.unknowns import StateContinuity, StateEnd, Unknown
from cluster_est.shooting.record_segments import SegmentedProblem
from workers.messages import FloatArray


def segment_values(segmented: SegmentedProblem, train: SearchSpace) -> FloatArray:
    """Return the start values before the states are known: (segments, parameters).

    Parameters
    ----------
    segmented, train
        The problem in segments, and the search space of the fit.
    """
    columns = {p.name: i for i, p in enumerate(segmented.problem.parameters)}
    old = [columns[p.name] for p in train.problem.parameters]
    position = {record: i for i, record in enumerate(train.experiments)}
    base = np.empty((len(segmented.segments), len(columns)))
    for row, segment in enumerate(segmented.segments):
        base[row, old] = train.base[position[segment.record]]
        given = dict(train.problem.experiments[segment.record].values)
        for parameter in segmented.states.added:
            names = [n for n, s in segmented.states.owner.items() if s == parameter.target]
            known = [given[name] for name in names if name in given]
            base[row, columns[parameter.name]] = float(known[0]) if known else parameter.start
    return base


def make_segment_space(
    segmented: SegmentedProblem,
    train: SearchSpace,
    starts: FloatArray,
    spread: FloatArray,
) -> SearchSpace:
    """Return the space of a problem in segments.

    Parameters
    ----------
    segmented, train
        The problem in segments, and the search space of the fit.
    starts : (segments, states)
        Start values of the states; those of first segments are not used.
    spread : (states,)
        Standard deviation of each state along the records.
    """
    problem, states = segmented.problem, segmented.states
    columns = {p.name: i for i, p in enumerate(problem.parameters)}
    unknowns = _of_fit(segmented, train, columns)
    ends: list[StateEnd] = []
    for position, segment in enumerate(segmented.segments):
        if segment.number == 0:
            continue
        before = segmented.segments[position - 1]
        for j, name in enumerate(states.names):
            start = float(starts[position, j])
            ends.append(
                StateEnd(
                    experiment=position - 1,
                    row=before.ends[j],
                    compared=0.0,
                    sigma=before.sigmas[j],
                    unknown=len(unknowns),
                    scale=float(spread[j]),
                )
            )
            unknowns.append(
                Unknown(
                    label=f"{name}[{segment.experiment.id}]",
                    parameter=Parameter(name, start, variable=name),
                    column=columns[states.parameters[j].name],
                    experiments=(position,),
                    start=start,
                    size=float(spread[j]),
                )
            )
    everything = tuple(range(len(segmented.segments)))
    base = segment_values(segmented, train)
    return SearchSpace(
        problem, everything, tuple(unknowns), base, continuity=StateContinuity(tuple(ends))
    )


def weighted(space: SearchSpace, weight: float, spread: FloatArray | None = None) -> SearchSpace:
    """Return the space with another weight of the differences between segments.

    Parameters
    ----------
    space
        Search space of segments.
    weight
        Weight of a difference of one spread of a state.
    spread : (states,)
        New spread of the states; None to keep it.
    """
    known = space.continuity
    assert known is not None
    ends = known.ends
    if spread is not None:
        count = len(spread)
        ends = tuple(replace(end, scale=float(spread[i % count])) for i, end in enumerate(ends))
    return replace(space, continuity=StateContinuity(ends, weight))


def states_alone(segmented: SegmentedProblem, space: SearchSpace) -> SearchSpace:
    """Return the space in which only the states are unknown; parameters keep their start values."""
    names = segmented.states.owner
    kept = [i for i, u in enumerate(space.unknowns) if u.parameter.target in names]
    place = {old: new for new, old in enumerate(kept)}
    base = space.base.copy()
    for i, unknown in enumerate(space.unknowns):
        if i not in place:
            base[list(unknown.experiments), unknown.column] = unknown.start
    known = space.continuity
    assert known is not None
    ends = tuple(replace(end, unknown=place[end.unknown]) for end in known.ends)
    return SearchSpace(
        space.problem,
        space.experiments,
        tuple(space.unknowns[i] for i in kept),
        base,
        continuity=StateContinuity(ends, known.weight),
    )


def with_states(segmented: SegmentedProblem, space: SearchSpace, x: FloatArray) -> SearchSpace:
    """Return the space that starts with these states, in the order of `states_alone`."""
    names = segmented.states.owner
    start = space.start.copy()
    start[[u.parameter.target in names for u in space.unknowns]] = x
    return space.starting_at(start)


def _of_fit(
    segmented: SegmentedProblem, train: SearchSpace, columns: dict[str, int]
) -> list[Unknown]:
    """Return the fit's unknowns: parameters act on all segments, states on first segments."""
    position = {record: i for i, record in enumerate(train.experiments)}
    found = []
    for unknown, typical in zip(train.unknowns, train.typical.tolist(), strict=True):
        size = typical if unknown.start else unknown.size  # if it is also 0, it is measured later
        is_state = unknown.parameter.target in segmented.states.owner
        inside = tuple(
            row
            for row, segment in enumerate(segmented.segments)
            if position[segment.record] in unknown.experiments
            and (segment.number == 0 or not is_state)
        )
        column = columns[unknown.parameter.name]
        found.append(replace(unknown, column=column, experiments=inside, size=size))
    return found
