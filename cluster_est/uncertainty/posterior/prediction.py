"""Where the outputs lie by the posterior: bands of what its draws simulate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.uncertainty.posterior.result import PosteriorResult, central
from workers.messages import FloatArray
from workers.messages.equality import by_content
from workers.residuals.observed import learnt_from, scale_and_offset

DRAWS = 200
"""Whose simulations make a band: the ends of a 95 % band, of which 5 of them lie beyond each, are
then known to about a tenth of its width."""
FEWEST_DRAWS = 100
AT_ONCE = 20
"""Draws whose simulations are asked for together."""
MOST_VALUES = 20_000_000
"""Simulated values that are kept at a time: 160 MB."""


@by_content
@dataclass(frozen=True)
class PredictedBand:
    """Where one output of an experiment lies, by the draws of a posterior.

    It is the uncertainty of the values alone: a new measurement has its noise besides.

    Attributes
    ----------
    experiment, output
        The experiment's index and the output's name.
    times, lower, median, upper : (n,)
        At the measured times.
    """

    experiment: int
    output: str
    times: FloatArray = field(repr=False)
    lower: FloatArray = field(repr=False)
    median: FloatArray = field(repr=False)
    upper: FloatArray = field(repr=False)


def predicted_bands(
    runner: Runner, problem: Problem, posterior: PosteriorResult, known: Mapping[str, float]
) -> tuple[PredictedBand, ...]:
    """Simulate all experiments at draws of a posterior, evenly spread over it.

    Parameters
    ----------
    runner
        For the simulations.
    problem
        Whose training experiments the posterior is of; held-out ones are predicted too.
    posterior
        With chains that have mixed.
    known
        Values by label of what only held-out experiments have; the same in every draw.

    Returns
    -------
    tuple of PredictedBand
        None of an experiment that cannot be simulated at every draw, and none at all where they
        would be too large to be kept.
    """
    samples = sum(len(o.times) for e in problem.experiments for o in e.outputs)
    count = min(DRAWS, MOST_VALUES // max(samples, 1))
    flat = posterior.values.reshape(-1, len(posterior.labels))
    if not posterior.mixed or count < FEWEST_DRAWS or len(flat) < count:
        return ()
    chosen = flat[np.linspace(0, len(flat) - 1, count).astype(int)]
    simulated: dict[tuple[int, str], list[FloatArray]] = {}
    everything, labels = tuple(range(len(problem.experiments))), posterior.labels
    for first in range(0, count, AT_ONCE):
        spaces = [
            make_space(problem, everything, {**known, **dict(zip(labels, draw, strict=True))})
            for draw in chosen[first : first + AT_ONCE].tolist()
        ]
        outcomes = runner.simulate(
            np.concatenate([space.physical(space.start) for space in spaces]),
            everything * len(spaces),
            "trajectory",
            "posterior",
            problem.effects,
        )
        if runner.interrupted:
            return ()
        for e, outcome in zip(everything * len(spaces), outcomes, strict=True):
            if outcome.ok and outcome.trajectory is not None:
                for output in problem.experiments[e].outputs:
                    own, training = (
                        outcome.trajectory.at(output.variable, each.times)
                        for each in (output, learnt_from(output))
                    )
                    scale, offset = scale_and_offset(output, own, training)
                    found = scale * own + offset
                    simulated.setdefault((e, output.variable), []).append(found)
    ends = central(posterior.confidence)
    times = {(e, o.variable): o.times for e in everything for o in problem.experiments[e].outputs}
    return tuple(
        PredictedBand(e, name, times[e, name], *np.quantile(np.array(drawn), ends, axis=0))
        for (e, name), drawn in simulated.items()
        if len(drawn) == count
    )
