"""Results of posterior sampling, and bands of the outputs from simulated draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from workers.messages import FloatArray
from workers.messages.types import by_content
from workers.residuals.observed import learnt_from, scale_and_offset

LEAST_CHAIN_LENGTH = 50.0
"""Least length of a chain in autocorrelation times; in a shorter chain, this time is not known (D.
Foreman-Mackey et al., doi:10.1086/670067, and the documentation of emcee)."""
SHRINKS = 1.05
"""Largest shrink factor of mixed chains. Vehtari et al. recommend 1.01 for four long chains; halves
of walkers with a few autocorrelation times exceed this by chance."""


@dataclass(frozen=True)
class PosteriorInterval:
    """The posterior of one unknown, in physical units.

    Attributes
    ----------
    label, value
        Label of the unknown, and its estimate from the fit.
    mean, std_error, median, lower, upper
        Statistics of the draws, with the ends of the central interval; NaN if the chains have not
        mixed.
    autocorrelation_time
        Autocorrelation time in steps.
    shrink_factor
        See `split_shrink_factors`.
    effective
        Effective number of independent draws.
    """

    label: str
    value: float
    mean: float
    std_error: float
    median: float
    lower: float
    upper: float
    autocorrelation_time: float
    shrink_factor: float
    effective: float

    @property
    def mixed(self) -> bool:
        return self.shrink_factor <= SHRINKS


@by_content
@dataclass(frozen=True)
class PosteriorResult:
    """Draws from the posterior of all unknowns.

    Attributes
    ----------
    labels
        Labels of the unknowns.
    values : (steps, walkers, unknowns)
        Physical values, without the discarded first steps.
    log_densities : (steps, walkers)
        Log densities in search coordinates, up to a constant.
    intervals
        Intervals of all unknowns.
    confidence
        Confidence of the intervals.
    steps, discarded
        Number of steps of each walker, and number of discarded steps.
    failures, asked
        Number of points that could not be simulated, and number of requested points.
    why_not
        The reason why there are no draws; "" if there are draws.
    """

    labels: tuple[str, ...]
    values: FloatArray = field(repr=False)
    log_densities: FloatArray = field(repr=False)
    intervals: tuple[PosteriorInterval, ...]
    confidence: float
    steps: int
    discarded: int
    failures: int
    asked: int
    why_not: str = ""

    def __bool__(self) -> bool:
        """Return whether there are draws."""
        return bool(self.values.size)

    @property
    def slowest(self) -> float:
        """The longest autocorrelation time, in steps."""
        return max((each.autocorrelation_time for each in self.intervals), default=np.inf)

    @property
    def mixed(self) -> bool:
        """Whether the chains are long enough and agree with each other."""
        return is_mixed(len(self.values), self.intervals)

    @property
    def thinned(self) -> tuple[FloatArray, FloatArray, int]:
        """Nearly independent draws: values, log densities, and the number of steps between them."""
        step = int(max(1.0, self.slowest / 2.0)) if np.isfinite(self.slowest) else 1
        return self.values[::step], self.log_densities[::step], step

    def to_arviz(self) -> Any:
        """Return the draws for ArviZ: each walker is a chain, each unknown a variable.

        The moves of a walker depend on other walkers, so the chains are not independent. Use
        `intervals` to assess mixing, and the ranks of ArviZ only with care.

        Returns
        -------
        DataTree or InferenceData
            Depends on the version of ArviZ. It has the groups "posterior" and "sample_stats"; `lp`
            of the second is the log density in search coordinates.

        Raises
        ------
        ProblemError
            If ArviZ is not installed, or there are no draws.
        """
        if not self:
            raise ProblemError(f"posterior: there are no draws, because {self.why_not}")
        try:
            import arviz
        except ImportError:
            raise ProblemError(
                "to_arviz: needs ArviZ, which is not installed; run pip install "
                "'cluster-est[arviz]'"
            ) from None
        draws = np.moveaxis(self.values, 1, 0)  # (walkers, steps, unknowns)
        values = {label: draws[:, :, i] for i, label in enumerate(self.labels)}
        groups = {"posterior": values, "sample_stats": {"lp": self.log_densities.T}}
        if hasattr(arviz, "InferenceData"):  # before version 1
            return arviz.from_dict(**groups)
        return arviz.from_dict(groups)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the sampling, and on the reason if there is no interval."""
        if self.why_not:
            return (f"posterior: there are no draws, because {self.why_not}",)
        walkers, kept = self.values.shape[1], len(self.values)
        said = (
            f"posterior: {walkers} walkers of {self.steps:,} steps each, of which the first "
            f"{self.discarded:,} are discarded"
        )
        if self.failures:
            said += f"; {self.failures:,} of {self.asked:,} points could not be simulated"
        if self.mixed:
            least = min(each.effective for each in self.intervals)
            return (f"{said}; at least {least:,.0f} independent draws of each unknown",)
        worst = max(self.intervals, key=lambda each: each.autocorrelation_time)
        if not np.isfinite(self.slowest):
            return (
                f"{said}; there is no interval, because some walker never moved; use more steps",
            )
        if kept < LEAST_CHAIN_LENGTH * self.slowest:
            wanted = int(np.ceil(1.2 * LEAST_CHAIN_LENGTH * self.slowest * self.steps / kept))
            return (
                f"{said}; there is no interval, because the chains are too short: draws of "
                f"{worst.label} are correlated over {self.slowest:.0f} of {kept:,} steps, and a "
                f"chain must be {LEAST_CHAIN_LENGTH:.0f} times as long as this; set "
                f"uncertainty.posterior to at least {wanted}",
            )
        apart = max(self.intervals, key=lambda each: each.shrink_factor)
        return (
            f"{said}; there is no interval, because the walkers have not mixed, as happens with "
            f"several minima: they disagree on {apart.label} (shrink factor "
            f"{apart.shrink_factor:.2f}, which should be at most {SHRINKS:g}); use more steps, or "
            "narrower bounds",
        )


