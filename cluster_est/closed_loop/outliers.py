"""Outliers and noise that grows with the signal: both are detected before the search."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.special import bdtrc

from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter, with_outputs
from cluster_est.closed_loop.output_noise import measured_values, noise_of
from cluster_est.closed_loop.selection.starts import THOROUGH
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, LoopScope, LoopWorkbench, open_workbench
from cluster_est.problem.display import in_a_row
from cluster_est.problem.problem import Problem
from cluster_est.problem.tables.jumps import answers_to_inputs
from cluster_est.problem.tables.stand_ins import is_missing, stand_ins
from cluster_est.problem.thinning import LONG
from cluster_est.results.output_errors import output_residuals
from cluster_est.statistics.noise.estimate import estimate_noise
from cluster_est.statistics.noise.growing_noise import NoiseGrowth, noise_growth
from cluster_est.statistics.noise.outliers import PROVEN, IsolatedOutliers, isolated_outliers
from cluster_est.statistics.records import OutputRecord, StackedRecords
from cluster_est.toml import dotted
from workers.messages import FloatArray, Output

MOST_OUTLIERS = 0.05
"""Largest share of an output's samples that may be left out as outliers. Signal: a sensor with
faults in more than 1 of 20 samples is not usable."""

EXACT = 1e-5
"""Least noise that the search for outliers assumes, as a share of the output's range. Signal:
simulations are hardly more accurate, and a simulation error is not a sensor fault."""


NOISE_GROWTH = 2.0
"""Least ratio, for a note, of the noise at large values of a signal to the noise at small values.
Theory: if sigma is wrong by a factor of 2, least squares loses a third of its efficiency; with a
smaller error, it loses little."""

NOISE_GROWTH_P = 1e-6
"""Largest p-value for a note on growing noise. Theory: among a thousand outputs, the probability of
a false note is 0.001."""

Place = tuple[int, str]
"""Index of an experiment, and name of one of its outputs."""

Mask = npt.NDArray[np.bool_]

CHANCE_OF_JUMPS = 0.01
"""Probability above which it counts as chance that outliers follow jumps of inputs."""


@dataclass(frozen=True)
class OutliersOfOutput:
    """The outliers of one output in all training experiments, or in all held-out experiments.

    The keys of `found` are the indices of the experiments.
    """

    output: str
    held_out: bool
    found: Mapping[int, IsolatedOutliers] = field(repr=False)

    @property
    def count(self) -> int:
        return sum(int(each.mask.sum()) for each in self.found.values())

    @property
    def samples(self) -> int:
        return sum(len(each.mask) for each in self.found.values())

    @property
    def few(self) -> bool:
        """Whether there are so few outliers that they may be sensor faults."""
        return self.count <= MOST_OUTLIERS * self.samples

    @property
    def sentence(self) -> str:
        """The number and size of the outliers as a part of a sentence; as a note if many."""
        largest = max(each.largest for each in self.found.values())
        held = "held-out " if self.held_out else ""
        of = f"{100.0 * self.count / self.samples:.2g} % of the {held}samples of {self.output}"
        counted = f"{self.count:,} of {self.samples:,}"
        if not self.few:
            return (
                f"{of} ({counted}) are far from all their neighbours, by up to {largest:.0f} times "
                "the noise; these are too many to be sensor faults, so all samples were kept; look "
                "at the signal"
            )
        kind = "held-out" if self.held_out else "training"
        return (
            f"{self.output} {self.count:,} of {self.samples:,} {kind} samples (up to "
            f"{largest:.0f} times the noise away from their neighbours)"
        )


def outlier_notes(outliers: Sequence[OutliersOfOutput]) -> tuple[str, ...]:
    """Return a note on the samples that were left out, and one on each output with too many."""
    few = [each.sentence for each in outliers if each.few]
    left_out = "outliers were left out of fits, errors and tables: "
    many = (each.sentence for each in outliers if not each.few)
    return (*([left_out + in_a_row(few)] if few else []), *many)


def fit_from_start(fitter: Fitter) -> FittedModel | None:
    """Fit the declared model from the user's start; None if it cannot be simulated."""
    start = FitStart(fitter.problem, {})
    (fitted,) = fitter.fit(LoopStage.DECLARED_MODEL, [start], THOROUGH)
    return fitted


