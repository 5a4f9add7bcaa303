"""Evidence by refits: what a rival really makes of an input, not to first order alone.

A search picks the input of which it expects the most, and so those of which it expects too much,
where outputs are no straight functions of the parameters. So the leading inputs are looked at once
more: the outputs that one model predicts take the place of measurements, and each other model is
fitted to them and to the earlier experiments. By how much its sum of squares grows is twice the
evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.experiment_design.criteria import expected_probabilities
from cluster_est.experiment_design.models import FittedCandidate, NoiseOfOutputs
from cluster_est.experiment_design.prediction import own_starts
from cluster_est.experiment_design.queue import DesignQueue
from cluster_est.experiment_design.search import ScoredCandidate
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.search_state import SearchRequest
from workers.messages import Experiment, FloatArray, Output

REFIT = LeastSquares(trials=1, max_iterations=10, ftol=1e-5, xtol=1e-5, differences="forward")
LEADING = 3
"""Inputs that are looked at once more, at most."""
CONFIRMED = 0.02
"""By which the expected probability may be lower than it seemed."""


def confirmed_choice(
    queue: DesignQueue,
    models: Sequence[FittedCandidate],
    ranked: Sequence[ScoredCandidate],
    noise: NoiseOfOutputs,
) -> tuple[ScoredCandidate, FloatArray]:
    """Return the best input by refits, and its evidence, (true model, rival).

    The next best is looked at where one falls behind what it promised.

    Parameters
    ----------
    queue, models, noise
        Where models are fitted, which, and with what noise.
    ranked
        Inputs that have been scored, the best first; at least one.
    """
    weights = np.array([fitted.model.weight for fitted in models])
    best: tuple[float, ScoredCandidate, FloatArray] | None = None
    for each in ranked[:LEADING]:
        if best is not None and best[0] >= each.value - CONFIRMED:
            break
        evidence = refitted_evidence(queue, models, each, noise)
        value = float(np.average(expected_probabilities(evidence, weights), weights=weights))
        if best is None or value > best[0]:
            best = (value, each, evidence)
    assert best is not None
    return best[1], best[2]


def refitted_evidence(
    queue: DesignQueue,
    models: Sequence[FittedCandidate],
    scored: ScoredCandidate,
    noise: NoiseOfOutputs,
) -> FloatArray:
    """Return the evidence of one input for each model against each rival, by refits.

    Where a rival cannot be fitted it is what derivatives say.
    """
    count = len(models)
    found = np.zeros((count, count))
    earlier = _weighted(models[0], noise)
    measured = [_as_measured(scored, i) for i in range(count)]
    alone, spaces, pairs = [], [], []
    for j, rival in enumerate(models):
        problem = replace(rival.model.problem, experiments=(*earlier, *measured), cost=SumSquared())
        first = tuple(range(len(earlier)))
        alone.append(make_space(problem, first, starts=rival.space.estimates(rival.x)))
        for i in range(count):
            if i != j:
                starts = own_starts(rival, measured[i].id)
                spaces.append(make_space(problem, (*first, len(earlier) + i), starts=starts))
                pairs.append((i, j))
    requests = [SearchRequest("refits", REFIT, space) for space in (*alone, *spaces)]
    solutions = queue.use(
        (*earlier, *measured), "checking the best input", lambda runner: runner.run(requests)
    )
    before = [solution.cost for solution in solutions[:count]]
    for (i, j), solution in zip(pairs, solutions[count:], strict=True):
        if np.isfinite([solution.cost, before[j]]).all():
            found[i, j] = max(0.5 * (solution.cost - before[j]), 0.0)
        else:
            found[i, j] = scored.evidence[i, j]
    return found


def _weighted(fitted: FittedCandidate, noise: NoiseOfOutputs) -> tuple[Experiment, ...]:
    """The training experiments, whose sigmas are those of the noise that is reckoned with."""
    problem = fitted.model.problem
    return tuple(
        replace(
            problem.experiments[e],
            outputs=tuple(_with_noise(o, noise) for o in problem.experiments[e].outputs),
        )
        for e in problem.indices("train")
    )


def _with_noise(output: Output, noise: NoiseOfOutputs) -> Output:
    factor = noise.over_sigma(output.variable)
    relative = output.relative_sigma * factor
    return replace(output, sigma=output.sigma * factor, relative_sigma=relative)


def _as_measured(scored: ScoredCandidate, model: int) -> Experiment:
    """The experiment, with what a model predicts in the place of measurements."""
    experiment, outputs = scored.candidate.experiment, []
    first = 0
    for output in experiment.outputs:
        rows = slice(first, first + len(output.times))
        values = output.sigma * scored.predicted[model].outputs[rows]
        outputs.append(replace(output, values=np.ascontiguousarray(values)))
        first = rows.stop
    name = f"{experiment.id} as model {model + 1} has it"
    return replace(experiment, id=name, outputs=tuple(outputs), bounds=())
