"""Synthetic experiments: those that were measured, shortened, enlarged or with other outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.closed_loop.thresholds import PreparationThresholds
from cluster_est.problem.problem import Problem
from workers.messages import Experiment, FloatArray, Output


@dataclass(frozen=True)
class ShortenedCopy:
    """The first part of an experiment.

    Attributes
    ----------
    share
        Of its record.
    samples
        Of each output that it keeps at least.
    """

    share: float
    samples: int = 12

    def of(self, experiment: Experiment) -> Experiment:
        """Shorten an experiment."""
        stop = experiment.start + self.share * (experiment.stop - experiment.start)
        for output in experiment.outputs:
            if len(output.times):
                stop = max(stop, float(output.times[min(self.samples, len(output.times)) - 1]))
        outputs = [output.only(output.times <= stop) for output in experiment.outputs]
        name = f"{experiment.id} (first {self.share:.0%})"
        return replace(experiment, id=name, stop=stop, outputs=tuple(outputs))


@dataclass(frozen=True)
class EnlargedCopy:
    """An experiment whose inputs swing further about their means.

    Attributes
    ----------
    factor
        By how much.
    """

    factor: float

    def of(self, experiment: Experiment) -> Experiment:
        """Enlarge the inputs of an experiment."""
        inputs = tuple(
            replace(given, values=_swung(given.values, self.factor)) for given in experiment.inputs
        )
        name = f"{experiment.id} (inputs x {self.factor:g})"
        return replace(experiment, id=name, inputs=inputs)


SyntheticKind = ShortenedCopy | EnlargedCopy


def shortened_kinds(thresholds: PreparationThresholds) -> tuple[ShortenedCopy, ...]:
    """Return the shortened experiments that a start grows through, the shortest first."""
    return tuple(ShortenedCopy(share, thresholds.shortest) for share in thresholds.horizons)


def enlarged_kind(thresholds: PreparationThresholds) -> EnlargedCopy:
    """Return the enlarged experiments in which a model must stay bounded."""
    return EnlargedCopy(thresholds.enlargement)


def with_outputs(problem: Problem, change: Callable[[int, Output], Output]) -> Problem:
    """Return the problem with each output as a function of it and its experiment's index."""
    experiments = [
        replace(experiment, outputs=tuple(change(e, output) for output in experiment.outputs))
        for e, experiment in enumerate(problem.experiments)
    ]
    return replace(problem, experiments=tuple(experiments))


def _swung(values: FloatArray, factor: float) -> FloatArray:
    mean = values.mean()
    return np.asarray(mean + factor * (values - mean))
