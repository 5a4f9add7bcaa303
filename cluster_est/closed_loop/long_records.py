"""Long records in a closed loop: what is looked for on thinned ones is confirmed on all rows."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.fitter import Fitter, with_outputs
from cluster_est.closed_loop.outliers import outliers_of_long_records, without
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.closed_loop.workbench import LoopRequest, open_workbench
from cluster_est.errors import ClusterEstError
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import make_space
from cluster_est.problem.thinning import FINENESS, ThinnedProblem, thinned
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import Resources, TaskOrigin
from workers.messages import FloatArray, Outcome, Output

FAINT = 0.3
"""Times the noise of a thinned row by which the model may differ there, as a root mean square."""

MANY = (LoopStage.TRIALS, LoopStage.REFITS, LoopStage.PROBE, LoopStage.SWAP, LoopStage.DROP)
"""Stages of most simulations."""

CONFIRMED_ON_ALL = "estimates, errors and what they say of the effects are those of all rows"


def thinned_records(request: LoopRequest, most: int | None) -> ThinnedProblem:
    """Thin the long records of a loop, as coarsely as the model allows.

    The declared model is simulated at its start on all rows and on the thinned ones: what the
    filter and the inputs of fewer samples change must be far below the noise that is left in a row.
    Where no way of thinning does that, records stay as they are.

    Returns
    -------
    ThinnedProblem
        `whole` of it has no outliers any more.
    """
    whole = request.problem
    first = thinned(whole, most, FINENESS[0])
    if most is None or not first.is_thinner:
        return first
    outliers = outliers_of_long_records(whole, most)
    whole = without(whole, outliers) if outliers else whole
    resources = request.environment.resources
    full: list[list[FloatArray]] | None = None
    for fineness in FINENESS:
        coarsest = fineness is FINENESS[0] and not outliers
        found = first if coarsest else thinned(whole, most, fineness)
        if not found.is_thinner:
            break
        full = full or _simulated(whole, resources)
        if full is None or _difference(found, whole, full, resources) <= FAINT:
            said = [each.sentence for each in outliers]
            return replace(found, whole=whole, sentence="; ".join([found.sentence, *said]))
    return thinned(request.problem, None)


def _simulated(problem: Problem, resources: Resources) -> list[list[FloatArray]] | None:
    """The outputs of the training experiments at the start; None where they cannot be simulated."""
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


def _difference(
    thin: ThinnedProblem, whole: Problem, full: list[list[FloatArray]], resources: Resources
) -> float:
    """Largest difference of an output on thinned rows from the same on all, over their noise."""
    simulated = _simulated(thin.problem, resources)
    if simulated is None:
        return np.inf
    squares: dict[str, list[FloatArray]] = {}
    for e, all_rows, rows in zip(whole.indices("train"), full, simulated, strict=True):
        outputs = thin.problem.experiments[e].outputs
        for output, matrix, one, other in zip(outputs, thin.rows[e], all_rows, rows, strict=True):
            if matrix is not None:
                unit = output.sigmas * (1.0 if output.has_sigma else thin.noise[output.variable])
                off = (matrix @ one - other) / unit
                squares.setdefault(output.variable, []).append(off**2)
    means = [float(np.mean(np.concatenate(parts))) for parts in squares.values()]
    return float(np.sqrt(max(means, default=0.0)))


def with_slim_log(
    environment: RunEnvironment, stages: Collection[LoopStage] | None = None
) -> RunEnvironment:
    """Return an environment whose log keeps no residuals of some stages; None for all.

    A run that is resumed simulates these again, which takes less than all else that it does.
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
    """Open a fitter with all rows, weighted as those of a search on thinned records.

    Its few simulations would be most of a log.
    """
    weights = {
        (e, o.variable): o
        for e, experiment in enumerate(searching.problem.experiments)
        for o in experiment.outputs
    }

    def change(e: int, output: Output) -> Output:
        own = weights[e, output.variable]
        return replace(output, sigma=own.sigma, relative_sigma=own.relative_sigma)

    request = replace(
        request,
        problem=with_outputs(thin.whole, change),
        environment=with_slim_log(request.environment),
        sigma_declared=searching.sigma_declared,
    )
    with open_workbench(request) as whole:
        yield whole.fitter


@contextmanager
def reopened(request: LoopRequest, fitter: Fitter) -> Iterator[Fitter]:
    """Open a fitter of before once more: there are workers of one at a time."""
    with open_workbench(replace(request, problem=fitter.problem)) as again:
        yield replace(fitter, runner=again.fitter.runner, meter=again.fitter.meter)