def central(confidence: float) -> tuple[float, float, float]:
    """Return the quantiles of the lower end, the median and the upper end of a central interval."""
    return 0.5 - 0.5 * confidence, 0.5, 0.5 + 0.5 * confidence


def is_mixed(kept: int, intervals: tuple[PosteriorInterval, ...]) -> bool:
    """Return whether the number of steps is sufficient for all unknowns, and all walkers agree."""
    slowest = max((each.autocorrelation_time for each in intervals), default=np.inf)
    return bool(kept >= LEAST_CHAIN_LENGTH * slowest and all(each.mixed for each in intervals))


DRAWS_OF_BAND = 200
"""Number of simulated draws for a band. Five draws lie beyond each end of a 95 % band, so an end is
accurate to about a tenth of the band's width."""
FEWEST_DRAWS = 100
DRAWS_AT_ONCE = 20
"""Number of draws that are simulated together."""
MOST_VALUES = 20_000_000
"""Largest number of simulated values in memory: 160 MB."""


@by_content
@dataclass(frozen=True)
class PredictedBand:
    """The posterior band of one output of an experiment.

    It contains the uncertainty of the parameters only, without the noise of new measurements.

    Attributes
    ----------
    experiment, output
        Index of the experiment, and name of the output.
    times, lower, median, upper : (n,)
        The measured times, and the band at these times.
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
    """Simulate all experiments at evenly spaced draws of a posterior.

    Parameters
    ----------
    runner
        Runs the simulations.
    problem
        The fitted problem; held-out experiments are also predicted.
    posterior
        The posterior of the training experiments.
    known
        Values by label that only held-out experiments have; they are the same in every draw.

    Returns
    -------
    tuple of PredictedBand
        Without experiments that cannot be simulated at every draw. Empty if the chains have not
        mixed, or if the bands need too much memory.
    """
    samples = sum(len(o.times) for e in problem.experiments for o in e.outputs)
    count = min(DRAWS_OF_BAND, MOST_VALUES // max(samples, 1))
    flat = posterior.values.reshape(-1, len(posterior.labels))
    if not posterior.mixed or count < FEWEST_DRAWS or len(flat) < count:
        return ()
    chosen = flat[np.linspace(0, len(flat) - 1, count).astype(int)]
    simulated: dict[tuple[int, str], list[FloatArray]] = {}
    everything, labels = tuple(range(len(problem.experiments))), posterior.labels
    for first in range(0, count, DRAWS_AT_ONCE):
        spaces = [
            make_space(problem, everything, {**known, **dict(zip(labels, draw, strict=True))})
            for draw in chosen[first : first + DRAWS_AT_ONCE].tolist()
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
