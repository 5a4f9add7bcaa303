"""The noise of the outputs, from residuals and measured signals, and a residual beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtr

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.statistics.noise.estimate import SHORTEST_NOISE_RECORD, estimate_noise
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.residual_findings import from_to, large_sigma, small_sigma
from cluster_est.statistics.residual_tests import NOISY, SMALL_RMS_OVER_SIGMA, autocorrelation
from cluster_est.statistics.whitening import partial_autocorrelations
from workers.messages import FloatArray


def noise_of(fitter: Fitter, residuals: FloatArray) -> FloatArray:
    """Standard deviation of the noise of each output, in units of its residual: (outputs,).

    Where all records of an output are too short to tell noise from misfit, it is the sigma that was
    given for it: the whole residual counted as noise would hide what is missing. Of thinned records
    it is no more than what was seen between the samples that their rows were made from: a residual
    that is smooth there may not be from row to row. See `estimate_noise`.
    """
    found = estimate_noise(residuals, fitter.records, measured_values(fitter))
    for number in range(len(found)):
        if is_given(fitter, number) and not is_told(fitter.records, number):
            found[number] = 1.0
    return np.fmin(found, _seen_between_samples(fitter))


def _seen_between_samples(fitter: Fitter) -> FloatArray:
    """Noise of each output in units of the residual, where records are thinned; else NaN."""
    names = fitter.records.outputs
    found = np.full(len(names), np.nan)
    for number, name in enumerate(names):
        own = [o for run in fitter.runs for o in run.outputs if o.variable == name]
        units = [o.sigmas / o.noise_factors for o in own if o.noise_factors is not None]
        if units and name in fitter.noise_of_samples:
            unit = float(np.median(np.concatenate(units)))
            found[number] = fitter.noise_of_samples[name] / unit
    return found


def expected_noise(fitter: Fitter, residuals: FloatArray) -> FloatArray:
    """Return the noise of each output as it is declared, else as `noise_of` estimates it."""
    if fitter.sigma_declared:
        return np.ones(len(fitter.records.outputs))
    return noise_of(fitter, residuals)


def is_told(records: StackedRecords, output: int) -> bool:
    """Return whether some record of an output is long enough to tell noise from misfit."""
    own = (record for record in records.items if record.output == output)
    return any(len(record.times) >= SHORTEST_NOISE_RECORD for record in own)


def is_given(fitter: Fitter, output: int) -> bool:
    """Return whether an output's sigma is not 1 throughout, as it is where none is given."""
    return bool(np.any(fitter.sigmas[fitter.records.of_output(output)] != 1.0))


def measured_values(fitter: Fitter) -> FloatArray:
    """Return what was measured over sigma, stacked like the residuals."""
    parts = [o.values / o.sigmas for run in fitter.runs for o in run.outputs]
    return np.concatenate(parts) if parts else np.zeros(0)


ORDER = 5
"""Lags at which partial autocorrelations are looked at."""

WHITE = 0.05
"""Share of the squares that is left beside the white part where noise counts as white."""

WHITE_ERROR = 5.0
"""Error of the squared white part, over itself, times the root of the number of samples."""

COLOURED_SHARE = 0.8
"""Share of the variance above which the white part leaves no room for coloured noise: what is
left beside it is then something else."""

FIRST_ORDER = 0.1
"""Partial autocorrelation beyond lag 1 up to which noise counts as of first order. Benchmark."""

DRIFT = 0.95
"""Correlation from one sample to the next above which a residual is a drift or an offset, and no
noise of a sensor, which forgets within some twenty samples."""

CHANCE = float(ndtr(-2.0))
"""Probability that noise of the declared sigma is larger than what still counts as within it: that
of two standard errors."""


