"""The noise of a workbench's outputs, from a residual and the signals that were measured."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.statistics.noise import estimate_noise
from workers.messages import Experiment, FloatArray


def noise_of(workbench: LoopWorkbench, residuals: FloatArray) -> FloatArray:
    """Standard deviation of the noise of each output; see `estimate_noise`.

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
    return estimate_noise(residuals, workbench.records, measured_values(runs))


def measured_values(experiments: Iterable[Experiment]) -> FloatArray:
    """Return what was measured over sigma, stacked like the residuals of these experiments."""
    parts = [o.values / o.sigma for experiment in experiments for o in experiment.outputs]
    return np.concatenate(parts) if parts else np.zeros(0)
