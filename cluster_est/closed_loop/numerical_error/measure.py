"""Measurement of the numerical error of a fitted model: the same experiments, simulated finer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.closed_loop.numerical_error.error import (
    LEAST_ORDER,
    NumericalError,
    extrapolated,
    observed_order,
)
from cluster_est.closed_loop.workbench import FittedModel, LoopWorkbench
from cluster_est.errors import ClusterEstError
from cluster_est.results.solver_error.finer_solver import (
    SolverScale,
    solver_scale,
    step_never_taken,
)
from cluster_est.results.solver_error.measure import simulate_with_solver
from cluster_est.running.resources import Resources
from workers.messages import FloatArray, Solver


class _NoSolutionError(Exception):
    """A finer solver could not simulate an experiment; its text says why."""


def measure_numerical_error(
    workbench: LoopWorkbench, fitted: FittedModel, noise: FloatArray, resources: Resources
) -> NumericalError:
    """Simulate the training experiments again with a finer solver, where a fit stands.

    A step is halved, and where that changes the outputs by more than a small part of the noise,
    halved again: the order of the error shows in the second change, and the error of the whole step
    follows by extrapolation (L. F. Richardson, Phil. Trans. R. Soc. A 210 (1911) 307-357,
    doi:10.1098/rsta.1911.0009); of first order it is twice the first change. A tolerance is divided
    by 100, and the longest step halved: what changes is the error itself, but for a few hundredths
    (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, section II.4,
    doi:10.1007/978-3-540-78862-1).

    The simulations run one after the other in one process of their own, whatever the executor, and
    are not logged: a log is of one solver.

    Parameters
    ----------
    fitted
        The model, at the point where its error counts.
    noise : (outputs,)
        In units of the residuals.
    resources
        For the limits of a simulation, and of instances.
    """
    runs = [workbench.problem.experiments[e] for e in workbench.train]
    model, description = workbench.problem.model, workbench.description
    scale = solver_scale(model, description, runs)
    never = step_never_taken(model, description, runs)
    unknown = NumericalError(
        scale,
        workbench.records.outputs,
        why_not=scale.why_not,
        beside=(never,) if never else (),
        thresholds=workbench.thresholds.numerical_error,
    )
    if scale.why_not:
        return unknown
    try:
        error, order = _error(workbench, fitted, noise, scale, resources)
    except (_NoSolutionError, ClusterEstError) as why:
        return replace(unknown, why_not=f"a finer one fails ({why})")
    return replace(
        unknown,
        rms=_rms(workbench, error),
        noise=noise,
        residual=_rms(workbench, fitted.residuals),
        squares=float(np.add.reduce(error**2)),
        order=order,
    )


def error_with_effects(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    declared: NumericalError,
    noise: FloatArray,
    resources: Resources,
) -> NumericalError:
    """Measure the numerical error of a model with effects, where a step decides it.

    A step that is short enough for the declared model may miss the kinks of an effect: between two
    communication points an input that has been changed counts as a straight line.

    Parameters
    ----------
    fitted
        The model with the effects.
    declared
        The error of the declared model.
    noise, resources
        See `measure_numerical_error`.

    Returns
    -------
    NumericalError
        That of the declared model where nothing was added, where a tolerance keeps the error small,
        or where no larger one can be measured.
    """
    if not fitted.added or not declared.scale.step:
        return declared
    found = measure_numerical_error(workbench, fitted, noise, resources)
    return declared if found.why_not or found.squares <= declared.squares else found


def _error(
    workbench: LoopWorkbench,
    fitted: FittedModel,
    noise: FloatArray,
    scale: SolverScale,
    resources: Resources,
) -> tuple[FloatArray, float]:
    """The numerical error of each residual, and the order of the step."""
    once = _residuals(workbench, fitted, scale.finer(), resources)
    first = fitted.residuals - once
    if not scale.step:
        return first, np.nan
    error = extrapolated(first, scale.ratio, LEAST_ORDER)
    small = workbench.thresholds.numerical_error.small
    noticed = np.any(_rms(workbench, error) > small * noise)
    if not noticed or not scale.can_be_finer_twice():
        return error, LEAST_ORDER
    second = once - _residuals(workbench, fitted, scale.finer(2), resources)
    if scale.fixed and float(np.add.reduce(second**2)) >= float(np.add.reduce(first**2)):
        raise _NoSolutionError("the outputs change the more, the shorter its fixed step is made")
    order = observed_order(first, second, scale.ratio)
    return extrapolated(first, scale.ratio, order), order


def _residuals(
    workbench: LoopWorkbench, fitted: FittedModel, solver: Solver, resources: Resources
) -> FloatArray:
    """The residuals of the training experiments with another solver."""
    runs = tuple(workbench.problem.experiments[e] for e in workbench.train)
    values = fitted.space.physical(fitted.x)
    outcomes = simulate_with_solver(
        fitted.problem, runs, values, solver, "residuals", resources, beside=workbench.runner
    )
    workbench.meter.full += len(runs)
    for run, outcome in zip(runs, outcomes, strict=True):
        if not outcome.ok or outcome.residuals is None:
            raise _NoSolutionError(f"experiment {run.id!r}: {outcome.status}, {outcome.message}")
    return np.concatenate([o.residuals for o in outcomes if o.residuals is not None])


def _rms(workbench: LoopWorkbench, stacked: FloatArray) -> FloatArray:
    """Root mean square of each output, over all training experiments."""
    records = workbench.records
    parts = [stacked[records.of_output(o)] for o in range(len(records.outputs))]
    return np.array([float(np.sqrt(np.mean(part**2))) if len(part) else 0.0 for part in parts])