@dataclass(frozen=True)
class OutputNoise:
    """The residual of one output beside its noise, all in standard deviations that are declared.

    Without a declared sigma they are in units of the estimated noise; where that is 0, what is left
    is infinitely larger.

    Attributes
    ----------
    level, white
        Root mean square of the residual; estimated standard deviation of the part that is white.
    degrees
        Of freedom of the square of `level`: few where the residual has a memory.
    correlation
        Of one sample with the next.
    first_order
        Nothing is seen beyond a first-order autoregression, as of a sensor's coloured noise. A
        disturbance that goes through the model has a white floor beneath it, or is smoother.
    declared, given
        The sigma is the user's; it is not 1 throughout, as it is where none is given.
    loud
        Where experiments have sigmas of their own, the ids of those that alone are noisier than
        twice theirs, if others are not.
    told
        Some record is long enough for its noise to be told from what a model leaves; else `white`
        is the sigma that is given, or the whole residual of the declared model.
    filtered
        The residuals are innovations: their unit is what process noise and sigma explain together.
    """

    output: str
    samples: int
    level: float
    white: float
    degrees: float
    correlation: float
    first_order: bool
    declared: bool
    loud: tuple[str, ...] = ()
    told: bool = True
    given: bool = True
    filtered: bool = False

    @property
    def over(self) -> str:
        """What its level is a multiple of."""
        if self.filtered:
            return "spread that noise explains"
        return "declared sigma" if self.declared else "noise"

    @property
    def named(self) -> str:
        """Its name, with what its sigma may be but the user's."""
        return self.output if self.given else f"{self.output} (1, the default)"

    @property
    def sigma_too_small(self) -> bool:
        """The white part alone is more than twice the sigma that is declared."""
        return self.declared and self.white > NOISY

    @property
    def sigma_too_large(self) -> bool:
        """Everything that is left is less than half the sigma that is declared."""
        return self.declared and self.level < SMALL_RMS_OVER_SIGMA

    @property
    def within(self) -> bool:
        """It is no larger than noise of the declared sigma is by chance, and no drift."""
        return self.no_larger and not self.drifts

    @property
    def drifts(self) -> bool:
        """It forgets too slowly for a sensor's own noise."""
        return self.correlation > DRIFT

    @property
    def no_larger(self) -> bool:
        """It is no larger than noise of the declared sigma is by chance, however smooth.

        What is slow in it may be as large as the white part leaves room for, and by chance larger
        as a chi-squared number with as many degrees of freedom as the memory leaves
        (`Autocorrelation.squares`). A residual is not judged by its own error, which grows with it.
        """
        if not self.declared:
            return False
        white = min(self.white, self.level) ** 2
        room = max(1.0 - white, 0.0) + WHITE_ERROR / np.sqrt(self.samples)
        slow = self.level**2 - white
        return bool(slow <= room * chdtri(self.degrees, CHANCE) / self.degrees)

    @property
    def coloured(self) -> bool:
        """A part of it is not white."""
        return self.white**2 <= COLOURED_SHARE * self.level**2

    @property
    def like_noise(self) -> bool:
        """It is white, or coloured as the noise of a sensor is."""
        return self.first_order or self.level**2 - self.white**2 <= WHITE

    @property
    def believed(self) -> bool:
        """The declared sigma is not contradicted by the data."""
        return self.declared and not (self.sigma_too_small or self.sigma_too_large)


def residual_noise(
    fitter: Fitter, fitted: FittedModel, noise: FloatArray
) -> tuple[OutputNoise, ...]:
    """Compare the residual of a fit with the noise of each output, (outputs,), in its units."""
    found = [_of_output(fitter, fitted, *each) for each in enumerate(noise.tolist())]
    return tuple(each for each in found if each is not None)


def _of_output(
    fitter: Fitter, fitted: FittedModel, number: int, noise: float
) -> OutputNoise | None:
    """One output's residual beside its noise; None where nothing is left."""
    records, declared = fitter.records, fitter.sigma_declared
    part = fitted.residuals[records.of_output(number)]
    own = [record for record in records.items if record.output == number]
    rms = float(np.sqrt(np.mean(part**2))) if len(part) else 0.0
    if not rms > 0.0:
        return None
    white = noise if noise > 0.0 else 0.0
    unit = 1.0 if declared else white
    partial = partial_autocorrelations(fitted.residuals, records, number, ORDER)
    most = max(FIRST_ORDER, 3.3 / np.sqrt(len(part)))
    return OutputNoise(
        output=records.outputs[number],
        samples=len(part),
        level=rms / unit if unit else np.inf,
        white=white / unit if unit else 1.0,
        degrees=len(part) / autocorrelation(fitted.residuals, own).squares,
        correlation=float(partial[0]),
        first_order=bool(
            partial[0] <= DRIFT
            and np.abs(partial[1:]).max() <= most
            and white**2 <= COLOURED_SHARE * rms**2
        ),
        declared=declared,
        loud=_loud(fitter, fitted, number) if declared else (),
        told=is_told(records, number),
        given=is_given(fitter, number),
        filtered=fitter.predicts,
    )