@contextmanager
def open_checked_workbench(
    request: LoopRequest,
    fit: Callable[[Fitter], FittedModel | None] = fit_from_start,
    thinned: Collection[Place] = (),
) -> Iterator[LoopWorkbench]:
    """Open a workbench whose data have no outliers; its notes say what was left out.

    First the declared model is fitted. Its residuals show single samples that differ from all their
    neighbours (`isolated_outliers`). The search then uses copies of the experiments without these
    samples. An output with too many outliers keeps all its samples. If the noise of an output grows
    with its signal, each sample gets its own sigma (`growing_noise`).

    Outputs of thinned records (`thinned`) are not searched for outliers. Each of their rows is made
    of many samples, whose outliers were left out before. A single row that differs from its
    neighbours shows only that the output changes fast there.
    """
    with open_workbench(request) as workbench:
        fitter = workbench.fitter
        fitted = fit(fitter)
        outliers = [] if fitted is None else _outliers(fitter, fitted, thinned)
        notes = list(outlier_notes(outliers))
        few = [each for each in outliers if each.few]
        growing: tuple[GrowingNoise, ...] = ()
        if fitted is not None:
            growing = growing_noise(fitter, fitted, _kept(fitter, few))
        notes += [each.sentence for each in growing]
        if not few and not any(each.weighted for each in growing):
            yield replace(workbench, scope=_noted(workbench.scope, notes), first_fit=fitted)
            return
    cleaned = with_own_sigmas(without(fitter.problem, few), growing)
    cleaned_request = replace(request, problem=cleaned, sigma_declared=fitter.sigma_declared)
    with open_workbench(cleaned_request) as again:
        near = {} if fitted is None else fitted.estimates
        yield replace(again, scope=_noted(workbench.scope, notes), near=near)


def _noted(scope: LoopScope, notes: Sequence[str]) -> LoopScope:
    return replace(scope, notes=(*scope.notes, *notes))


def without(problem: Problem, outliers: Sequence[OutliersOfOutput]) -> Problem:
    """Return the problem with copies of its experiments that do not contain these outliers."""
    masks = _masks(outliers)

    def change(e: int, output: Output) -> Output:
        mask = masks.get((e, output.variable))
        if mask is None or not mask.any():
            return output
        return output.only(~mask)

    return with_outputs(problem, change)


def without_stand_ins(problem: Problem) -> Problem:
    """Return the problem without numbers that mark missing measurements, such as -9999.

    A search cannot find effects if a fit uses such numbers.
    """

    def change(_: int, output: Output) -> Output:
        found = () if output.ordinal else stand_ins(output.values)
        kept = ~is_missing(output.values, [each.value for each in found])
        return output.only(kept) if found and kept.any() else output

    return with_outputs(problem, change) if problem.data_findings else problem


