"""The search for missing effects: moves propose sets of effects, and gates refuse them.

    model = fit_declared(data)
    while some candidate is significant:
        for each move: propose structures, choose the best that passes all gates
        if there is none: stop
        model = the best, without effects that are no longer needed
    if the model leaves more than noise: try a free curve or filter instead of all effects
    model = the accepted one that best predicts data that are left out of refits
    judge the model
    if it has functions of time but leaves more than noise: search again without them

It is stepwise forward selection with backward elimination (N. R. Draper, H. Smith, Applied
Regression Analysis, 1998, doi:10.1002/9781118625590), over structures, which are sets of effects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.findings.description import inputs_like_ramps
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.findings.verdict import ReasonedVerdict, judge
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.numerical_error import (
    NumericalError,
    error_with_effects,
    measure_numerical_error,
)
from cluster_est.closed_loop.output_noise import expected_noise, noise_of
from cluster_est.closed_loop.screening.screen import CandidateEvidence, findings, screen
from cluster_est.closed_loop.selection.acceptance import LeaveOneOutPrediction, predict
from cluster_est.closed_loop.selection.answer import answers
from cluster_est.closed_loop.selection.argument_functions import curve_instead
from cluster_est.closed_loop.selection.gates import choose, reason_to_stop
from cluster_est.closed_loop.selection.moves import MOVES, drop, release_widths
from cluster_est.closed_loop.selection.refits import rivals_of
from cluster_est.closed_loop.selection.rounds import (
    AcceptedStructure,
    ComparedStructure,
    RejectionReason,
    RoundEnd,
    RoundStart,
    SelectionResult,
    SelectionRound,
    compared_structure,
    compared_structures,
    evidence_of_round,
    with_single,
    without_search,
)
from cluster_est.closed_loop.selection.starts import fit_declared
from cluster_est.closed_loop.settings import LoopPart, LoopSettings
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.results.interpolation import (
    AtFit,
    FittedExperiments,
    InterpolationTest,
    compare_interpolations,
    with_effects_added,
)
from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.record_faults.find import record_faults
from cluster_est.results.record_faults.fitted_records import FittedRecords
from cluster_est.running.resources import Resources
from workers.messages import FloatArray


@dataclass(frozen=True)
class SearchedModel:
    """The result of a search, and the numerical error of its simulations.

    Attributes
    ----------
    ends
        The possible answers, each with its verdict on the training experiments. If held-out
        experiments contradict the first answer, the next one is used.
    error
        Numerical error of the solver with the declared model.
    error_at
        A function that returns the numerical error with another model.
    failures
        Number of simulations that failed while effects were tried.
    interpolations
        The test of the inputs' interpolations at the declared model.
    interpolations_with
        A function that returns this test at a model with effects.
    """

    ends: list[tuple[SelectionResult, ReasonedVerdict]] = field(repr=False)
    error: NumericalError = field(repr=False)
    error_at: Callable[[FittedModel], NumericalError] = field(repr=False)
    failures: int
    interpolations: InterpolationTest
    interpolations_with: Callable[[FittedModel], InterpolationTest] = field(repr=False)

    @property
    def found(self) -> SelectionResult:
        return self.ends[0][0]


def search_for_effects(
    workbench: LoopWorkbench,
    start: FitStart,
    resources: Resources,
    reached: Callable[[SelectionResult, InterpolationTest], None] = lambda *_: None,
    *,
    thinned: bool = False,
) -> SearchedModel:
    """Fit the declared model, and look for effects that it lacks.

    Parameters
    ----------
    resources
        Resources for the simulations with a finer solver setting.
    reached
        Called after each round that added an effect, with the result so far and the test of the
        inputs' interpolations at the declared model.
    thinned
        Whether the records are thinned, so that the samples of the inputs are not the measured
        ones.
    """
    fitter, settings = workbench.fitter, workbench.settings
    fitter.enter("the declared model")
    base = fit_declared(fitter, start, settings.starts, workbench.first_fit)
    noise = expected_noise(fitter, base.residuals)
    fitter.enter("the error of the solver")
    error = measure_numerical_error(fitter, base, noise, resources)
    tested = InterpolationTest() if thinned else _interpolations(fitter, base, resources)
    with_effects = partial(
        error_with_effects, fitter, declared=error, noise=noise, resources=resources
    )
    fitter = fitter.limited_by(base)
    before = fitter.runner.failures
    faults = _record_faults(fitter, base, resources)
    said = "; ".join(each.sentence for each in faults)
    if error.hides_effects or any(each.kind != "foreign source" for each in faults):
        found = without_search(fitter, settings, base)
        first = CORRECT_RECORDS if said else error.remedy
        reason = said or error.refusal
        ends = [(found, ReasonedVerdict(Verdict.UNEXPLAINED, reason, first=first))]
    else:

        def grown(log: SearchLog) -> SelectionResult:
            return grow(
                log,
                lambda fit: with_effects(fit).explainable,
                lambda found: reached(found, tested),
            )

        ends = _judged_answers(grown, SearchLog.begun(fitter, settings, base))
        found, judged = ends[0]
        if said and judged.verdict is Verdict.UNEXPLAINED:
            reason = f"{said}; {judged.reason}"
            ends[0] = found, replace(judged, reason=reason, first=CORRECT_RECORDS)
    failures = fitter.runner.failures - before
    again = partial(_interpolations_with_effects, fitter, base, tested, resources)
    return SearchedModel(ends, error, with_effects, failures, tested, again)


CORRECT_RECORDS = "correct the records"


def _record_faults(
    fitter: Fitter, base: FittedModel, resources: Resources
) -> tuple[RecordFault, ...]:
    """Return faults of the records that alone explain the residual.

    With the fault corrected, the records show no missing effect, so there is no search.
    """
    if fitter.predicts:
        return ()
    fitter.enter("the records")

    def counted(simulations: int) -> None:
        fitter.meter.full += simulations

    return record_faults(
        FittedRecords(
            base.problem, base.space, base.x, base.residuals, base.jacobian, fitter.runner,
            resources, counted,
        )
    )  # fmt: skip


def _interpolations(fitter: Fitter, model: FittedModel, resources: Resources) -> InterpolationTest:
    """Test which interpolations of the inputs the measurements prefer.

    The error of a wrong interpolation looks like a delay or a lag. So the declared model may also
    be fitted again with another interpolation.
    """
    if fitter.predicts:
        return InterpolationTest()
    fitter.enter("the interpolation of the inputs")

    def counted(simulations: int) -> None:
        fitter.meter.full += simulations

    at = AtFit.of(model.space, model.x, resources, fitter.runner, counted)
    fitted = FittedExperiments(model.problem, fitter.train, model.residuals, model.jacobian)
    return compare_interpolations(fitted, at, refits=not model.added)


def _interpolations_with_effects(
    fitter: Fitter,
    base: FittedModel,
    declared: InterpolationTest,
    resources: Resources,
    model: FittedModel,
) -> InterpolationTest:
    """Test the interpolations again at a model with effects; see `with_effects_added`."""
    more = model.space.size - base.space.size
    as_good = declared.as_good_as(fitter.runs, base.residuals, model.residuals, more)
    again = _interpolations(fitter, model, resources)
    return with_effects_added(declared, again, as_good, inputs_like_ramps(model.added))


def grow(
    log: SearchLog,
    numerical: Callable[[FittedModel], float],
    reached: Callable[[SelectionResult], None],
) -> SelectionResult:
    """Add effects to the declared model as long as they pass the gates.

    For a fitted model, `numerical` returns the decrease of the sum of squares that the numerical
    error of the solver could cause.
    """
    fitter, base = log.fitter, log.base
    now = AcceptedStructure(base, log.predicted)
    first: RoundStart | None = None
    passed: set[frozenset[str]] = set()
    while True:
        begun = _screened(log, now, numerical)
        passed.add(now.model.structure)
        best = propose_and_choose(fitter, begun)
        log.note(now, begun, best)
        if best.won is None or best.prediction is None:
            single = curve_instead(fitter, first, now) if first is not None else None
            if single is None:
                break
            now, first = log.accept_single(single), None
            continue
        if first is None and not begun.model.added:
            first = replace(begun, screening=begun.screening.without_bases())
        won, prediction = best.won.fitted, best.prediction
        model = release_widths(fitter, begun, drop(fitter, begun, won))
        found = rivals_of(best.won, best.seen.contenders)
        rivals = {**found, **now.rivals, **{name: own for name, own in found.items() if own[1]}}
        if model.structure != won.structure:
            log.keep(AcceptedStructure(won, prediction, rivals))
            log.accept(model, LoopPart.DROP)
        if model is not won:
            prediction = predict(fitter, model)
        if model.structure in passed:
            break
        now = AcceptedStructure(model, prediction, rivals)
        reached(log.result(now))
        del begun, best  # the next ones are as large
    return log.result(now)


def propose_and_choose(fitter: Fitter, begun: RoundStart) -> RoundEnd:
    """Let each move propose structures, and choose the best that passes the gates."""
    stop = reason_to_stop(begun)
    if stop is not None:
        return RoundEnd(SelectionRound(begun.screening, (), stop))
    best = RoundEnd(SelectionRound(begun.screening, (), RejectionReason.LITTLE_PROMISED))
    for move in MOVES:
        if begun.has(move.part) and move.is_worth(begun, best):
            begun = move.widened(fitter, begun)
            proposals = [
                replace(proposal, move=proposal.move or move.part)
                for proposal in move.propose(fitter, begun, best)
            ]
            own = choose(fitter, begun, proposals)
            compared = (*best.compared, *proposals)
            stopped = {**best.stopped, **own.stopped}
            best = replace(move.preferred(begun, best, own), compared=compared, stopped=stopped)
    return best


def _judged_answers(
    grown: Callable[[SearchLog], SelectionResult], log: SearchLog
) -> list[tuple[SelectionResult, ReasonedVerdict]]:
    """Search, and judge the answers; functions of time are kept only if no more than noise is left.

    A drift or a sinusoid in time can follow the slow part of any disturbance, and of any effect
    that changes slowly, such as friction in a free decay. It may then close most of the gap to the
    noise and predict data that were left out, and displace the missing effect. So if the first
    answer is such a function that leaves more than noise, the search is repeated without functions
    of time. If a later answer is one, it is left out.
    """
    fitter = log.fitter
    ends = [(found, judge(fitter, found)) for found in answers(fitter, grown(log))]
    timed = _insufficient_functions_of_time(*ends[0])
    if not timed:
        return [end for end in ends if not _insufficient_functions_of_time(*end)]
    without = (*log.settings.without, LoopPart.FUNCTIONS_OF_TIME)
    changed = log.settings.changed(without=without)
    again = grown(replace(log, settings=changed, rounds=[], seen=[], path=[], accepted=[]))
    if again.last.why is RejectionReason.NO_CANDIDATE:
        last = replace(again.last, why=RejectionReason.FUNCTIONS_OF_TIME)
        again = replace(again, steps=(*again.steps[:-1], last))
    last_ones = [replace(found, settings=log.settings) for found in answers(fitter, again)]
    were = "were" if len(timed) > 1 else "was"
    said = (
        f"{' and '.join(c.label for c in timed)} would leave more than noise and {were} not added, "
        "because a function of time can imitate any slow disturbance"
    )
    judged = [(found, judge(fitter, found)) for found in last_ones]
    return [(found, replace(own, reason=f"{own.reason}; {said}")) for found, own in judged]


def _insufficient_functions_of_time(
    found: SelectionResult, judged: ReasonedVerdict
) -> list[EffectCandidate]:
    """Return the functions of time of an answer that explains much but leaves more than noise."""
    timed = [c for c in found.current.added if c.form.of_time_alone]
    return timed if judged.verdict is Verdict.PARTIAL else []


@dataclass
class SearchLog:
    """The log of a search: its rounds, its candidates, and the structures that it compared.

    The `SelectionResult` is made from it. `predicted` is the prediction of the declared model, and
    `floor` is the sum of squares that the noise alone would leave.
    """

    fitter: Fitter
    settings: LoopSettings
    base: FittedModel
    predicted: LeaveOneOutPrediction
    noise: FloatArray
    floor: float
    rounds: list[SelectionRound] = field(default_factory=list)
    seen: list[CandidateEvidence] = field(default_factory=list)
    path: list[ComparedStructure] = field(default_factory=list)
    accepted: list[AcceptedStructure] = field(default_factory=list)

    @classmethod
    def begun(cls, fitter: Fitter, settings: LoopSettings, base: FittedModel) -> SearchLog:
        """Return the log of a search that begins with the declared model."""
        noise = noise_of(fitter, base.residuals)
        floor = fitter.noise_floor(noise)
        return cls(fitter, settings, base, predict(fitter, base), noise, floor)

    def note(self, now: AcceptedStructure, begun: RoundStart, end: RoundEnd) -> None:
        """Add a round, and the structure with which it began."""
        self.keep(now)
        seen = replace(end.seen, screening=end.seen.screening.without_directions())
        self.rounds.append(seen)
        records, number = self.fitter.records, len(self.rounds)
        self.seen += evidence_of_round(records, begun.model, end, number)
        self.path += compared_structures(records, self.base, end, self.floor, number)

    def keep(self, structure: AcceptedStructure) -> None:
        """Add an accepted structure, which may be the answer."""
        self.accepted.append(replace(structure, rounds=len(self.rounds)))

    def accept(self, fitted: FittedModel, move: LoopPart | None) -> None:
        """Add an accepted structure that replaces a compared one."""
        records, number = self.fitter.records, len(self.rounds)
        row = compared_structure(records, self.base, fitted, self.floor, number, move or "")
        self.path.append(row)

    def accept_single(self, end: RoundEnd) -> AcceptedStructure:
        """Add the single effect that replaces all effects."""
        won, prediction = end.won, end.prediction
        assert won is not None
        assert prediction is not None
        fall = won.criterion - self.base.criterion(self.fitter.records)
        first = findings(end.seen.screening.ranking, self.base, 1).values()
        self.seen = with_single(self.seen, first, won, fall)
        is_filter = won.candidate.form.is_dynamics
        free = LoopPart.FREE_DYNAMICS if is_filter else LoopPart.FREE_CURVE
        self.accept(won.fitted, won.move or free)
        rivals = rivals_of(won, end.seen.contenders)
        return AcceptedStructure(won.fitted, prediction, rivals)

    def result(self, now: AcceptedStructure) -> SelectionResult:
        """Return the result so far."""
        return SelectionResult(
            self.base, now.model, self.predicted, now.prediction, now.rivals, tuple(self.rounds),
            tuple(self.seen), self.noise, self.settings, tuple(self.path), tuple(self.accepted),
        )  # fmt: skip


def _screened(
    log: SearchLog,
    now: AcceptedStructure,
    numerical: Callable[[FittedModel], float],
) -> RoundStart:
    """Begin a round: compare all candidates with the residual of the accepted structure."""
    fitter, settings = log.fitter, log.settings
    found, most = len(now.model.added), settings.max_effects
    which = f"effect {found + 1} of at most {most}" if found < most else "what is left"
    fitter.enter(f"looking for {which}")
    screening = screen(fitter, settings, now.model, len(log.rounds) + 1)
    error = numerical(now.model)
    return RoundStart(
        base=log.base,
        model=now.model,
        prediction=now.prediction,
        screening=screening,
        floor=log.floor,
        settings=settings,
        sigma_declared=fitter.sigma_declared,
        numerical=error,
    )
