"""Long records: the search uses thinned records, and its result is confirmed on all rows."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from cluster_est.closed_loop.account import account, last_noise, result_so_far
from cluster_est.closed_loop.findings.description import inputs_like_ramps
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter, with_outputs
from cluster_est.closed_loop.last_fits import (
    LastAnswer,
    best_on_few_rows,
    last_answer,
    last_fits_to_all_rows,
    last_models,
)
from cluster_est.closed_loop.numerical_error import NumericalError
from cluster_est.closed_loop.outliers import (
    Place,
    fit_from_start,
    open_checked_workbench,
    outlier_notes,
    outliers_of_long_records,
    without,
)
from cluster_est.closed_loop.process_noise import SpentSimulations, with_all
from cluster_est.closed_loop.search import SearchedModel, search_for_effects
from cluster_est.closed_loop.search_windows import SearchWindows, choose_windows
from cluster_est.closed_loop.selection.answer import p_without
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, LoopWorkbench, open_workbench
from cluster_est.errors import ClusterEstError
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.problem.thinning import (
    FINENESS,
    ThinnedProblem,
    looked_at_in_parts,
    thinned,
)
from cluster_est.results.interpolation import (
    InterpolationTest,
    PreferredInterpolation,
    examine_interpolations,
    with_effects_added,
)
from cluster_est.results.residual_diagnostics import training_residuals
from cluster_est.results.result import Result
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import Resources, TaskOrigin
from workers.messages import FloatArray, Outcome, Output

FAINT = 0.3
"""Largest change of the model's outputs by thinning: the root mean square, relative to the noise of
a thinned row."""

MANY = (LoopStage.TRIALS, LoopStage.REFITS, LoopStage.PROBE, LoopStage.DROP)
"""The stages with most simulations."""

CONFIRMED_ON_ALL = "estimates, errors and conclusions are from all rows"


def thinned_records(request: LoopRequest, most: int | None) -> ThinnedProblem:
    """Thin the long records of a search, as coarsely as the model allows.

    The declared model is simulated at its start values, on all rows and on the thinned rows.
    Thinning changes the outputs, through its filter and through inputs with fewer samples. This
    change must be below the noise of a thinned row, and the measured rows are corrected by it. If
    no way of thinning satisfies this, the records are not thinned.

    Returns
    -------
    ThinnedProblem
        The thinned problem. Outliers were left out of its `whole` problem.
    """
    whole = request.problem
    first = thinned(whole, most, FINENESS[0])
    if most is None or not first.is_thinner:
        return first
    outliers = outliers_of_long_records(whole, most)
    whole = without(whole, outliers) if outliers else whole
    resources = request.environment.resources
    for found, corrected in ways_to_thin(whole, most, resources, None if outliers else first):
        if corrected is not None:
            said = outlier_notes(outliers)
            return replace(corrected, whole=whole, sentence="; ".join([found.sentence, *said]))
    return thinned(request.problem, None)


def ways_to_thin(
    whole: Problem, most: int | None, resources: Resources, first: ThinnedProblem | None = None
) -> Iterator[tuple[ThinnedProblem, ThinnedProblem | None]]:
    """Give thinned records, the coarsest first, each also in the form that a search uses.

    The form for a search is corrected; see `_corrected`. It is None if thinning changes the outputs
    too much. If nothing can be simulated, there is no correction. `first` is the coarsest thinning,
    if it is already known.
    """
    full: list[list[FloatArray]] | None = None
    for fineness in FINENESS:
        found = first or thinned(whole, most, fineness)
        first = None
        if not found.is_thinner:
            return
        full = full or _simulated(whole, resources)
        yield found, found if full is None else _like_all_rows(found, full, resources)


def _like_all_rows(
    thin: ThinnedProblem, full: list[list[FloatArray]], resources: Resources
) -> ThinnedProblem | None:
    """Correct thinned records by the change that thinning causes; None if it is too large."""
    simulated = _simulated(thin.problem, resources)
    if simulated is None:
        return None
    changes = _changes(thin, full, simulated)
    return _corrected(thin, changes) if _over_noise(thin, changes) <= FAINT else None


def _simulated(problem: Problem, resources: Resources) -> list[list[FloatArray]] | None:
    """The training outputs at the start values; None if they cannot be simulated."""
    train = problem.indices("train")
    space = make_space(problem, train)
    runs = tuple(problem.experiments[e] for e in train)
    values = space.physical(space.start)
    try:
        outcomes = simulate_with_solver(
            problem, runs, values, problem.model.solver, "residuals", resources, beside=None
        )
    except ClusterEstError:
        return None
    found = []
    for run, outcome in zip(runs, outcomes, strict=True):
        if not outcome.ok or outcome.residuals is None:
            return None
        ends = np.cumsum([len(o.times) for o in run.outputs])[:-1]
        parts = np.split(outcome.residuals, ends)
        found.append([o.values - o.sigmas * r for o, r in zip(run.outputs, parts, strict=True)])
    return found


Changes = Mapping[Place, FloatArray]


def _changes(
    thin: ThinnedProblem, full: list[list[FloatArray]], simulated: list[list[FloatArray]]
) -> Changes:
    """Simulated outputs on thinned rows, minus the thinned outputs of a simulation on all rows."""
    found = {}
    for e, all_rows, rows in zip(thin.problem.indices("train"), full, simulated, strict=True):
        outputs = thin.problem.experiments[e].outputs
        for output, matrix, one, other in zip(outputs, thin.rows[e], all_rows, rows, strict=True):
            if matrix is not None:
                found[e, output.variable] = other - matrix @ one
    return found


def _over_noise(thin: ThinnedProblem, changes: Changes) -> float:
    """Largest root mean square change of an output, relative to its noise."""
    squares: dict[str, list[FloatArray]] = {}
    for (e, name), change in changes.items():
        output = next(o for o in thin.problem.experiments[e].outputs if o.variable == name)
        unit = output.sigmas * (1.0 if output.has_sigma else thin.within[name])
        squares.setdefault(name, []).append((change / unit) ** 2)
    means = [float(np.mean(np.concatenate(parts))) for parts in squares.values()]
    return float(np.sqrt(max(means, default=0.0)))


def _corrected(thin: ThinnedProblem, changes: Changes) -> ThinnedProblem:
    """Add the change of the simulated outputs by thinning to the measured rows.

    The filter distorts fast changes within a block, in the measured outputs but not in the
    simulated ones. At the start values of the declared model, this error is known and is corrected.
    What remains is its change with the parameters, as in a deferred correction (V. Pereyra, Numer.
    Math. 8 (1966) 376-391, doi:10.1007/BF02162981).
    """

    def change(e: int, output: Output) -> Output:
        own = changes.get((e, output.variable))
        return output if own is None else replace(output, values=output.values + own)

    return replace(thin, problem=with_outputs(thin.problem, change))


def with_slim_log(
    environment: RunEnvironment, stages: Collection[LoopStage] | None = None
) -> RunEnvironment:
    """Return an environment whose log has no residuals for some stages; None for all stages.

    A resumed run simulates these again, which takes less time than its other work.
    """
    record = environment.monitor.record
    names = None if stages is None else {stage.value for stage in stages}

    def slim(origin: TaskOrigin, outcome: Outcome) -> None:
        if record is not None:
            left_out = origin.slim or names is None or origin.search in names
            record(replace(origin, slim=left_out), outcome)

    return replace(environment, monitor=replace(environment.monitor, record=slim))


@contextmanager
def open_on_all_rows(
    request: LoopRequest, thin: ThinnedProblem, searching: Fitter
) -> Iterator[Fitter]:
    """Open a fitter with all rows, weighted like the fitter of a search on thinned records.

    Its log has no residuals, because its few simulations would take most of the log.
    """
    weights = {
        (e, o.variable): o
        for e, experiment in enumerate(searching.problem.experiments)
        for o in experiment.outputs
    }

    def change(e: int, output: Output) -> Output:
        own = weights[e, output.variable]
        return replace(
            output,
            sigma=own.sigma,
            relative_sigma=own.relative_sigma,
            sigma_known=own.sigma_known,
        )

    request = replace(
        request,
        problem=with_outputs(thin.whole, change),
        environment=with_slim_log(request.environment),
        sigma_declared=searching.sigma_declared,
    )
    with open_workbench(request) as whole:
        yield whole.fitter


@contextmanager
def reopened(request: LoopRequest, workbench: LoopWorkbench) -> Iterator[LoopWorkbench]:
    """Open an earlier workbench again, because only one set of workers can exist at a time."""
    with open_workbench(replace(request, problem=workbench.fitter.problem)) as again:
        runner, meter = again.fitter.runner, again.fitter.meter
        yield replace(workbench, fitter=replace(workbench.fitter, runner=runner, meter=meter))


@dataclass(frozen=True)
class AccountedSearch:
    """The result of a search, in words.

    Attributes
    ----------
    result, searched
        The result without the notes on the solver, and the search itself.
    error
        Error of the solver at the last model.
    interpolation
        An input for which the measurements prefer another interpolation.
    """

    result: LoopResult
    searched: SearchedModel
    error: NumericalError
    interpolation: PreferredInterpolation | None


def search_and_keep(
    request: LoopRequest,
    workbench: LoopWorkbench,
    begin: float,
    said: str = "",
) -> SearchedModel:
    """Search for effects, and save a result after each round that has added an effect.

    Parameters
    ----------
    said
        Description of the thinned records; "" for a search on the measured records.
    """
    kept = request.environment.monitor.reached

    def keep_so_far(found: SelectionResult, tested: InterpolationTest) -> None:
        if kept is None:
            return
        result = result_so_far(workbench.fitter, found, begin, workbench.scope, tested.linear, said)
        if result is not None:
            kept(result)

    start = FitStart(workbench.fitter.problem, {})
    resources = request.environment.resources
    return search_for_effects(workbench, start, resources, keep_so_far, thinned=bool(said))


def loop_on_thinned_records(
    request: LoopRequest, thin: ThinnedProblem, begin: float
) -> AccountedSearch:
    """Search on thinned records, or on parts of them, and fit the found model to all rows.

    Parameters
    ----------
    request
        The request with the problem before thinning.
    begin
        Start time of the run on the monotonic clock.
    """
    environment = with_slim_log(request.environment, MANY)
    request = replace(
        request, problem=thin.problem, noise_of_samples=thin.noise, environment=environment
    )
    return _ThinnedLoop(request, thin, begin).run()


@dataclass(frozen=True)
class _Search:
    """A finished search.

    Attributes
    ----------
    workbench
        The workbench that the search used.
    searched
        The result of the search.
    starts
        For each answer, the models without and with the effects, fitted to thinned records.
    errors
        Error of the solver at the last model of each answer.
    said
        Description of the records that the search used.
    """

    workbench: LoopWorkbench
    searched: SearchedModel
    starts: Sequence[Sequence[FitStart]]
    errors: Sequence[NumericalError]
    said: str


def _fit_straight(fitter: Fitter) -> FittedModel | None:
    """Fit the declared model with as few simulations as possible, because each takes long."""
    ((_, fitted),) = best_on_few_rows(fitter, [FitStart(fitter.problem, {})])
    return fitted


Opened = TypeVar("Opened", LoopWorkbench, Fitter)


@dataclass(frozen=True)
class _ThinnedLoop:
    """A search for missing effects on thinned records.

    Attributes
    ----------
    request, thin, begin
        See `loop_on_thinned_records`.
    spent
        Number of simulations on each closed workbench; only one set of workers can exist at a time.
    """

    request: LoopRequest
    thin: ThinnedProblem
    begin: float
    spent: list[SpentSimulations] = field(default_factory=list)

    def run(self) -> AccountedSearch:
        rows = self.request.rows
        long = bool(looked_at_in_parts(self.request.problem, rows))
        fit = _fit_straight if long else fit_from_start
        made = self.thin.thinned_outputs
        with self._counted(open_checked_workbench(self.request, fit, made)) as whole:
            windows = None
            if long:
                windows = choose_windows(whole.fitter, rows, whole.first_fit, whole.near)
            if windows is None:
                found = self._search(replace(whole, first_fit=None) if long else whole)
        if windows is not None:
            found = self._search_in(windows, whole)
        return self._confirmed(found)

    def _search_in(self, windows: SearchWindows, whole: LoopWorkbench) -> _Search:
        """Search in windows; if they are not sufficient, search again in the whole records."""
        declared = whole.fitter.sigma_declared
        request = replace(self._left(), problem=windows.problem, sigma_declared=declared)
        with self._counted(open_workbench(request)) as opened:
            parts = replace(opened, scope=whole.scope)
            why = windows.unlike_records(parts.fitter)
            if not why:
                found = self._search(parts, windows.sentence)
        with self._counted(reopened(self._left(), whole)) as again:
            if not why:
                hidden = found.searched.error.hides_effects
                found_some = len(found.starts[0]) > 1 or hidden
                why = "" if found_some else "no effect was found in the parts"
            if not why:
                again.fitter.enter("before and after")
                fits = [
                    best_on_few_rows(again.fitter, windows.on_whole_records(again.fitter, starts))
                    for starts in found.starts
                ]
                why = "" if hidden else windows.missed(again.fitter, fits[0][-1][1])
                if not why:
                    starts = [[start for start, _ in models] for models in fits]
                    return replace(found, starts=starts)
            unfitted = replace(again, first_fit=None)
            more = f"{windows.sentence}, and then in the whole records, because {why}"
            return self._search(unfitted, more)

    def _search(self, workbench: LoopWorkbench, more: str = "") -> _Search:
        """Search, and fit both models to convergence on the records of the search."""
        said = "; ".join(filter(None, [self.thin.sentence, more]))
        searched = search_and_keep(self.request, workbench, self.begin, said)
        workbench.fitter.enter("before and after")
        starts, errors = [], []
        for found, _ in searched.ends:
            models = [model.start for model in last_models(found)]
            starts.append([start for start, _ in best_on_few_rows(workbench.fitter, models)])
            added = found.current.added
            errors.append(searched.error_at(found.current) if added else searched.error)
        return _Search(workbench, searched, starts, errors, said)

    def _confirmed(self, done: _Search) -> AccountedSearch:
        """Fit both models to convergence on all rows, and describe the result in words.

        The interpolation that the measurements prefer is also determined from all rows.
        """
        begin, searching = self.begin, done.workbench
        opened = open_on_all_rows(self._left(), self.thin, searching.fitter)
        with self._counted(opened) as whole:
            whole.enter("before and after")
            last = [
                partial(last_fits_to_all_rows, whole, found, starts, begin)
                for (found, _), starts in zip(done.searched.ends, done.starts, strict=True)
            ]

            def without(model: FittedModel, position: int, degrees: float) -> float:
                with reopened(self._left(), searching) as again:
                    return p_without(again.fitter, model, position, degrees)

            answer = last_answer(done.searched.ends, last, without)
            tested = self._interpolations(whole, done, answer)
        with reopened(self._left(), searching) as again:
            result = account(again.fitter, answer, searching.scope, tested.linear)
            left = last_noise(again.fitter, answer.found, keep=bool(result.effects))
        noise = whole.noise_in_units(left)
        notes = (f"{done.said}; {CONFIRMED_ON_ALL}", *result.notes)
        result = with_all(replace(result, noise=noise, notes=notes), self.spent)
        return AccountedSearch(result, done.searched, done.errors[answer.number], tested.preferred)

    def _interpolations(
        self, whole: Fitter, done: _Search, answer: LastAnswer
    ) -> InterpolationTest:
        """Test the interpolations at the last fits to all rows."""
        fits, starts = answer.fits, done.starts[answer.number]

        def tested(start: FitStart, fit: Result, *, refits: bool) -> InterpolationTest:
            space = whole.space(replace(start, problem=fit.problem))
            resources = self.request.environment.resources
            known = fit.solution, fit.simulations, resources, whole.runner
            return examine_interpolations(space, *known, refits=refits)

        declared = tested(starts[0], fits.before, refits=True)
        if not answer.keeps_effects:
            return declared
        again = tested(starts[-1], fits.after, refits=False)
        before, after = (
            training_residuals(whole.space(replace(start, problem=fit.problem)), fit.simulations)
            for start, fit in ((starts[0], fits.before), (starts[-1], fits.after))
        )
        if before is None or after is None:
            return again
        more = len(fits.after.solution.x) - len(fits.before.solution.x)
        as_good = declared.as_good_as(whole.runs, before, after, more)
        ramps = inputs_like_ramps(answer.found.current.added)
        return with_effects_added(declared, again, as_good, ramps)

    @contextmanager
    def _counted(self, opened: AbstractContextManager[Opened]) -> Iterator[Opened]:
        with opened as made:
            yield made
            fitter = made.fitter if isinstance(made, LoopWorkbench) else made
            self.spent.append(SpentSimulations.at(fitter))

    def _left(self) -> LoopRequest:
        """Return the request with the remaining budget."""
        used = sum(each.evaluations for each in self.spent)
        environment = self.request.environment.left(used, time.monotonic() - self.begin)
        return replace(self.request, environment=environment)
