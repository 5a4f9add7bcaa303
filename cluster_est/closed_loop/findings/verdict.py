"""The verdict of a search for missing effects, with its reason.

It is made in two steps. `judge` uses the training experiments at the end of the search. `confirmed`
uses the remaining errors after the last fits, on training and on held-out data. The second step can
only make the verdict weaker.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import fdtrc

from cluster_est.closed_loop.findings.effects import (
    ErrorChange,
    Verdict,
    comparable,
    largest_error,
    no_longer_simulated,
    not_simulated,
    over_noise,
    pooled_error,
    what_is_left,
    without_noise,
)
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.output_noise import (
    OutputNoise,
    believed_noise,
    is_noise_of_sensors,
    residual_noise,
    suspected_sigma,
)
from cluster_est.closed_loop.selection.rounds import (
    VERDICT,
    RejectionReason,
    SelectionResult,
    SelectionRound,
)
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.problem.display import in_percent, in_sentences
from cluster_est.statistics.residual_findings import autocorrelated
from cluster_est.statistics.residual_tests import FAMILY_WISE_LEVEL
from workers.messages import FloatArray

CLAIMS = (Verdict.FOUND, Verdict.PARTIAL)
"""Verdicts that add effects to the model."""
HELD_OUT_ERROR = 1.15
"""Largest ratio of the held-out error to the training error with which both may be noise alone.
Signal: with ten or more samples for each estimate, the uncertainty of the estimates adds less."""
RARE = 1e-3
"""A larger ratio is not chance if its probability by chance is below this value. By definition."""


@dataclass(frozen=True)
class ReasonedVerdict:
    """A verdict and its reason in a sentence.

    Attributes
    ----------
    closed, least
        Share of the gap to the noise that the effects close on the training experiments; share that
        they must close on held-out data.
    declared, filtered
        Whether a sigma is declared; whether the errors are innovations of a filter.
    noise
        For outputs whose declared sigma is far too large: the noise, in units of this sigma.
    floor
        Error that the noise alone causes, in units of `over`. It is above 1 if a declared sigma is
        far too small.
    independent
        Share of the samples that are independent; below 1 if the residuals are autocorrelated.
    first
        What the reason asks to do before everything else, such as "correct the records"; "" if it
        asks for nothing.
    """

    verdict: Verdict
    reason: str
    closed: float = np.nan
    least: float = 0.0
    declared: bool = False
    noise: Mapping[str, float] = field(default_factory=dict)
    floor: float = 1.0
    filtered: bool = False
    independent: float = 1.0
    first: str = ""

    def refused(self, against: str) -> ReasonedVerdict:
        """Return the verdict "unexplained", with a reason against the effects that were claimed."""
        reason = f"{self.reason}. But {against}, so nothing was added"
        return replace(self, verdict=Verdict.UNEXPLAINED, reason=reason)

    @property
    def so_far(self) -> ReasonedVerdict:
        """The verdict while the search still runs: at most "partial"."""
        partial = Verdict.PARTIAL if self.verdict is Verdict.FOUND else self.verdict
        return replace(self, verdict=partial)

    @property
    def over(self) -> str:
        """The unit of the errors, in words."""
        if self.filtered:
            return "the spread that noise alone explains"
        return "the declared sigma" if self.declared and not self.noise else "the noise"


@dataclass(frozen=True)
class _Residual:
    """The residual of a model, compared with the noise, and its structure.

    `excess` is the squared residual over the squared noise, minus 1, of all outputs or of the
    output with the largest excess. `structured` says that the residual is smooth and larger than
    the noise. `of_sensors` says that it may still be sensor noise.
    """

    outputs: tuple[OutputNoise, ...]
    excess: float
    structured: bool
    of_sensors: bool

    @property
    def within_sigma(self) -> bool:
        """Whether the residual is coloured, and below sigmas that the data do not contradict."""
        within = all(o.believed and o.within and not o.filtered for o in self.outputs)
        return within and any(o.coloured for o in self.outputs)

    @property
    def missing(self) -> str:
        """Say that the model lacks something, or that the noise may have been filtered."""
        if all(o.believed and o.no_larger and not o.filtered for o in self.outputs):
            smooth = [o.output for o in self.outputs if o.drifts]
            if smooth:
                of = f" of {' and '.join(smooth)}" if len(self.outputs) > 1 else ""
                return (
                    f"the remaining error{of} is smoother than sensor noise, but no larger than "
                    f"the declared sigma ({self.level}): either the noise was filtered, or the "
                    "model lacks something"
                )
        return f"the model lacks something ({self.level})"

    @property
    def level(self) -> str:
        """Give the size of the residual and its unit."""
        worst = max(self.outputs, key=lambda o: o.level, default=None)
        if worst is None:
            return f"the remaining error is {np.sqrt(1.0 + self.excess):.2f} times the noise"
        named = f" of {worst.output}" if len(self.outputs) > 1 else ""
        if not np.isfinite(worst.level):
            return f"the remaining error{named} contains no noise"
        return f"the remaining error{named} is {worst.level:.3g} times the {worst.over}"


def judge(fitter: Fitter, found: SelectionResult) -> ReasonedVerdict:
    """Judge from the training experiments; held-out data can only weaken the verdict later."""
    base = _residual(fitter, found, found.base, found.steps[0])
    now = _residual(fitter, found, found.current, found.last)
    judged = _judged(fitter, found, base, now)
    suspected = suspected_sigma(now.outputs)
    reason = f"{judged.reason}; {suspected}" if suspected else judged.reason
    smaller = {o.output: o.white for o in now.outputs if o.sigma_too_large and o.white > 0.0}
    floor = [o.white if o.sigma_too_small else 1.0 for o in now.outputs]
    return replace(
        judged,
        reason=reason,
        declared=fitter.sigma_declared,
        noise=smaller,
        floor=float(np.sqrt(np.mean(np.square(floor)))) if floor else 1.0,
        filtered=fitter.predicts,
        independent=min([1.0, *(o.degrees / o.samples for o in now.outputs)]),
    )


def _judged(
    fitter: Fitter, found: SelectionResult, base: _Residual, now: _Residual
) -> ReasonedVerdict:
    """Judge the effects that a search has added, if any."""
    if not found.current.added:
        return _nothing_added(found, now)
    training, predicted = _closed(fitter, found, now)
    closed = min(training, predicted)
    several = len(found.current.added) > 1
    closes = "the effects remove" if several else "the effect removes"
    said = f"{closes} {in_percent(training)} of {EXCESS}"
    if f"{predicted:.0%}" != f"{training:.0%}" and predicted < training:
        said += f" ({in_percent(predicted)} in {CROSS_VALIDATION})"
    tables = any(c.form.free for c in found.current.added)
    dynamics = any(c.form.is_dynamics for c in found.current.added)
    # a curve can take any shape, so at the right place it must leave little
    most = VERDICT.most_by_curve if tables else VERDICT.most
    if base.structured and base.within_sigma:
        reason = f"{_autocorrelated(base)}: no effect is needed"
        return ReasonedVerdict(Verdict.COLOURED, reason, closed)
    # effects that predict other records worse are not "found", however good the fit is
    quiet = not now.structured and predicted >= 0.0
    if quiet or closed > 1.0 - VERDICT.negligible:
        if tables:
            said += (
                ", with hidden dynamics that no form in the library describes"
                if dynamics
                else ", with a free curve, because the shape is not in the library"
            )
        return ReasonedVerdict(Verdict.FOUND, said, closed, most)
    mostly = found.prediction.is_better_than(found.base_prediction)
    if now.of_sensors and not tables and mostly:
        rest = (
            f"{said}; what remains looks like autocorrelated sensor noise, so no further effect "
            "is needed"
        )
        return ReasonedVerdict(Verdict.FOUND, rest, closed, most)
    if closed > most:
        reason = f"{said}; the residual still has structure"
        return ReasonedVerdict(Verdict.PARTIAL, reason, closed, most)
    if base.of_sensors:
        reason = f"{_autocorrelated(base)}; the effects that were tried do not explain it"
        return ReasonedVerdict(Verdict.COLOURED, reason, closed)
    missing = f"{base.missing}, and {_nothing(found)}"
    best = "the best effects" if several else "the best effect"
    little = _little(training, predicted, most, several=several)
    reason = f"{missing}: {best} {little}{_more_effects(found)}"
    return ReasonedVerdict(Verdict.UNEXPLAINED, reason, closed)


def _nothing(found: SelectionResult) -> str:
    """Say that no effect explains the residual, and which settings limited the search."""
    settings = found.settings
    narrowed = settings.forms or settings.sites
    among = "among the forms and sites that closed_loop allows" if narrowed else "in the library"
    most = settings.max_effects
    limited = found.last.why == RejectionReason.LIMIT_OF_EFFECTS and most > 1
    what = f"combination of up to {most} effects" if limited else "effect"
    return f"no {what} {among} explains the remaining error"


def _more_effects(found: SelectionResult) -> str:
    """Say how to allow more effects, if their largest number ended the search."""
    if found.last.why != RejectionReason.LIMIT_OF_EFFECTS:
        return ""
    most = found.settings.max_effects
    return f"; to try more effects, set closed_loop.max_effects = {most + 1} or more"


def _little(training: float, predicted: float, most: float, *, several: bool) -> str:
    """Say how little of the gap the best effects would remove, and where."""
    if predicted < 0.0:
        return f"{'predict' if several else 'predicts'} {WORSE}"
    needed = f" (more than {most:.0%} is needed)"
    if f"{predicted:.0%}" != f"{training:.0%}" and predicted < training:
        said = f"would remove only {in_percent(predicted)} of {EXCESS} in {CROSS_VALIDATION}"
        return f"{said}, and {in_percent(training)} in the fit{needed}"
    return f"would remove only {in_percent(training)} of {EXCESS}{needed}"


def _nothing_added(found: SelectionResult, now: _Residual) -> ReasonedVerdict:
    why, screening = found.last.why, found.last.screening
    nowhere = why == RejectionReason.NO_CANDIDATE
    if now.structured and now.of_sensors and not nowhere:
        return ReasonedVerdict(Verdict.COLOURED, _coloured(found, now))
    if now.structured:
        return ReasonedVerdict(Verdict.UNEXPLAINED, f"{now.missing}, {_why_not(found)}")
    if nowhere:
        return ReasonedVerdict(Verdict.NONE, f"the residual looks like noise, but {why}: {NOWHERE}")
    if why == RejectionReason.COLOURED_NOISE:
        if screening.structure.p <= FAMILY_WISE_LEVEL:
            return ReasonedVerdict(Verdict.COLOURED, _coloured(found, now))
        reason = f"{RejectionReason.COLOURED_NOISE} {_p(found, screening.p_white)}"
        return ReasonedVerdict(Verdict.NONE, f"{reason}; {now.level}")
    if why == RejectionReason.NOT_SIGNIFICANT:
        reason = f"{RejectionReason.NOT_SIGNIFICANT} {_p(found, screening.p)}"
        return ReasonedVerdict(Verdict.NONE, f"{reason}; {now.level}")
    return ReasonedVerdict(Verdict.NONE, f"the best candidate was not accepted: {why}")


EXCESS = "the squared error above the noise"
CROSS_VALIDATION = "cross-validation, that is, in training data that were left out of the fit"
WORSE = "data that were left out of the fit (cross-validation) worse than the declared model does"

NOWHERE = (
    "closed_loop.effects and closed_loop.sites leave no site for an effect: they exclude every "
    "measured output, driven input, estimated parameter and state derivative"
)


def _why_not(found: SelectionResult) -> str:
    why, closed = found.last.why, found.last.closed
    if why == RejectionReason.NO_CANDIDATE:
        return f"but {why}: {NOWHERE}"
    if why == RejectionReason.NOT_SIGNIFICANT:
        return f"but {why}, although the residual has smooth structure"
    if why == RejectionReason.COLOURED_NOISE:
        return f"and no effect explains the remaining error: it is autocorrelated, and {why}"
    if why == RejectionReason.COLOURED_GAIN:
        return (
            "and no effect explains the remaining error: it is autocorrelated, and once this is "
            "taken into account, the best candidate is not significant"
        )
    if why == RejectionReason.LITTLE_EXPLAINED and closed >= 0.0:
        return (
            f"and no effect explains the remaining error: the best candidate removes only "
            f"{in_percent(closed)} of {EXCESS} in {CROSS_VALIDATION} (limit: "
            f"closed_loop.least_gain = {found.settings.least_gain:g})"
        )
    if why in (RejectionReason.LITTLE_EXPLAINED, RejectionReason.NUMERICAL_ERROR):
        best = f"the best candidate {why.removeprefix('it ')}"
        return f"and no effect explains the remaining error: {best}"
    return f"and no effect explains the remaining error: {why}"


def _coloured(found: SelectionResult, now: _Residual) -> str:
    """Say why the residual counts as coloured noise, although an effect may explain a part."""
    why, screening = found.last.why, found.last.screening
    if why == RejectionReason.NOT_SIGNIFICANT:
        rest = f"{why} {_p(found, screening.p)}"
    elif screening.p_white > found.settings.significance:
        rest = f"{RejectionReason.COLOURED_NOISE} {_p(found, screening.p_white)}"
    else:
        rest = f"the best candidate was not accepted: {why}"
    return f"{_autocorrelated(now)}; {rest}"


def _p(found: SelectionResult, p: float) -> str:
    """Give a family-wise p-value and its limit."""
    count = found.last.screening.count
    among = f" after correction for {count} candidate{'' if count == 1 else 's'}" if count else ""
    limit = f"limit: closed_loop.significance = {found.settings.significance:g}"
    return f"(p = {p:.2g}{among}, {limit})"


def _autocorrelated(residual: _Residual) -> str:
    """Say that a residual may be coloured sensor noise, and give its size."""
    worst = max(residual.outputs, key=lambda o: abs(o.correlation), default=None)
    if worst is None:
        return "the residual is autocorrelated"
    named = f" of {worst.output}" if len(residual.outputs) > 1 else ""
    if worst.believed:
        size = f"{worst.level:.3g} times the declared sigma"
    else:  # sigma is no measure then; `is_noise_of_sensors` also compares with the white part
        size = f"{worst.level / worst.white:.3g} times the white-noise component"
    doubted = [o.output for o in residual.outputs if not o.believed]
    if doubted:
        of = f" of {' and '.join(doubted)}" if len(doubted) < len(residual.outputs) else ""
        size += (
            f"; unless you declare a sigma{of} that fits the data, a slow effect of this size "
            "cannot be distinguished from autocorrelated noise"
        )
    return (
        f"the residual{named} is {autocorrelated(worst.correlation)} and small enough to be sensor "
        f"noise ({size})"
    )


def _residual(
    fitter: Fitter, found: SelectionResult, fitted: FittedModel, at: SelectionRound
) -> _Residual:
    """Return the residual of a model, with the screening of the round that started from it."""
    outputs = residual_noise(fitter, fitted, found.noise)
    excess = _excess(fitter, fitted, found.noise)
    screening = at.screening
    of_sensors = is_noise_of_sensors(
        outputs,
        near=found.settings.near_noise,
        largest=VERDICT.coloured,
        whitened=screening.structure_white.p > FAMILY_WISE_LEVEL,
    )
    structured = screening.structure.p <= FAMILY_WISE_LEVEL and excess > VERDICT.excess
    return _Residual(outputs, excess, structured, of_sensors)


def _excess(fitter: Fitter, fitted: FittedModel, noise: FloatArray) -> float:
    """Return squared residual over squared noise, minus 1: of all outputs, or of the worst one."""
    parts = fitter.records.by_output(fitted.residuals)
    alone = [
        float(np.mean(part**2) / level**2)
        for part, level in zip(parts, noise.tolist(), strict=True)
        if len(part) and level > 0.0
    ]
    return max(fitted.sse / fitter.noise_floor(noise), *alone, 0.0) - 1.0


def _closed(fitter: Fitter, found: SelectionResult, now: _Residual) -> tuple[float, float]:
    """Return the closed shares of the gap to the noise, in training and in prediction.

    The noise is the declared sigma if the data do not contradict it, otherwise the estimate.
    """
    floor = fitter.noise_floor(believed_noise(fitter, now.outputs, found.noise))
    base, last = found.base.sse, found.current.sse
    gap = base - min(floor, last)
    training = (base - last) / gap if gap > 0.0 else 0.0  # the squares may be tiny in some units
    predicted = found.prediction.closes(found.base_prediction, floor, VERDICT.negligible)
    return float(training), float(predicted)


def confirmed(
    judged: ReasonedVerdict, errors: Sequence[ErrorChange], settings: LoopSettings
) -> ReasonedVerdict:
    """Return the verdict after the last fits, from the training and the held-out errors."""
    if judged.verdict is Verdict.NONE:
        return _without_more_held_out(judged, errors)
    if judged.verdict not in CLAIMS:
        return judged
    against = veto(judged, errors, settings)
    if against:
        return judged.refused(against)
    near, errors = settings.near_noise, over_noise(errors, judged.noise)
    left = np.array([largest_error(errors, role) for role in ("train", "test")])
    verdict, remark = judged.verdict, ""
    if verdict is Verdict.FOUND and np.any(left > near):
        verdict = Verdict.PARTIAL
        remark = f', which exceeds the limit of {near:.3g} times for the verdict "found"'
    elif (
        verdict is Verdict.FOUND
        and not judged.filtered
        and _more_held_out(errors, judged.independent)
    ):
        verdict = Verdict.PARTIAL
        remark = (
            ", which is significantly more than in any training experiment, so the model still "
            "lacks something"
        )
    said = what_is_left(errors, judged.over, remark)
    if verdict is Verdict.FOUND and (without_noise(errors) or not_simulated(errors)):
        verdict = Verdict.PARTIAL
        said += ", so it is not known whether everything was found"
    return replace(judged, verdict=verdict, reason=in_sentences((said, judged.reason)))


def _without_more_held_out(
    judged: ReasonedVerdict, errors: Sequence[ErrorChange]
) -> ReasonedVerdict:
    """Return the verdict "none", but "unexplained" if it does not hold for the held-out data."""
    errors = over_noise(errors, judged.noise)
    if judged.filtered or not _more_held_out(errors, judged.independent):
        return judged
    more = ", which is significantly more than in any training experiment"
    why = (
        "either the model lacks something that only the held-out experiments show, or the training "
        "experiments do not determine its parameters well enough"
    )
    training = f"in the training experiments, {judged.reason}"
    reason = in_sentences((what_is_left(errors, judged.over, more), why, training))
    return replace(judged, verdict=Verdict.UNEXPLAINED, reason=reason)


def _more_held_out(errors: Sequence[ErrorChange], independent: float) -> bool:
    """Return whether an output's held-out error is above that of all training experiments.

    If both errors are noise alone, the ratio of their squares has an F distribution. The
    uncertainty of the estimates makes predictions worse, so a ratio up to `HELD_OUT_ERROR` is
    allowed. Experiments may differ in their noise, so the training experiment with the largest
    error is used.
    """
    for output in dict.fromkeys(e.output for e in errors if e.role == "test"):
        own = [e for e in errors if e.output == output]
        largest = max(
            (e for e in own if e.role == "train" and e.normalised_after > 0.0),
            key=lambda e: e.normalised_after,
            default=None,
        )
        if largest is None:
            continue
        more = pooled_error(own, "test", after=True) / largest.normalised_after
        samples = sum(e.samples for e in own if e.role == "test"), largest.samples
        p = fdtrc(*(max(independent * count, 1.0) for count in samples), more**2)
        if more > HELD_OUT_ERROR and p < RARE:
            return True
    return False


def veto(judged: ReasonedVerdict, errors: Sequence[ErrorChange], settings: LoopSettings) -> str:
    """Return why held-out data contradict the claimed effects; "" if they do not."""
    if judged.verdict not in CLAIMS:
        return ""
    near, errors = settings.near_noise, over_noise(errors, judged.noise)
    lost = no_longer_simulated(errors)
    if lost:
        return f"with the effects, experiment {', '.join(lost)} can no longer be simulated"
    both = comparable(errors)
    old, new = (pooled_error(both, "test", after=after) for after in (False, True))
    if new > old and not judged.filtered:  # with a filter, likelihoods were compared instead
        return f"the held-out error would grow from {old:.4g} to {new:.4g} times {judged.over}"
    floor = judged.floor
    closed = (old**2 - new**2) / (old**2 - floor**2) if old > near * floor else np.nan
    if closed < judged.least:
        return (
            f"on held-out data, the effects would remove only {in_percent(closed)} of {EXCESS}: "
            f"the error would go from {old:.3g} to {new:.3g} times {judged.over}"
        )
    return ""
