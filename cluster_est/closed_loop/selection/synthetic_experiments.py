"""Experiments that nobody measured, made of those that somebody did: shortened and enlarged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from workers.messages import Experiment

LEAST_SAMPLES = 12


def shortened(experiment: Experiment, share: float) -> Experiment:
    """The first part of an experiment, with at least a dozen samples of each output."""
    stop = experiment.start + share * (experiment.stop - experiment.start)
    for output in experiment.outputs:
        if len(output.times):
            stop = max(stop, float(output.times[min(LEAST_SAMPLES, len(output.times)) - 1]))
    outputs = []
    for output in experiment.outputs:
        kept = output.times <= stop
        outputs.append(replace(output, times=output.times[kept], values=output.values[kept]))
    return replace(
        experiment, id=f"{experiment.id} (first {share:.0%})", stop=stop, outputs=tuple(outputs)
    )


def enlarged(experiment: Experiment, factor: float) -> Experiment:
    """The same with inputs that swing further about their means."""
    inputs = tuple(
        replace(given, values=_swung(given.values, factor)) for given in experiment.inputs
    )
    return replace(experiment, id=f"{experiment.id} (inputs x {factor:g})", inputs=inputs)


def _swung(values: np.ndarray, factor: float) -> np.ndarray:
    mean = values.mean()
    return np.asarray(mean + factor * (values - mean))
