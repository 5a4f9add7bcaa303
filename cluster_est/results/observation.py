"""Outputs that are known up to scale and offset, or down to a detection limit: what was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation
from workers.residuals.observed import scale_and_offset


@dataclass(frozen=True)
class ObservedScale:
    """The best scale and offset of an output in an experiment, a row of scales.parquet.

    Attributes
    ----------
    experiment, role, output
        Of what.
    scale, offset
        What was simulated is multiplied by the one, and the other added, to be compared; 1 and 0
        where they are not free.
    """

    experiment: str
    role: str
    output: str
    scale: float
    offset: float


def observed_scales(
    problem: Problem, simulations: Sequence[Simulation]
) -> tuple[ObservedScale, ...]:
    """Return the scales and offsets that were free, at simulated values."""
    found = []
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        trajectory = simulation.outcome.trajectory
        for output in experiment.outputs:
            if trajectory is None or not (output.free_scale or output.free_offset):
                continue
            values = trajectory.at(output.variable, output.times)
            scale, offset = scale_and_offset(output, values)
            found.append(
                ObservedScale(experiment.id, experiment.role, output.variable, scale, offset)
            )
    return tuple(found)


def observation_notes(problem: Problem, simulations: Sequence[Simulation]) -> tuple[str, ...]:
    """Say what was found of scales, and how many values a detection limit hides."""
    notes = []
    scales = observed_scales(problem, simulations)
    for name in dict.fromkeys(each.output for each in scales):
        own = [each for each in scales if each.output == name]
        values = np.array([each.scale for each in own])
        turned = [each.experiment for each in own if each.scale < 0.0]
        low, high = float(values.min()), float(values.max())
        size = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
        notes.append(f"{name} is compared up to scale or offset: scale {size} (scales.parquet)")
        if turned:
            notes.append(
                f"the best scale of {name} is negative in {', '.join(turned[:3])}: the signal is "
                "turned round; check the sign of the column"
            )
    for name, (hidden, count) in _hidden(problem).items():
        notes.append(
            f"{hidden} of {count} values of {name} are at or below its detection limit and say no "
            "more than that; residuals are not tested for what the model lacks"
        )
    return tuple(notes)


def has_censored_values(problem: Problem, experiments: Sequence[int]) -> bool:
    """Whether a training value is hidden by a detection limit: its residual has no normal law."""
    return any(
        bool(output.is_hidden.any())
        for e in experiments
        for output in problem.experiments[e].outputs
    )


def _hidden(problem: Problem) -> dict[str, tuple[int, int]]:
    """For each output with a detection limit, how many values it hides, of how many."""
    found: dict[str, tuple[int, int]] = {}
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if output.detection_limit is not None:
                hidden, count = found.get(output.variable, (0, 0))
                hidden += int(output.is_hidden.sum())
                found[output.variable] = hidden, count + len(output.values)
    return found
