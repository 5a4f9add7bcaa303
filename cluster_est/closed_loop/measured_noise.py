"""The noise of a workbench's outputs, from a residual and the signals that were measured."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.statistics.noise.estimate import SHORTEST_NOISE_RECORD, estimate_noise
from cluster_est.statistics.records import StackedRecords
from workers.messages import Experiment, FloatArray


def noise_of(workbench: LoopWorkbench, residuals: FloatArray) -> FloatArray:
    """Standard deviation of the noise of each output; see `estimate_noise`.

    Where all records of an output are too short to tell noise from misfit, it is the sigma that was
    given for it: the whole residual counted as noise would hide what is missing. Of thinned records
    it is no more than what was seen between the samples that their rows were made from: a residual
    that is smooth there may not be from row to row.

    Parameters
    ----------
    residuals : (N,)
        Of the training experiments.

    Returns
    -------
    (outputs,)
        In units of the residual.
    """
    runs = [workbench.problem.experiments[e] for e in workbench.train]
    found = estimate_noise(residuals, workbench.records, measured_values(runs))
    for number in range(len(found)):
        if is_given(workbench, number) and not is_told(workbench.records, number):
            found[number] = 1.0
    return np.fmin(found, _seen_between_samples(workbench))


def _seen_between_samples(workbench: LoopWorkbench) -> FloatArray:
    """Noise of each output in units of the residual, where records are thinned; else NaN."""
    names = workbench.records.outputs
    units: dict[str, list[FloatArray]] = {name: [] for name in names}
    for e in workbench.train:
        for output in workbench.problem.experiments[e].outputs:
            if output.noise_factors is not None:
                units[output.variable].append(output.sigmas / output.noise_factors)
    found = np.full(len(names), np.nan)
    for number, name in enumerate(names):
        if units[name] and name in workbench.noise_of_samples:
            unit = float(np.median(np.concatenate(units[name])))
            found[number] = workbench.noise_of_samples[name] / unit
    return found


def expected_noise(workbench: LoopWorkbench, residuals: FloatArray) -> FloatArray:
    """Return the noise of each output as it is declared, else as `noise_of` estimates it."""
    if workbench.sigma_declared:
        return np.ones(len(workbench.records.outputs))
    return noise_of(workbench, residuals)


def is_told(records: StackedRecords, output: int) -> bool:
    """Return whether some record of an output is long enough to tell noise from misfit."""
    lengths = [len(record.times) for record in records.items if record.output == output]
    return max(lengths, default=0) >= SHORTEST_NOISE_RECORD


def is_given(workbench: LoopWorkbench, output: int) -> bool:
    """Return whether an output's sigma is not 1 throughout, as it is where none is given."""
    return bool(np.any(workbench.sigmas[workbench.records.of_output(output)] != 1.0))


def measured_values(experiments: Iterable[Experiment]) -> FloatArray:
    """Return what was measured over sigma, stacked like the residuals of these experiments."""
    parts = [o.values / o.sigmas for experiment in experiments for o in experiment.outputs]
    return np.concatenate(parts) if parts else np.zeros(0)
