"""Estimates of the outputs' noise from residuals, and comparison of residuals with this noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri, ndtr

from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.problem.sigmas import declares_sigma
from cluster_est.statistics.noise.estimate import (
    SHORTEST_NOISE_RECORD,
    STEP_OVER_DEVIATION,
    estimate_noise,
    quantisation_step,
)
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.residual_findings import from_to, large_sigma, small_sigma
from cluster_est.statistics.residual_tests import NOISY, SMALL_RMS_OVER_SIGMA, autocorrelation
from cluster_est.statistics.whitening import partial_autocorrelations
from workers.messages import FloatArray


def noise_of(fitter: Fitter, residuals: FloatArray) -> FloatArray:
    """Return the standard deviation of each output's noise, in its residual's unit: (outputs,).

    The estimate is that of `estimate_noise`, with two exceptions. If all records of an output are
    too short to distinguish noise from misfit, the given sigma is returned, because otherwise the
    whole residual would count as noise and hide a missing effect. For thinned records, the noise
    between the original samples is an upper limit, because a residual that is smooth from sample to
    sample may vary from row to row.
    """
    found = estimate_noise(residuals, fitter.records, measured_values(fitter))
    for number in range(len(found)):
        if is_given(fitter, number) and not is_told(fitter.records, number):
            found[number] = 1.0
    return np.fmin(found, _seen_between_samples(fitter))


def _seen_between_samples(fitter: Fitter) -> FloatArray:
    """Return the noise between the original samples of thinned records; NaN for other outputs."""
    names = fitter.records.outputs
    found = np.full(len(names), np.nan)
    for number, name in enumerate(names):
        own = [o for run in fitter.runs for o in run.outputs if o.variable == name]
        units = [o.sigmas / o.noise_factors for o in own if o.noise_factors is not None]
        if units and name in fitter.noise_of_samples:
            unit = float(np.median(np.concatenate(units)))
            found[number] = fitter.noise_of_samples[name] / unit
    return found


ROUNDED = 0.5
"""Least share of the variance of the noise that is rounding, for which the rounding is reported. By
definition: it is the larger part."""


def rounding_notes(fitter: Fitter, noise: Mapping[str, float]) -> tuple[str, ...]:
    """Say which outputs have a noise, given in their units, that is mostly rounding."""
    notes = []
    for name, level in noise.items():
        own = [o for run in fitter.runs for o in run.outputs if o.variable == name]
        step = max((quantisation_step(o.values) for o in own if not o.ordinal), default=0.0)
        rounding = step / STEP_OVER_DEVIATION
        if rounding > 0.0 and ROUNDED * level**2 <= rounding**2:
            notes.append(
                f"the values of output {name} are multiples of {step:.3g}: rounding alone causes "
                f"an error of {rounding:.3g}, which is most of its noise ({level:.3g})"
            )
    return tuple(notes)


def expected_noise(fitter: Fitter, residuals: FloatArray) -> FloatArray:
    """Return the declared noise of each output, or the estimate of `noise_of` without a sigma."""
    if fitter.sigma_declared:
        return np.ones(len(fitter.records.outputs))
    return noise_of(fitter, residuals)


def is_told(records: StackedRecords, output: int) -> bool:
    """Return whether a record of an output is long enough to distinguish noise from misfit."""
    own = (record for record in records.items if record.output == output)
    return any(len(record.times) >= SHORTEST_NOISE_RECORD for record in own)


def is_given(fitter: Fitter, output: int) -> bool:
    """Return whether the sigma of an output is known in all experiments."""
    name = fitter.records.outputs[output]
    return declares_sigma(o for run in fitter.runs for o in run.outputs if o.variable == name)


def measured_values(fitter: Fitter) -> FloatArray:
    """Return the measured values over sigma, in the order of the residuals."""
    parts = [o.values / o.sigmas for run in fitter.runs for o in run.outputs]
    return np.concatenate(parts) if parts else np.zeros(0)


ORDER = 5
"""Largest lag of the partial autocorrelations."""

WHITE = 0.05
"""Largest mean square of the part that is not white for noise that still counts as white."""

WHITE_ERROR = 5.0
"""Relative error of the variance of the white part, times the root of the number of samples."""

COLOURED_SHARE = 0.8
"""Share of the variance: if the white part has more, the rest of the residual is too small to be
coloured noise, and has another cause."""

FIRST_ORDER = 0.1
"""Largest partial autocorrelation of first-order noise at lags above 1. Benchmark."""

DRIFT = 0.95
"""Correlation of neighbouring samples above which a residual counts as a drift or an offset. The
noise of a sensor is no longer correlated after about twenty samples."""

CHANCE = float(ndtr(-2.0))
"""Probability that noise of the declared sigma exceeds the limit up to which a residual counts as
within sigma: the probability of an excess of more than two standard errors."""


@dataclass(frozen=True)
class OutputNoise:
    """The residual of one output and its noise, both in units of the declared sigma.

    Without a declared sigma, the unit is the estimated noise. If this is 0, `level` is infinite.

    Attributes
    ----------
    level, white
        Root mean square of the residual; estimated standard deviation of its white part.
    degrees
        Degrees of freedom of the square of `level`; they are few if the residual is autocorrelated.
    correlation
        Correlation of neighbouring samples.
    first_order
        Whether the residual looks like a first-order autoregression, the usual coloured noise of a
        sensor. A disturbance that acts through the model is smoother, or contains white noise.
    declared, given
        Whether the user has declared a sigma; whether some sigma differs from the default, 1.
    loud
        If experiments have different sigmas: the ids of those experiments whose noise is more than
        twice their sigma. Empty if this is so in all experiments.
    told
        Whether some record is long enough to distinguish noise from misfit. Otherwise `white` is
        the given sigma, or the whole residual of the declared model.
    filtered
        Whether the residuals are innovations. Their unit is the standard deviation that process
        noise and sigma together explain.
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
        """The unit of `level`, in words."""
        if self.filtered:
            return "spread that noise alone explains"
        return "declared sigma" if self.declared else "noise"

    @property
    def named(self) -> str:
        """The name of the output, with a remark if sigma is the default."""
        return self.output if self.given else f"{self.output} (sigma is 1, the default)"

    @property
    def sigma_too_small(self) -> bool:
        """Whether the white part alone is more than twice the declared sigma."""
        return self.declared and self.white > NOISY

    @property
    def sigma_too_large(self) -> bool:
        """Whether the whole residual is less than half the declared sigma."""
        return self.declared and self.level < SMALL_RMS_OVER_SIGMA

    @property
    def within(self) -> bool:
        """Whether the residual may be noise of the declared sigma: not larger, and not a drift."""
        return self.no_larger and not self.drifts

    @property
    def drifts(self) -> bool:
        """Whether the residual is correlated over too many samples to be the noise of a sensor."""
        return self.correlation > DRIFT

    @property
    def no_larger(self) -> bool:
        """Whether the residual is not larger than noise of the declared sigma, smooth or not.

        The variance of the slow part may be sigma squared minus the variance of the white part. By
        chance it may be larger, like a chi-squared variable with `degrees` degrees of freedom.
        Autocorrelation reduces these (`Autocorrelation.squares`). The residual's own standard error
        is not used, because it grows with the residual.
        """
        if not self.declared:
            return False
        white = min(self.white, self.level) ** 2
        room = max(1.0 - white, 0.0) + WHITE_ERROR / np.sqrt(self.samples)
        slow = self.level**2 - white
        return bool(slow <= room * chdtri(self.degrees, CHANCE) / self.degrees)

    @property
    def coloured(self) -> bool:
        """Whether a considerable part of the residual is not white."""
        return self.white**2 <= COLOURED_SHARE * self.level**2

    @property
    def like_noise(self) -> bool:
        """Whether the residual is white, or coloured like the noise of a sensor."""
        return self.first_order or self.level**2 - self.white**2 <= WHITE

    @property
    def believed(self) -> bool:
        """Whether a sigma is declared and the data do not contradict it."""
        return self.declared and not (self.sigma_too_small or self.sigma_too_large)


