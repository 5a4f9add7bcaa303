"""Starts of sensors' scales and offsets: the best ones at each start of the other unknowns.

A search that begins with a scale that is wrong by orders of magnitude, or by its sign, moves the
other parameters to where they do least harm before it has found the scale.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cluster_est.problem.effects.sensors import (
    NEUTRAL,
    OFFSET,
    SCALE,
    UnstartedSensor,
    unstarted_sensors,
)
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.running.runner import Runner
from workers.messages import FloatArray, Outcome
from workers.residuals.observed import best_scale_and_offset

AT_ONCE = 16
"""Starts whose trajectories are asked for together, so that they fit into the memory."""


def with_best_sensors(runner: Runner, space: SearchSpace, starts: FloatArray) -> FloatArray:
    """Return starts with the best scales and offsets of sensors that have no start of their own.

    Parameters
    ----------
    starts : (starts, unknowns)
        In search coordinates. Each is simulated once, if there is such a sensor; one that cannot be
        simulated, or that names another value, is left as it is.
    """
    sensors = unstarted_sensors(space)
    if not sensors or not len(starts):
        return starts
    changed = starts.copy()
    for first in range(0, len(starts), AT_ONCE):
        rows = range(first, min(first + AT_ONCE, len(starts)))
        values = [space.physical(_neutral(space, sensors, starts[row])) for row in rows]
        outcomes = runner.simulate(
            np.concatenate(values),
            space.experiments * len(rows),
            "trajectory",
            "sensors",
            space.problem.effects,
        )
        count = len(space.experiments)
        for k, row in enumerate(rows):
            own = outcomes[k * count : (k + 1) * count]
            for sensor in sensors:
                _start_sensor(space, sensor, own, changed[row])
    return changed


def _neutral(
    space: SearchSpace, sensors: Sequence[UnstartedSensor], start: FloatArray
) -> FloatArray:
    found = start.copy()
    for sensor in sensors:
        for i, name in ((sensor.scale, SCALE), (sensor.offset, OFFSET)):
            if i is not None:
                found[i] = space.unknowns[i].to_search(NEUTRAL[name])
    return found


def _start_sensor(
    space: SearchSpace, sensor: UnstartedSensor, outcomes: Sequence[Outcome], x: FloatArray
) -> None:
    """Write the best scale and offset of a sensor into a start, from all that it measured."""
    measured, simulated, sigmas = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    moving, given = sensor.offset is not None, _given_scale(space, sensor, x)
    for position in sensor.experiments:
        trajectory = outcomes[position].trajectory
        if trajectory is None:
            return
        for output in space.problem.experiments[space.experiments[position]].outputs:
            if output.variable == sensor.output and not output.ordinal:
                seen = ~output.is_hidden
                measured.append(output.values[seen])
                simulated.append(given * trajectory.at(output.variable, output.times)[seen])
                sigmas.append(output.sigmas[seen])
                moving |= output.free_offset
    parts = (np.concatenate(each) for each in (measured, simulated, sigmas))
    free = sensor.scale is not None and given == NEUTRAL[SCALE]
    scale, offset = best_scale_and_offset(*parts, free_scale=free, free_offset=moving)
    if not (np.isfinite(scale) and np.isfinite(offset) and scale != 0.0):
        return
    for i, value in ((sensor.scale, scale), (sensor.offset, offset)):
        if i is not None and x[i] == space.start[i]:
            found = float(
                np.clip(space.unknowns[i].to_search(value), space.lower[i], space.upper[i])
            )
            x[i] = found if np.isfinite(found) else x[i]


def _given_scale(space: SearchSpace, sensor: UnstartedSensor, x: FloatArray) -> float:
    """Return the scale that a start names; 1 if it names none."""
    i = sensor.scale
    if i is None or x[i] == space.start[i]:
        return NEUTRAL[SCALE]
    return space.unknowns[i].to_physical(float(x[i]))
