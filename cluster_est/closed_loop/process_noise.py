"""The search for missing effects in a model with process noise.

1. Fit the declared model and its process noise by prediction errors.
2. Fix this noise and search. The residuals are innovations over their standard deviations. If the
   model is right, they are white with variance 1, as the tests of the search require. If an effect
   is missing, the fitted noise explains a part of it and is too large. The tests then see less of
   the effect, but they do not see effects that do not exist.
3. Fit the noise again with the effects that were found. Fix it, and search again from the declared
   model. Repeat this until a search finds the same effects as an earlier one.
4. Compare both models, each with its own fitted noise, and report.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from cluster_est.closed_loop.account import account
from cluster_est.closed_loop.findings.competing_models import expensive_structures
from cluster_est.closed_loop.findings.effects import ErrorChange, NoiseChange, Verdict
from cluster_est.closed_loop.findings.result import LoopResult
from cluster_est.closed_loop.findings.verdict import CLAIMS, ReasonedVerdict
from cluster_est.closed_loop.fitter import FitStart, FittedModel, Fitter
from cluster_est.closed_loop.last_fits import LastAnswer, LastFits, final_fit, last_models
from cluster_est.closed_loop.search import SearchedModel, search_for_effects
from cluster_est.closed_loop.selection.gates import SELECTION
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, open_workbench
from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.problem.display import in_percent, in_sentences
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names, noise_parameters, without_noise
from cluster_est.results.output_errors import output_residuals
from cluster_est.results.result import Result
from cluster_est.toml import dotted
from workers.messages import Role

MOST_PASSES = 4
NOT_LOOKED_FOR = (
    "with process noise, the search does not look for outliers, noise that grows with the signal, "
    "effects at outputs, delays, backlash or rate limits"
)
NOT_AGAIN = (
    "{} would replace a part of the process noise, but the search finds nothing under the "
    "process noise that remains"
)


def close_loop_under_noise(request: LoopRequest, begin: float) -> LoopResult:
    """Search for effects that a model with process noise lacks; `begin` is the run's start time.

    Raises
    ------
    ClusterEstError
        As `close_loop`.
    """
    check_noise_parameters(request.problem)
    with open_workbench(request) as workbench:
        workbench.fitter.enter("the process noise")
        held = hold_noise(workbench.fitter, request.problem, FitStart(request.problem, {}), {})
        spent = [SpentSimulations.at(workbench.fitter)]
    passed: list[frozenset[str]] = []
    while True:
        used = sum(each.evaluations for each in spent)
        left = request.environment.left(used, time.monotonic() - begin)
        with open_workbench(replace(request, problem=held.problem, environment=left)) as workbench:
            fitter = workbench.fitter
            searched = search_for_effects(workbench, held, request.environment.resources)
            structure = searched.found.current.structure
            passed.append(structure)
            if not structure or structure in passed[:-1] or len(passed) == MOST_PASSES:
                fitter.enter("before and after")
                fits = last_fits_with_noise(fitter, request.problem, searched.found, begin)
                judged = _judged(fitter.size, searched, fits, passed)
                result = account(fitter, LastAnswer(searched.found, judged, fits), workbench.scope)
                result = _with_noise(fitter, result, searched, fits, passed)
                return replace(with_all(result, spent), seconds=time.monotonic() - begin)
            fitter.enter("the remaining process noise")
            start = released(searched.found.current.start, request.problem)
            held = hold_noise(fitter, request.problem, start, held.values)
            spent.append(SpentSimulations.at(fitter))


@dataclass(frozen=True)
class SpentSimulations:
    """Numbers of simulations of a fitter, as in `LoopResult`."""

    simulations: float
    simulated: int
    evaluations: int
    failures: int

    @classmethod
    def at(cls, fitter: Fitter) -> Self:
        runner = fitter.runner
        return cls(fitter.meter.full, runner.simulations, runner.evaluations, runner.failures)


def with_all(result: LoopResult, spent: Sequence[SpentSimulations]) -> LoopResult:
    """Add the simulations of the earlier passes to the numbers in a result."""
    names = [each.name for each in fields(SpentSimulations)]
    before = {name: sum(getattr(each, name) for each in spent) for name in names}
    return replace(result, **{name: getattr(result, name) + before[name] for name in names})


def _judged(
    size: int, searched: SearchedModel, fits: LastFits, passed: list[frozenset[str]]
) -> ReasonedVerdict:
    """Return the verdict after both models were fitted with their own noise."""
    found, judged = searched.ends[0]
    if judged.verdict in CLAIMS:
        against = why_not_likely(size, found, fits)
        if against:
            why = f"the best candidate was not accepted: {against}"
            return replace(judged, verdict=Verdict.NONE, reason=why)
    elif len(passed) > 1 and not found.current.added:
        return ReasonedVerdict(Verdict.NONE, NOT_AGAIN.format(" and ".join(sorted(passed[-2]))))
    return judged


def _with_noise(
    fitter: Fitter,
    result: LoopResult,
    searched: SearchedModel,
    fits: LastFits,
    passed: list[frozenset[str]],
) -> LoopResult:
    """Add sentences on the process noise and on the passes to a result."""
    kept = bool(result.effects)
    said = [noise_sentence(each, kept=kept) for each in fits.noise]
    free = simulation_sentence(fitter, result.before, result.after) if kept else ""
    notes = (*searched.error.notes, *result.notes, free, NOT_LOOKED_FOR, _unsettled(passed))
    return replace(
        result,
        message=in_sentences([result.message, *said]),
        notes=(*filter(None, notes), *expensive_structures(searched.found.path)),
        failures_in_search=searched.failures,
    )


def _unsettled(passed: list[frozenset[str]]) -> str:
    """Say that the passes did not converge; "" if they did."""
    if not passed[-1] or passed[-1] in passed[:-1]:
        return ""
    return (
        f"after {len(passed)} passes, the search still found effects other than those of the "
        "previous pass, so the names of the effects are uncertain"
    )


def noise_sentence(change: NoiseChange, *, kept: bool) -> str:
    """Say how strong the process noise is; if effects were kept, also how strong it was before."""
    unit = f" {change.unit}" if change.unit not in ("", "1") else ""
    kind = "standard deviation" if change.coloured else "strength"
    lasting = f", correlation time {change.time_before:.3g} s" if change.coloured else ""
    if not kept:
        return f"process noise {change.name}: {kind} {change.before:.3g}{unit}{lasting}"
    if change.coloured:
        lasting = (
            f"; the correlation time was {change.time_before:.3g} s before and is "
            f"{change.time_after:.3g} s with the effects"
        )
    left = change.variance_left
    return (
        f"process noise {change.name}: {kind} {change.before:.3g}{unit} before and "
        f"{change.after:.3g}{unit} with the effects, which is {in_percent(left)} of the variance"
        f"{lasting}"
    )


WITH_NOISE = LeastSquares(trials=2, max_iterations=40, ftol=1e-8, xtol=1e-8)


def check_noise_parameters(problem: Problem) -> None:
    """Refuse noise parameters with an expression, or with several values.

    Raises
    ------
    ProblemError
        If there is such a parameter.
    """
    for parameter in noise_parameters(problem):
        for key, given in (("per", parameter.per), ("expression", parameter.expression)):
            if given:
                raise ProblemError(
                    f"close-loop: {dotted('parameters', parameter.name)}.{key}: is {given!r}, but "
                    "the search fixes process noise at one number; remove it"
                )


def released(start: FitStart, declared: Problem) -> FitStart:
    """Return a model whose noise parameters are free again; they start at their fixed values."""
    own = {p.name: p for p in noise_parameters(declared)}
    held = {p.name: p.start for p in start.problem.parameters if p.name in own}
    parameters = tuple(
        replace(own[p.name], start=p.start) if p.name in own else p
        for p in start.problem.parameters
    )
    problem = replace(start.problem, parameters=parameters)
    return FitStart(problem, {**held, **start.values}, start.added)


def hold_noise(
    fitter: Fitter, declared: Problem, start: FitStart, known: Mapping[str, float]
) -> FitStart:
    """Fit a model together with its noise, and fix the noise of the declared model at this fit.

    Parameters
    ----------
    declared
        The user's problem.
    start
        The model to fit, with free noise parameters.
    known
        Start values of the declared unknowns. Unknowns without one start at the fit's values.

    Returns
    -------
    FitStart
        The declared model with fixed noise; each experiment has the `log_spread` of the fit.

    Raises
    ------
    ProblemError
        If the model cannot be simulated.
    """
    (fitted,) = fitter.fit(LoopStage.PROCESS_NOISE, [start], WITH_NOISE)
    if fitted is None:
        raise ProblemError(
            "close-loop: the model with process noise cannot be simulated from its start values; "
            "run cluster-est check, or change the start values"
        )
    estimates = fitted.estimates
    spreads = _log_spreads(fitter, fitted)
    own = {p.name for p in noise_parameters(declared)}
    parameters = tuple(
        replace(p, start=float(estimates.get(p.name, p.start)), fixed=True) if p.name in own else p
        for p in declared.parameters
    )
    experiments = tuple(
        replace(each, log_spread=spread)
        for each, spread in zip(declared.experiments, spreads, strict=True)
    )
    problem = replace(declared, parameters=parameters, experiments=experiments)
    added = {p.name for p in fitted.problem.parameters} - {p.name for p in declared.parameters}
    values = {k: v for k, v in estimates.items() if k not in own and k not in added}
    return FitStart(problem, {**values, **known})


def _log_spreads(fitter: Fitter, fitted: FittedModel) -> list[float]:
    """Return the `log_spread` of each experiment; 0 if the experiment cannot be simulated."""
    everything = tuple(range(len(fitted.problem.experiments)))
    known, stage = fitted.estimates, LoopStage.PROCESS_NOISE.value
    outcomes = fitter.simulate(fitted.problem, everything, known, "linearisation", stage)
    found = [outcome.linearisation for outcome in outcomes]
    return [0.0 if linear is None else linear.log_spread for linear in found]


def last_fits_with_noise(
    fitter: Fitter, declared: Problem, found: SelectionResult, begin: float
) -> LastFits:
    """Fit both models, each with its own noise, and compare their errors.

    Errors in the output's unit are prediction errors; each model's filter uses the model's own
    noise. Normalised errors are innovations over their standard deviations. For both models, they
    use the noise that remains with the effects; this noise alone would give 1.
    """
    held, free = [], []
    for start in (model.start for model in last_models(found)):
        held.append(final_fit(fitter, start, begin))
        free.append(final_fit(fitter, released(start, declared), begin))
    before, after = free[0], free[-1]
    errors = _error_changes((before, after), (held[0], held[-1]))
    return LastFits(before, after, errors, _noise_changes(before, after))


def why_not_likely(size: int, found: SelectionResult, fits: LastFits) -> str:
    """Return a reason against the effects if both models have their own noise; "" if there is none.

    -2 log likelihood must fall by more than the penalty for the added unknowns (Schwarz criterion)
    plus the penalty for the choice among the candidates. For held-out experiments, it must not
    grow. The likelihood includes the decrease of the noise. The noise strength itself is not
    tested, because it is known less accurately.
    """
    unknowns = len(fits.after.solution.x) - len(fits.before.solution.x)
    count = found.steps[0].screening.count
    price = SELECTION.choice_price * len(found.current.added) * np.log(count)
    needed = unknowns * np.log(size) + price
    fall = _deviance(fits.before, "train") - _deviance(fits.after, "train")
    if not fall > needed:
        return (
            f"if the noise is estimated too, -2 log likelihood falls by {fall:.1f}, but a choice "
            f"among {count} candidates needs a fall of {needed:.1f}"
        )
    worse = _deviance(fits.after, "test") - _deviance(fits.before, "test")
    if worse > 0.0:
        return f"-2 log likelihood of the held-out experiments would grow by {worse:.1f}"
    return ""


def simulation_sentence(fitter: Fitter, before: Result, after: Result) -> str:
    """Give the error of simulations that no filter corrects; "" if it is not known."""
    roles: tuple[tuple[Role, str], ...] = (("train", "training"), ("test", "held-out"))
    said = []
    for role, name in roles:
        old, new = (_simulation_error(fitter, each, role) for each in (before, after))
        if np.isfinite(old) and np.isfinite(new):
            said.append(f"from {old:.3g} to {new:.3g} times sigma on {name} data")
    if not said:
        return ""
    return (
        "in simulations from start to end without process noise, the root mean square error goes "
        + " and ".join(said)
    )


def _simulation_error(fitter: Fitter, result: Result, role: Role) -> float:
    """Return the root mean square error over sigma of simulations without process noise.

    NaN if there are no simulations, or if one failed.
    """
    known = {e.label: e.value for e in result.estimates}
    problem = without_noise(result.problem)
    chosen = problem.indices(role)
    if not chosen:
        return np.nan
    outcomes = fitter.simulate(problem, chosen, known, "trajectory", "free")
    parts = [
        output_residuals(output, outcome)
        for e, outcome in zip(chosen, outcomes, strict=True)
        for output in problem.experiments[e].outputs
    ]
    seen = [part for part in parts if part is not None]
    if len(seen) < len(parts) or not seen:
        return np.nan
    return float(np.sqrt(np.mean(np.concatenate(seen) ** 2)))


def _deviance(result: Result, role: Role) -> float:
    """Return -2 log likelihood, up to a constant, of the experiments with a role."""
    chosen = set(result.problem.indices(role))
    parts = [s.outcome.residuals for s in result.simulations if s.experiment in chosen]
    return float(sum(np.inf if part is None else part @ part for part in parts))


def _noise_changes(before: Result, after: Result) -> tuple[NoiseChange, ...]:
    """Return the strength and correlation time of each noise, before and after."""
    names = set(noise_names(before.problem))
    units = {e.label: e.unit for e in before.estimates}
    old, new = ({e.label: e.value for e in each.estimates} for each in (before, after))
    found = []
    for effect in before.problem.effects:
        if effect.name not in names:
            continue
        q, tau = f"{effect.name}.q", f"{effect.name}.tau"
        coloured = tau in old
        sizes = [float(v[q] * (np.sqrt(0.5 * v[tau]) if coloured else 1.0)) for v in (old, new)]
        times = [float(v.get(tau, np.nan)) for v in (old, new)]
        unit = units[q].removesuffix(" s^-0.5").removesuffix("/s^0.5") if coloured else units[q]
        found.append(NoiseChange(effect.name, effect.site, unit, *sizes, *times))
    return tuple(found)


def _error_changes(
    free: tuple[Result, Result], held: tuple[Result, Result]
) -> tuple[ErrorChange, ...]:
    """Return prediction errors of `free` in units, and normalised innovations of `held`."""
    sizes = [dict(_innovation_sizes(result)) for result in held]
    changes = []
    for old, new in zip(free[0].errors, free[1].errors, strict=True):
        key = old.experiment, old.output
        normalised = sizes[0].get(key, np.nan), sizes[1].get(key, np.nan)
        changes.append(ErrorChange.between(old, new, normalised))
    return tuple(changes)


def _innovation_sizes(result: Result) -> Iterator[tuple[tuple[str, str], float]]:
    """Yield the root mean square of the residuals for each experiment and output."""
    for simulation in result.simulations:
        run = result.problem.experiments[simulation.experiment]
        residuals = simulation.outcome.residuals
        if residuals is None:
            continue
        parts = np.split(residuals, np.cumsum(run.counts)[:-1])
        for output, part in zip(run.outputs, parts, strict=True):
            if len(part):
                yield (run.id, output.variable), float(np.sqrt(np.mean(part**2)))