def believed_noise(fitter: Fitter, outputs: Sequence[OutputNoise], noise: FloatArray) -> FloatArray:
    """Return the noise of each output, in units of the residual: (outputs,).

    The declared sigma where the data do not contradict it, and what is left looks like noise that
    large; else the estimate.
    """
    believed = {each.output for each in outputs if each.believed and each.like_noise}
    pairs = zip(fitter.records.outputs, noise.tolist(), strict=True)
    return np.array([max(1.0, own) if name in believed else own for name, own in pairs])


def is_noise_of_sensors(
    outputs: Sequence[OutputNoise], *, near: float, largest: float, whitened: bool
) -> bool:
    """Return whether what is left may be the noise of sensors, however coloured, and no more.

    It may reach `near` times the noise if an autoregression describes it, with which nothing is
    left (`whitened`). Where no sigma is declared, it may reach `largest` times the estimate, which
    sees the white part alone, and is too small by about 5 at a correlation of 0.93.
    """
    for output in outputs:
        if output.filtered:  # with the right process noise innovations are white
            known = output.level**2 - output.white**2 <= WHITE
        elif output.believed:
            known = _within_declared(output, near)
        else:
            level = output.level / output.white if output.white > 0.0 else np.inf
            most = max(largest * output.first_order, near * whitened)
            white = WHITE + WHITE_ERROR / np.sqrt(output.samples)
            known = level**2 <= 1.0 + white or level <= most
        if not known:
            return False
    return True


def suspected_sigma(outputs: Sequence[OutputNoise]) -> str:
    """Say which declared sigmas the data contradict; "" if none."""
    small = {o.named: o.white for o in outputs if o.sigma_too_small and not o.loud and o.told}
    large = {o.named: o.level for o in outputs if o.sigma_too_large}
    short = {o.named: o.level for o in outputs if o.declared and not o.told and o.level > NOISY}
    said = [
        f"over all experiments, {small_sigma(o.named, [o.white])} in {', '.join(map(repr, o.loud))}"
        for o in outputs
        if o.sigma_too_small and o.loud and o.told
    ]
    if short:
        said.append(
            f"the remaining error of {' and '.join(short)} is {from_to(short.values())} times the "
            f"declared sigma; with records of fewer than {SHORTEST_NOISE_RECORD} samples, it "
            "cannot be decided whether sigma is wrong or something is missing"
        )
    if small:
        said.append(small_sigma(" and ".join(small), small.values()))
    if large:
        said.append(large_sigma(" and ".join(large), large.values()))
    return "; ".join(said)


def _loud(fitter: Fitter, fitted: FittedModel, number: int) -> tuple[str, ...]:
    """Experiments whose own sigma is too small for one output, where those of others are not."""
    records, sigmas = fitter.records, fitter.sigmas
    own = [r for r in records.items if r.output == number and len(r.times)]
    if len({float(sigmas[record.rows.start]) for record in own}) < 2:
        return ()
    loud = []
    for record in own:
        alone = StackedRecords(records.outputs, (record,))
        if estimate_noise(fitted.residuals, alone)[number] > NOISY:
            loud.append(fitter.runs[record.experiment].id)
    return tuple(loud) if len(loud) < len(own) else ()


def _within_declared(output: OutputNoise, near: float) -> bool:
    """Return whether a sigma that is declared covers what is left."""
    white = output.level**2 - output.white**2 <= WHITE
    return white or output.within or (output.first_order and output.level <= near)
