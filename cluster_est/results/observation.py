"""Tables and notes on scales, offsets, categories and values below a detection limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.results.output_errors import Simulation, fitted_categories, simulated_values
from workers.messages import FloatArray
from workers.residuals.observed import learnt_from, scale_and_offset

MOST_PAIRED = 2000
"""Largest number of samples whose pairs are counted; more samples are thinned evenly to it."""


@dataclass(frozen=True)
class ObservedScale:
    """The best scale and offset of an output in an experiment, a row of scales.parquet.

    Attributes
    ----------
    experiment, role, output
        The output, and the id and role of the experiment.
    scale, offset
        scale * simulated + offset is compared with the measured values; 1 and 0 if not free.
    """

    experiment: str
    role: str
    output: str
    scale: float
    offset: float


@dataclass(frozen=True)
class ObservedCategory:
    """One category of an ordinal output, a row of categories.parquet.

    Attributes
    ----------
    experiment, role, output
        The output, and the id and role of the experiment.
    category
        The measured value.
    samples
        Number of samples with this value; for a held-out part of a record, in its training part.
    lower, upper
        The best bounds of the simulated values; infinite at the ends.
    """

    experiment: str
    role: str
    output: str
    category: float
    samples: int
    lower: float
    upper: float


def observed_categories(
    problem: Problem, simulations: Sequence[Simulation]
) -> tuple[ObservedCategory, ...]:
    """Return the categories of ordinal outputs in these simulations."""
    found = []
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        for output in experiment.outputs:
            bounds = fitted_categories(output, simulation.outcome.trajectory)
            if bounds is None:
                continue
            counts = np.unique(learnt_from(output).values, return_counts=True)[1]
            rows = zip(bounds.categories, counts, bounds.lower, bounds.upper, strict=True)
            found += [
                ObservedCategory(
                    experiment.id,
                    experiment.role,
                    output.variable,
                    float(category),
                    int(count),
                    float(low),
                    float(high),
                )
                for category, count, low, high in rows
            ]
    return tuple(found)


def observed_scales(
    problem: Problem, simulations: Sequence[Simulation]
) -> tuple[ObservedScale, ...]:
    """Return the free scales and offsets in these simulations."""
    found = []
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        trajectory = simulation.outcome.trajectory
        for output in experiment.outputs:
            if trajectory is None or not (output.free_scale or output.free_offset):
                continue
            scale, offset = scale_and_offset(output, *simulated_values(output, trajectory))
            found.append(
                ObservedScale(experiment.id, experiment.role, output.variable, scale, offset)
            )
    return tuple(found)


def observation_notes(problem: Problem, simulations: Sequence[Simulation]) -> tuple[str, ...]:
    """Return notes on scales, on the order of ordinal values, and on detection limits."""
    notes = []
    scales = observed_scales(problem, simulations)
    for name in dict.fromkeys(each.output for each in scales):
        own = [each for each in scales if each.output == name]
        values = np.array([each.scale for each in own])
        turned = [each.experiment for each in own if each.scale < 0.0]
        low, high = float(values.min()), float(values.max())
        size = f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
        notes.append(
            f"{name} is compared up to a free scale or offset; the fitted scale is {size} "
            "(scales.parquet)"
        )
        if turned:
            notes.append(
                f"the best scale of {name} is negative in {', '.join(turned[:3])}, so the signal "
                "is inverted; check the sign of the column"
            )
    for name, (hidden, count) in _hidden(problem).items():
        notes.append(
            f"{hidden} of {count} values of {name} are at or below its detection limit and count "
            "as not detected; the residuals are therefore not tested for missing effects"
        )
    return (*notes, *_order_notes(problem, simulations))


def lack_normal_law(problem: Problem, experiments: Sequence[int]) -> bool:
    """Return whether some residuals are not normal: below a detection limit, or ordinal values."""
    return any(
        output.ordinal or bool(output.is_hidden.any())
        for e in experiments
        for output in problem.experiments[e].outputs
    )


def _hidden(problem: Problem) -> dict[str, tuple[int, int]]:
    """Return the numbers of hidden and of all values for each output with a detection limit."""
    found: dict[str, tuple[int, int]] = {}
    for experiment in problem.experiments:
        for output in experiment.outputs:
            if output.detection_limit is not None:
                hidden, count = found.get(output.variable, (0, 0))
                hidden += int(output.is_hidden.sum())
                found[output.variable] = hidden, count + len(output.values)
    return found


def _order_notes(problem: Problem, simulations: Sequence[Simulation]) -> list[str]:
    """Return notes on the share of ordinal pairs with the same order in the simulation."""
    ordered: dict[tuple[str, str], tuple[int, int]] = {}
    for simulation in simulations:
        experiment = problem.experiments[simulation.experiment]
        trajectory = simulation.outcome.trajectory
        for output in experiment.outputs:
            if trajectory is None or not output.ordinal:
                continue
            values = trajectory.at(output.variable, output.times)
            right, pairs = _ordered_pairs(output.values, values)
            before = ordered.get((output.variable, experiment.role), (0, 0))
            ordered[output.variable, experiment.role] = before[0] + right, before[1] + pairs
    roles = {"train": "training", "test": "held-out"}
    return [
        f"only the order of the values of {name} is compared: of the pairs of different "
        f"{roles[role]} values, {right / pairs:.3%} are simulated in the right order "
        "(categories.parquet)"
        for (name, role), (right, pairs) in ordered.items()
        if pairs
    ]


def _ordered_pairs(measured: FloatArray, simulated: FloatArray) -> tuple[int, int]:
    """Count the pairs with the same order in the simulation, and all pairs of different values."""
    few = np.linspace(0, len(measured) - 1, min(len(measured), MOST_PAIRED)).astype(int)
    first, second = measured[few], simulated[few]
    lower = first[:, None] < first
    right = lower & (second[:, None] < second)
    return int(right.sum()), int(lower.sum())
