"""The last fits of a search, and its answer after them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from cluster_est.closed_loop.findings.description import error_changes
from cluster_est.closed_loop.findings.effects import ErrorChange, NoiseChange
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict, confirmed, veto
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.selection.answer import undetermined_sentence
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.methods.least_squares.iteration import NOTICEABLE
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Ending, Solution
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.complete import complete, simulate_all
from cluster_est.results.guarded import GuardedSteps
from cluster_est.results.result import Result
from cluster_est.running.search_state import SearchRequest, assemble_evaluation
from cluster_est.uncertainty import examine

FINAL = LeastSquares(trials=2, max_iterations=50, differences="central")

STRAIGHT_STEPS = 3
"""Iterations of the first fit to all rows, which uses no logarithms of parameters. A second fit
follows; its result is reported."""


@dataclass(frozen=True)
class LastFits:
    """The last fits of the declared model and of the model with effects, and their errors.

    If no effect was added, `before` and `after` are the same fit. `noise` contains the strengths of
    the process noise in both fits.
    """

    before: Result = field(repr=False)
    after: Result = field(repr=False)
    errors: tuple[ErrorChange, ...]
    noise: tuple[NoiseChange, ...] = ()


def last_fits(fitter: Fitter, found: SelectionResult, begin: float) -> LastFits:
    """Fit both models to convergence, from the values with which the search ended."""
    starts = [model.start for model in last_models(found)]
    return _fitted_from(fitter, found, starts, begin, FINAL)


def last_fits_to_all_rows(
    fitter: Fitter,
    found: SelectionResult,
    starts: Sequence[FitStart],
    begin: float,
) -> LastFits:
    """Fit both models to all rows, from the best values on thinned records (`best_on_few_rows`).

    The first steps also use no logarithms of parameters (see `_straight_fits`), because the best
    values for all rows may be several standard errors away along a valley of the cost.
    """
    experiments = fitter.problem.experiments
    moved = [
        replace(start, problem=replace(start.problem, experiments=experiments)) for start in starts
    ]
    method = replace(_of_many_rows(fitter.size), trials=1)
    first_steps = replace(method, max_iterations=STRAIGHT_STEPS)
    near = [start for start, _ in _straight_fits(fitter, moved, first_steps)]
    return _fitted_from(fitter, found, near, begin, method)


def best_on_few_rows(
    fitter: Fitter, starts: Sequence[FitStart]
) -> list[tuple[FitStart, FittedModel | None]]:
    """Fit both models to convergence on thinned records, as the start of a fit to all rows.

    The time of an iteration is proportional to the number of rows, so most iterations are done on
    the thinned records. For each model, the result contains a start with the fitted values, and the
    fit. If a model cannot be simulated, these are the unchanged start and None.
    """
    return _straight_fits(fitter, starts, _of_many_rows(fitter.size))


def _straight_fits(
    fitter: Fitter, starts: Sequence[FitStart], method: LeastSquares
) -> list[tuple[FitStart, FittedModel | None]]:
    """Fit with the parameters themselves as unknowns, without logarithms.

    If the data can hardly distinguish two terms, such as two dampings, the cost has a valley along
    which their sum is constant. As a function of the parameters, this valley is straight. As a
    function of their logarithms, it is curved, and the fit would need many short steps.
    """
    found: list[tuple[FitStart, FittedModel | None]] = []
    for start in starts:
        linear = tuple(replace(p, scale="linear") for p in start.problem.parameters)
        straight = replace(start, problem=replace(start.problem, parameters=linear))
        (fit,) = fitter.fit(LoopStage.FINAL, [straight], method)
        found.append((start if fit is None else replace(start, values=fit.estimates), fit))
    return found


def last_models(found: SelectionResult) -> list[FittedModel]:
    """Return the declared model and, if effects were added, the model with the effects."""
    return [found.base, found.current] if found.current.added else [found.base]


def _fitted_from(
    fitter: Fitter,
    found: SelectionResult,
    starts: Sequence[FitStart],
    begin: float,
    method: LeastSquares,
) -> LastFits:
    fits = [final_fit(fitter, start, begin, method) for start in starts]
    before, after = fits[0], fits[-1]
    return LastFits(before, after, error_changes(fitter, found, before, after))


@dataclass(frozen=True)
class LastAnswer:
    """An answer of a search after its last fits, with the verdict on the training experiments.

    A search has several possible answers. `number` is the index of this answer. `against` says why
    the answers before it were refused.
    """

    found: SelectionResult = field(repr=False)
    judged: ReasonedVerdict
    fits: LastFits = field(repr=False)
    number: int = 0
    against: tuple[str, ...] = ()

    @property
    def confirmed(self) -> ReasonedVerdict:
        """The verdict after the check on held-out data."""
        return confirmed(self.judged, self.fits.errors, self.found.settings)

    @property
    def keeps_effects(self) -> bool:
        """Whether the effects of the answer are reported as found."""
        return self.confirmed.verdict in CLAIMS


def last_answer(
    ends: Sequence[tuple[SelectionResult, ReasonedVerdict]],
    last: Sequence[Callable[[], LastFits]],
    without: Callable[[FittedModel, int, float], float],
) -> LastAnswer:
    """Return the first answer that is not refused after its last fits.

    If all answers are refused, the first one is returned, with a verdict that claims nothing.

    Parameters
    ----------
    ends
        The possible answers of the search, with their verdicts.
    last
        For each answer, a function that does its last fits.
    without
        `p_without` on the fitter of the search.
    """
    refused: list[LastAnswer] = []
    said: list[str] = []
    for number, ((found, judged), fit) in enumerate(zip(ends, last, strict=True)):
        fits = fit()
        against = veto(judged, fits.errors, found.settings)
        if not against and judged.verdict in CLAIMS:
            against = undetermined_sentence(found.current, fits.after, without)
        if not against:
            return LastAnswer(found, judged, fits, number, tuple(said))
        refused.append(LastAnswer(found, judged.refused(against), fits, number))
        labels = " and ".join(c.label for c in found.current.added)
        said.append(f"{labels}: not added, because {against}")
    return refused[0]


def _of_many_rows(count: int) -> LeastSquares:
    """Return the method of the last fits to `count` residuals, if simulations take long.

    The fit ends when its steps are below a tenth of the standard errors. Compared with this limit,
    the error of forward differences is negligible.
    """
    ftol = max(FINAL.ftol, 0.25 * NOTICEABLE / count)
    return replace(FINAL, ftol=ftol, differences="forward", secant_updates=5)


def final_fit(
    fitter: Fitter, start: FitStart, begin: float, method: LeastSquares = FINAL
) -> Result:
    """Fit to convergence and simulate every experiment; `begin` is the time of the run's start."""
    space = fitter.space(start)
    (solution,) = fitter.runner.run([SearchRequest("final", method, space, fitter.seed)])
    return _completed(fitter, space, solution, method, begin, examined=True)


