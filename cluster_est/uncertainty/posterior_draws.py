"""What was drawn from a posterior, and where the outputs lie by it: bands of simulated draws."""

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
"""Autocorrelation times that a chain must be long, or the time itself is not known (the advice of
D. Foreman-Mackey et al., doi:10.1086/670067, and of emcee's documentation)."""
SHRINKS = 1.05
"""Largest shrink factor of chains that have mixed; Vehtari et al. advise 1.01 for four long chains,
which halves of walkers of a few autocorrelation times cannot reach by chance alone."""


@dataclass(frozen=True)
class PosteriorInterval:
    """What the draws say of one unknown, in physical units.

    Attributes
    ----------
    label, value
        Its label, and its estimate by the fit.
    mean, std_error, median, lower, upper
        Of the draws, with the ends of the interval that holds the central part of them; NaN where
        the chains have not mixed.
    autocorrelation_time
        In steps.
    shrink_factor
        See `split_shrink_factors`.
    effective
        Number of independent draws that are worth as much.
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
        Of the unknowns.
    values : (steps, walkers, unknowns)
        Physical values, without the steps before the walkers had forgotten their starts.
    log_densities : (steps, walkers)
        In search coordinates, but for a constant.
    intervals
        Of all unknowns.
    confidence
        Of the intervals.
    steps, discarded
        Of each walker: in all, and those that are left out.
    failures, asked
        Points that could not be simulated, and that were asked for.
    why_not
        The reason why there are no draws; "" if there are some.
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
        """There are draws."""
        return bool(self.values.size)

    @property
    def slowest(self) -> float:
        """The longest autocorrelation time, in steps."""
        return max((each.autocorrelation_time for each in self.intervals), default=np.inf)

    @property
    def mixed(self) -> bool:
        """The chains are long enough, and all tell the same."""
        return is_mixed(len(self.values), self.intervals)

    @property
    def thinned(self) -> tuple[FloatArray, FloatArray, int]:
        """Nearly independent draws: values, log densities, and how many steps lie between them."""
        step = int(max(1.0, self.slowest / 2.0)) if np.isfinite(self.slowest) else 1
        return self.values[::step], self.log_densities[::step], step

    def to_arviz(self) -> Any:
        """Return the draws as ArviZ has them: each walker is a chain, each unknown a variable.

        The walkers of an ensemble move by each other, so that they are no independent chains:
        judge mixing by `intervals`, and by ArviZ's ranks with care.

        Returns
        -------
        DataTree or InferenceData
            As the version of ArviZ has it, with the groups "posterior" and "sample_stats", whose
            `lp` is the log density in search coordinates.

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
        """Sentences on how it went, and why there is no interval."""
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
    """Return whether so many steps tell of all unknowns, and all walkers tell the same."""
    slowest = max((each.autocorrelation_time for each in intervals), default=np.inf)
    return bool(kept >= LEAST_CHAIN_LENGTH * slowest and all(each.mixed for each in intervals))


DRAWS_OF_BAND = 200
"""Draws whose simulations make a band: the ends of a 95 % band, of which 5 of them lie beyond each,
are then known to about a tenth of its width."""
FEWEST_DRAWS = 100
DRAWS_AT_ONCE = 20
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