def residual_noise(
    fitter: Fitter, fitted: FittedModel, noise: FloatArray
) -> tuple[OutputNoise, ...]:
    """Compare the residual of a fit with each output's noise: (outputs,), in the same units."""
    found = [_of_output(fitter, fitted, *each) for each in enumerate(noise.tolist())]
    return tuple(each for each in found if each is not None)


def _of_output(
    fitter: Fitter, fitted: FittedModel, number: int, noise: float
) -> OutputNoise | None:
    """Compare one output's residual with its noise; None if the residual is 0."""
    records, declared = fitter.records, fitter.sigma_declared
    part = fitted.residuals[records.of_output(number)]
    own = [record for record in records.items if record.output == number]
    rms = float(np.sqrt(np.mean(part**2))) if len(part) else 0.0
    if not rms > 0.0:
        return None
    white = min(noise, rms) if noise > 0.0 else 0.0  # the white part is not more than the whole
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
    """Return the noise of each output, in the unit of the residual: (outputs,).

    This is the declared sigma (or a larger estimate) if the data do not contradict it and the
    residual looks like noise. Otherwise it is the estimate.
    """
    believed = {each.output for each in outputs if each.believed and each.like_noise}
    pairs = zip(fitter.records.outputs, noise.tolist(), strict=True)
    return np.array([max(1.0, own) if name in believed else own for name, own in pairs])


def is_noise_of_sensors(
    outputs: Sequence[OutputNoise], *, near: float, largest: float, whitened: bool
) -> bool:
    """Return whether the residual may be only sensor noise, white or coloured.

    If an autoregression describes the residual completely (`whitened`), the residual may be up to
    `near` times the noise. If no sigma is declared, first-order noise may be up to `largest` times
    the estimated noise, because this estimate contains only the white part. At a correlation of
    0.93, it is about five times too small.
    """
    for output in outputs:
        if output.filtered:  # with the right process noise, innovations are white
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
    noise = {o.named: o.white for o in outputs if o.sigma_too_small and o.told}
    small = {o.named: noise[o.named] for o in outputs if o.named in noise and not o.loud}
    large = {o.named: o.level for o in outputs if o.sigma_too_large}
    short = {o.named: o.level for o in outputs if o.declared and not o.told and o.level > NOISY}
    said = [
        f"over all experiments, {small_sigma(o.named, [noise[o.named]], o.loud)}"
        for o in outputs
        if o.named in noise and o.loud
    ]
    if short:
        said.append(
            f"the remaining error of {' and '.join(short)} is {from_to(short.values())} times the "
            f"declared sigma; all records have fewer than {SHORTEST_NOISE_RECORD} samples, which "
            "is too few to decide whether sigma is too small or the model lacks something"
        )
    if small:
        said.append(small_sigma(" and ".join(small), small.values()))
    if large:
        said.append(large_sigma(" and ".join(large), large.values()))
    return "; ".join(said)


def _loud(fitter: Fitter, fitted: FittedModel, number: int) -> tuple[str, ...]:
    """Return the experiments whose sigma is too small for one output.

    () if it is too small in all experiments, or if all experiments have the same sigma.
    """
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
    """Return whether the residual may be noise of the declared sigma."""
    white = output.level**2 - output.white**2 <= WHITE
    return white or output.within or (output.first_order and output.level <= near)
