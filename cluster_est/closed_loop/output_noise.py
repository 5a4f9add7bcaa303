"""The noise of the outputs: from residuals and measured signals; where it grows with the signal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from cluster_est.closed_loop.fitter import FittedModel, Fitter, with_outputs
from cluster_est.problem.problem import Problem
from cluster_est.statistics.noise.estimate import SHORTEST_NOISE_RECORD, estimate_noise
from cluster_est.statistics.noise.growing_noise import NoiseGrowth, noise_growth
from cluster_est.statistics.records import StackedRecords
from cluster_est.toml import dotted
from workers.messages import Experiment, FloatArray, Output

NOISE_GROWTH = 2.0
"""Noise where a signal is large over that where it is small, from which a note is made. Theory:
with weights wrong by a factor of 2 in sigma, least squares loses a third of its efficiency; with
less, little."""

NOISE_GROWTH_P = 1e-6
"""Largest p-value for the same. Theory: a thousand outputs have a false note with 0.001."""


def noise_of(fitter: Fitter, residuals: FloatArray) -> FloatArray:
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
    runs = [fitter.problem.experiments[e] for e in fitter.train]
    found = estimate_noise(residuals, fitter.records, measured_values(runs))
    for number in range(len(found)):
        if is_given(fitter, number) and not is_told(fitter.records, number):
            found[number] = 1.0
    return np.fmin(found, _seen_between_samples(fitter))


def _seen_between_samples(fitter: Fitter) -> FloatArray:
    """Noise of each output in units of the residual, where records are thinned; else NaN."""
    names = fitter.records.outputs
    units: dict[str, list[FloatArray]] = {name: [] for name in names}
    for e in fitter.train:
        for output in fitter.problem.experiments[e].outputs:
            if output.noise_factors is not None:
                units[output.variable].append(output.sigmas / output.noise_factors)
    found = np.full(len(names), np.nan)
    for number, name in enumerate(names):
        if units[name] and name in fitter.noise_of_samples:
            unit = float(np.median(np.concatenate(units[name])))
            found[number] = fitter.noise_of_samples[name] / unit
    return found


def expected_noise(fitter: Fitter, residuals: FloatArray) -> FloatArray:
    """Return the noise of each output as it is declared, else as `noise_of` estimates it."""
    if fitter.sigma_declared:
        return np.ones(len(fitter.records.outputs))
    return noise_of(fitter, residuals)


def is_told(records: StackedRecords, output: int) -> bool:
    """Return whether some record of an output is long enough to tell noise from misfit."""
    lengths = [len(record.times) for record in records.items if record.output == output]
    return max(lengths, default=0) >= SHORTEST_NOISE_RECORD


def is_given(fitter: Fitter, output: int) -> bool:
    """Return whether an output's sigma is not 1 throughout, as it is where none is given."""
    return bool(np.any(fitter.sigmas[fitter.records.of_output(output)] != 1.0))


def measured_values(experiments: Iterable[Experiment]) -> FloatArray:
    """Return what was measured over sigma, stacked like the residuals of these experiments."""
    parts = [o.values / o.sigmas for experiment in experiments for o in experiment.outputs]
    return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True)
class GrowingNoise:
    """An output whose noise is larger where its signal is.

    Attributes
    ----------
    output, growth
        Its name, and by how much, in units of its residual.
    sigma, relative_sigma
        Of a sample, as in `Output`; NaN where they are not known.
    weighted
        Each sample takes its own; not where the user has given a sigma.
    """

    output: str
    growth: NoiseGrowth
    sigma: float
    relative_sigma: float
    weighted: bool

    @property
    def sentence(self) -> str:
        """Say how much it grows, and what becomes of it."""
        growth, name = self.growth, self.output
        times = f"{growth.loud / growth.quiet:.1f} times" if growth.quiet > 0.0 else "far above"
        said = (
            f"the noise of {name} grows with the signal: in the third of its samples with the "
            f"largest values it is {times} that in the third with the smallest"
        )
        both = f"{dotted('sigma', name)} = {self.sigma:.3g} and {dotted('relative_sigma', name)} = "
        both += f"{self.relative_sigma:.3g}"
        if self.weighted:
            return (
                f"{said}, so each sample was weighted with its own; write {both} into the "
                "experiments for a fit with the same weights"
            )
        said += ", and one sigma gives the loud ones too much weight"
        if np.isnan(self.sigma):
            larger = dotted("relative_sigma", name)
            return f"{said}; give it a larger {larger} beside {dotted('sigma', name)}"
        return f"{said}; about {both} would give each sample its own"


def growing_noise(
    fitter: Fitter, fitted: FittedModel, kept: npt.NDArray[np.bool_]
) -> tuple[GrowingNoise, ...]:
    """Return the outputs whose noise grows with their signal.

    Parameters
    ----------
    fitter, fitted
        Where, and the declared model.
    kept : (residuals,)
        The samples that are no outliers.
    """
    runs = [fitter.problem.experiments[e] for e in fitter.train]
    measured = measured_values(runs)
    found = []
    for output, name in enumerate(fitter.records.outputs):
        rows = fitter.records.of_output(output)
        rows = rows[kept[rows]]
        growth = noise_growth(fitted.residuals[rows], measured[rows])
        if growth.p >= NOISE_GROWTH_P or growth.loud < NOISE_GROWTH * growth.quiet:
            continue
        sigmas = fitter.sigmas[rows]
        known = growth.quiet > 0.0 and growth.part > 0.0 and np.ptp(sigmas) == 0.0
        sigma = _rounded(growth.constant * sigmas[0]) if known else np.nan
        relative = _rounded(growth.part) if known else np.nan
        weighted = known and not fitter.sigma_declared
        found.append(GrowingNoise(name, growth, sigma, relative, weighted))
    return tuple(found)


def with_own_sigmas(problem: Problem, growing: Sequence[GrowingNoise]) -> Problem:
    """Return the problem with a standard deviation for each sample of the outputs that need it."""
    own = {each.output: each for each in growing if each.weighted}

    def change(_: int, output: Output) -> Output:
        found = own.get(output.variable)
        if found is None:
            return output
        return replace(output, sigma=found.sigma, relative_sigma=found.relative_sigma)

    return with_outputs(problem, change)


def _rounded(value: float) -> float:
    """As it is written into a note, so that a fit with it has the same weights to the bit."""
    return float(f"{value:.3g}")