def _completed(
    fitter: Fitter,
    space: SearchSpace,
    solution: Solution,
    method: LeastSquares,
    begin: float,
    *,
    examined: bool,
) -> Result:
    """Return the result of a fit, with simulations of all experiments; see `complete`."""
    runner, steps = fitter.runner, GuardedSteps()
    before = simulate_all(runner, space.problem, {})
    known = None
    if examined:
        known = steps.assessed(space, solution, lambda: examine(runner, space, solution))
    found = complete(
        runner,
        space,
        solution,
        method,
        before,
        variables=fitter.description.variables,
        seed=fitter.seed,
        begin=begin,
        steps=steps,
        uncertainty=known,
    )
    return replace(found, failed_steps=tuple(steps.failed))


def as_it_is(fitter: Fitter, fitted: FittedModel, begin: float) -> Result:
    """Return the result of a fit of the search; the model is simulated once more."""
    space, runner = fitted.space, fitter.runner
    values = space.physical(fitted.x)
    effects = fitted.problem.effects
    outcomes = runner.simulate(values, space.experiments, "residuals", "final", effects)
    at = assemble_evaluation(space, fitted.x, tuple(outcomes), 0)
    ending = Ending.CONVERGED if fitted.converged else Ending.MAX_ITERATIONS
    solution = Solution(fitted.x, at.cost, ending, jacobian=fitted.jacobian, at=at)
    return _completed(fitter, space, solution, FINAL, begin, examined=False)
