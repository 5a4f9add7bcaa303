"""How far what was measured goes from its mean, over its noise."""

from __future__ import annotations

import numpy as np

from cluster_est.problem.problem import Problem
from workers.messages import Output


def signal_to_noise(problem: Problem) -> float:
    """The root mean square, over outputs, of the spread of what was measured over its sigma."""
    ratios = [float(np.std(o.values)) / float(np.median(o.sigmas)) for o in _outputs(problem)]
    return float(np.sqrt(np.mean(np.square(ratios)))) or 1.0


def cost_of_constants(problem: Problem) -> float:
    """The sum of squares of constants in the place of all outputs of the training records."""
    parts = [np.sum(((o.values - np.mean(o.values)) / o.sigmas) ** 2) for o in _outputs(problem)]
    return float(sum(parts))


def _outputs(problem: Problem) -> list[Output]:
    found = [o for e in problem.experiments if e.role == "train" for o in e.outputs]
    return [o for o in found if len(o.times)]