def samples_left_out(measured: Problem, used: Problem) -> dict[str, dict[str, list[float]]]:
    """Return the times of the samples that were measured but not used, by record and output.

    They can be written into the key `left_out` of an experiment.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for run, kept in zip(measured.experiments, used.experiments, strict=True):
        for output, own in zip(run.outputs, kept.outputs, strict=True):
            gone = np.setdiff1d(output.times, own.times)
            if len(gone):
                record = found.setdefault(run.record_id, {})
                record.setdefault(output.variable, []).extend(gone.tolist())
    return found


MOST_WRITTEN = 12
"""Largest number of sample times that a note lists."""


def left_out_sentence(left_out: Mapping[str, Mapping[str, Sequence[float]]]) -> tuple[str, ...]:
    """Say with which keys a fit leaves out the same samples; () if no sample was left out."""
    if not left_out:
        return ()
    keys = [
        f"{dotted('left_out', output)} = [{', '.join(f'{time:.10g}' for time in times)}] to "
        f"experiment {record!r}"
        for record, outputs in left_out.items()
        for output, times in outputs.items()
    ]
    count = sum(len(times) for outputs in left_out.values() for times in outputs.values())
    if count <= MOST_WRITTEN:
        return (f"to leave out the same samples in cluster-est fit, add {in_a_row(keys)}",)
    output = next(output for outputs in left_out.values() for output in outputs)
    return (
        "to leave out the same samples in cluster-est fit, copy their times from left_out in "
        f"run.json to the experiments in the config, for example {dotted('left_out', output)} = "
        "[TIMES]",
    )


def outliers_of_long_records(problem: Problem, most: int) -> list[OutliersOfOutput]:
    """Return the outliers in records that will be thinned; the filter would smear them.

    Signals with such a high sampling rate are smooth from sample to sample, so no model is needed:
    the outliers are detected in the measured signal itself, not in a residual. Samples just after
    jumps of inputs are never outliers.
    """
    found = []
    for held_out, role in ((False, "train"), (True, "test")):
        signals = {
            (e, output.variable): output.values / output.sigmas
            for e in problem.indices(role)
            for output in problem.experiments[e].outputs
            if len(output.times) > LONG * most
        }
        for name, own in _by_output(signals).items():
            jumps = {e: answers_to_inputs(problem.experiments[e], name) for e in own}
            noise = _noise_of_signals(list(own.values()))
            found.append(OutliersOfOutput(name, held_out, _of_sensor(own, jumps, noise)))
    return [each for each in found if each.count and each.few]


def _by_output(signals: Mapping[Place, FloatArray]) -> dict[str, dict[int, FloatArray]]:
    """Return the signals by output and experiment."""
    found: dict[str, dict[int, FloatArray]] = {}
    for (experiment, output), signal in signals.items():
        found.setdefault(output, {})[experiment] = signal
    return found


def _noise_of_signals(signals: Sequence[FloatArray]) -> float:
    """Return the noise of one sensor's signals, or the typical simulation error if it is larger."""
    stacked = np.concatenate(signals)
    ends = np.cumsum([0, *map(len, signals)])
    records = tuple(
        OutputRecord(e, 0, slice(first, last), np.arange(last - first, dtype=float))
        for e, (first, last) in enumerate(pairwise(ends.tolist()))
    )
    (noise,) = estimate_noise(stacked, StackedRecords(("",), records), stacked)
    return max(float(noise), EXACT * float(np.ptp(stacked)))


def _masks(outliers: Sequence[OutliersOfOutput]) -> dict[Place, Mask]:
    return {(e, o.output): found.mask for o in outliers for e, found in o.found.items()}


def _kept(fitter: Fitter, outliers: Sequence[OutliersOfOutput]) -> Mask:
    """Return a mask of the residuals that are not outliers."""
    masks, records = _masks(outliers), fitter.records
    kept = np.ones(fitter.size, bool)
    for item in records.items:
        mask = masks.get((fitter.train[item.experiment], records.outputs[item.output]))
        if mask is not None:
            kept[item.rows] = ~mask
    return kept


def _outliers(
    fitter: Fitter, fitted: FittedModel, thinned: Collection[Place]
) -> list[OutliersOfOutput]:
    """Return the outliers of each output with outliers, separately for held-out experiments."""
    names = fitter.records.outputs
    noise = _noise(fitter, fitted)
    training = {
        (fitter.train[record.experiment], names[record.output]): fitted.residuals[record.rows]
        for record in fitter.records.items
    }
    found = []
    for held_out, signals in ((False, training), (True, _held_out(fitter, fitted))):
        looked_at = {place: each for place, each in signals.items() if place not in thinned}
        for name, own in _by_output(looked_at).items():
            jumps = {e: answers_to_inputs(fitter.problem.experiments[e], name) for e in own}
            outliers = _in_records(own, jumps, noise.get(name, 0.0))
            found.append(OutliersOfOutput(name, held_out, outliers))
    return [each for each in found if each.count]


def _noise(fitter: Fitter, fitted: FittedModel) -> dict[str, float]:
    """Return the noise of each output, or the typical simulation error if it is larger."""
    signals = fitter.records.by_output(measured_values(fitter))
    ranges = np.array([np.ptp(signal) if len(signal) else 0.0 for signal in signals])
    noise = np.fmax(noise_of(fitter, fitted.residuals), EXACT * ranges)
    return dict(zip(fitter.records.outputs, noise.tolist(), strict=True))


