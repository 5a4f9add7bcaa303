"""Before and after a search with process noise: likelihood, noise, innovations and simulations."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cluster_est.closed_loop.account import LastFits, final_fit
from cluster_est.closed_loop.findings.effects import ErrorChange, NoiseChange
from cluster_est.closed_loop.process_noise.held import released
from cluster_est.closed_loop.selection.rounds import SelectionResult
from cluster_est.closed_loop.workbench import LoopWorkbench
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names, without_noise
from cluster_est.problem.search_space import make_space
from cluster_est.results.output_errors import output_residuals
from cluster_est.results.result import Result
from workers.messages import Role


def last_fits_with_noise(
    workbench: LoopWorkbench, declared: Problem, found: SelectionResult, begin: float
) -> LastFits:
    """Fit both models with noise of their own, and compare their innovations under one noise.

    Errors in the output's unit are those of predictions, each by a filter with its model's own
    noise. Normalised ones are innovations over their standard deviations, those of both models
    under the noise that is left with the effects: 1 is what that noise explains.

    Parameters
    ----------
    workbench
        With the noise that the search was done under.
    declared
        As the user has given it.
    found
        By the search.
    begin
        As for `complete`.
    """
    held = [final_fit(workbench, found.base.start, begin)]
    free = [final_fit(workbench, released(found.base.start, declared), begin)]
    if found.current.added:
        held.append(final_fit(workbench, found.current.start, begin))
        free.append(final_fit(workbench, released(found.current.start, declared), begin))
    return LastFits(
        before=free[0],
        after=free[-1],
        errors=_error_changes((free[0], free[-1]), (held[0], held[-1])),
        unchanged=_error_changes((free[0], free[0]), (held[0], held[0])),
        noise=_noise_changes(free[0], free[-1]),
    )


def why_not_likely(workbench: LoopWorkbench, found: SelectionResult, fits: LastFits) -> str:
    """Say what speaks against the effects once both models have noise of their own; "" if nothing.

    The fall of -2 log likelihood must pay for the unknowns, as in the criterion of G. Schwarz, and
    for the choice among the candidates, and held-out experiments must be as likely as before. That
    the noise is smaller then is in the likelihood: its strength by itself is known less well.
    """
    unknowns = len(fits.after.solution.x) - len(fits.before.solution.x)
    count = found.steps[0].screening.count
    price = workbench.thresholds.selection.choice_price * len(found.current.added) * np.log(count)
    needed = unknowns * np.log(workbench.size) + price
    fall = _deviance(fits.before, "train") - _deviance(fits.after, "train")
    if not fall > needed:
        return (
            f"-2 log likelihood falls by {fall:.1f} with noise that is estimated along, and must "
            f"by {needed:.1f} for a choice among {count} candidates"
        )
    worse = _deviance(fits.after, "test") - _deviance(fits.before, "test")
    if worse > 0.0:
        return f"-2 log likelihood of the held-out experiments would grow by {worse:.1f}"
    return ""


def simulation_sentence(workbench: LoopWorkbench, before: Result, after: Result) -> str:
    """Say how far simulations that go their own way are from what was measured; "" if unknown."""
    roles: tuple[tuple[Role, str], ...] = (("train", "training"), ("test", "held-out"))
    said = []
    for role, name in roles:
        old, new = (_simulation_error(workbench, each, role) for each in (before, after))
        if np.isfinite(old) and np.isfinite(new):
            said.append(f"from {old:.3g} to {new:.3g} times sigma on {name} data")
    if not said:
        return ""
    return (
        "simulated from start to end without process noise, the root mean square error goes "
        + " and ".join(said)
    )


def _simulation_error(workbench: LoopWorkbench, result: Result, role: Role) -> float:
    """Root mean square over sigma of simulations without noise; NaN if there are none."""
    known = {e.label: e.value for e in result.estimates}
    problem = without_noise(result.problem)
    chosen = problem.indices(role)
    if not chosen:
        return np.nan
    space = make_space(problem, chosen, known)
    values = space.physical(space.start)
    outcomes = workbench.runner.simulate(values, chosen, "trajectory", "free", problem.effects)
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
    """-2 log likelihood up to a constant, of the experiments of a role."""
    chosen = set(result.problem.indices(role))
    parts = [s.outcome.residuals for s in result.simulations if s.experiment in chosen]
    return float(sum(np.inf if part is None else part @ part for part in parts))


def _noise_changes(before: Result, after: Result) -> tuple[NoiseChange, ...]:
    """Strength and time of each noise, before and after."""
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
    """Errors of predictions in units, and innovations over what the noise explains."""
    sizes = [dict(_innovation_sizes(result)) for result in held]
    changes = []
    for old, new in zip(free[0].errors, free[1].errors, strict=True):
        key = old.experiment, old.output
        normalised = sizes[0].get(key, np.nan), sizes[1].get(key, np.nan)
        changes.append(ErrorChange.between(old, new, normalised))
    return tuple(changes)


def _innovation_sizes(result: Result) -> Iterator[tuple[tuple[str, str], float]]:
    """Root mean square of the residuals of each output of each experiment."""
    for simulation in result.simulations:
        run = result.problem.experiments[simulation.experiment]
        residuals = simulation.outcome.residuals
        if residuals is None:
            continue
        parts = np.split(residuals, np.cumsum(run.counts)[:-1])
        for output, part in zip(run.outputs, parts, strict=True):
            if len(part):
                yield (run.id, output.variable), float(np.sqrt(np.mean(part**2)))