def _in_records(
    signals: Mapping[int, FloatArray], jumps: Mapping[int, Mask], noise: float
) -> dict[int, IsolatedOutliers]:
    """Return the outliers of one sensor.

    If more outliers than expected by chance come just after jumps or pulses of inputs, these
    samples are responses to the inputs, and not outliers.
    """
    found = _of_sensor(signals, {}, noise)
    count = sum(int(each.mask.sum()) for each in found.values())
    after = sum(int((each.mask & jumps[e]).sum()) for e, each in found.items())
    places = np.concatenate([np.zeros(0, bool), *(jumps[e] for e in signals)])
    share = float(places.mean()) if len(places) else 0.0
    by_chance = after == 0 or bdtrc(after - 1, count, share) >= CHANCE_OF_JUMPS
    return found if by_chance else _of_sensor(signals, jumps, noise)


def _of_sensor(
    signals: Mapping[int, FloatArray], excepted: Mapping[int, Mask], noise: float
) -> dict[int, IsolatedOutliers]:
    """Return the outliers of one sensor; `excepted` samples are never outliers.

    If a sensor certainly has outliers, less evidence is required for each further outlier.
    """

    def outliers(*, proven: bool) -> dict[int, IsolatedOutliers]:
        return {
            e: isolated_outliers(signal, noise, proven=proven, excepted=excepted.get(e))
            for e, signal in signals.items()
        }

    found = outliers(proven=False)
    few = sum(int(each.mask.sum()) for each in found.values()) < PROVEN
    return found if few else outliers(proven=True)


def _held_out(fitter: Fitter, fitted: FittedModel) -> dict[Place, FloatArray]:
    """Return the residuals of the held-out experiments.

    Parameters that belong to a held-out experiment alone have their start values.
    """
    tests = fitter.problem.indices("test")
    stage = LoopStage.DECLARED_MODEL.value
    outcomes = fitter.simulate(fitted.problem, tests, fitted.estimates, "trajectory", stage)
    found = {}
    for test, outcome in zip(tests, outcomes, strict=True):
        for output in fitter.problem.experiments[test].outputs:
            residuals = output_residuals(output, outcome) if outcome.ok else None
            if residuals is not None:
                found[test, output.variable] = residuals
    return found


@dataclass(frozen=True)
class GrowingNoise:
    """An output whose noise is larger where its signal is larger.

    Attributes
    ----------
    growth
        The dependence of the noise on the signal, in the unit of the residual.
    sigma, relative_sigma
        Estimates of the two parts of the noise, as in `Output`; NaN if they are not known.
    weighted
        Whether each sample is weighted with its own sigma; False if the user has given a sigma.
    """

    output: str
    growth: NoiseGrowth
    sigma: float
    relative_sigma: float
    weighted: bool

    @property
    def sentence(self) -> str:
        """The growth of the noise and the weights of the samples, as a sentence."""
        growth, name = self.growth, self.output
        rise = (
            f"by a factor of {growth.loud / growth.quiet:.1f}" if growth.quiet > 0.0 else "from 0"
        )
        said = (
            f"the noise of {name} grows with the signal: from the third of the samples with the "
            f"smallest values to the third with the largest values, it increases {rise}"
        )
        both = f"{dotted('sigma', name)} = {self.sigma:.3g} and {dotted('relative_sigma', name)} = "
        both += f"{self.relative_sigma:.3g}"
        if self.weighted:
            return (
                f"{said}, so each sample was weighted with its own sigma; for a fit with the same "
                f"weights, write {both} into the experiments"
            )
        said += ", so with the same sigma for all samples, the noisier samples have too much weight"
        if np.isnan(self.sigma):
            larger = dotted("relative_sigma", name)
            return f"{said}; set {larger} to a larger value, in addition to {dotted('sigma', name)}"
        return f"{said}; suitable values are about {both}"


def growing_noise(fitter: Fitter, fitted: FittedModel, kept: Mask) -> tuple[GrowingNoise, ...]:
    """Return the outputs whose noise grows with their signal."""
    measured, found = measured_values(fitter), []
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
    """Return the problem with a sigma for each sample of the outputs that are `weighted`."""
    own = {each.output: each for each in growing if each.weighted}

    def change(_: int, output: Output) -> Output:
        found = own.get(output.variable)
        if found is None:
            return output
        return replace(
            output, sigma=found.sigma, relative_sigma=found.relative_sigma, sigma_known=True
        )

    return with_outputs(problem, change)


def _rounded(value: float) -> float:
    """Round to the digits of the note, so that a fit with the noted values has the same weights."""
    return float(f"{value:.3g}")
