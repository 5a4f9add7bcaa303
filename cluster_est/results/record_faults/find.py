"""Tests of the records, by name, at a fit that leaves more than noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.errors import BudgetError, ClusterEstError
from cluster_est.methods.method import Solution
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.observation import lack_normal_law
from cluster_est.results.output_errors import Simulation
from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.record_faults.fitted_records import AT_NOISE, FittedRecords
from cluster_est.results.record_faults.foreign_source import foreign_source
from cluster_est.results.record_faults.odd_record import odd_record
from cluster_est.results.residual_diagnostics import training_residuals
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner


@dataclass(frozen=True)
class RecordTest:
    """A test of the records: its name, and what it finds."""

    name: str
    find: Callable[[FittedRecords], Sequence[RecordFault]]


MOST_ENTRIES = 20_000_000
"""Entries of a Jacobian that records are compared by."""
TESTS: tuple[RecordTest, ...] = (
    RecordTest("foreign source", foreign_source),
    RecordTest("odd record", odd_record),
)
"""In this order, the one without simulations first; the first that finds something is believed."""


def record_faults(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Look for faults of records where a fit leaves more than noise; nothing is done otherwise."""
    if not _can_be_tested(fitted.space) or not fitted.space.size:
        return ()
    if len(fitted.residuals) != fitted.records.size:
        return ()
    noise = fitted.noise_here
    if np.all(fitted.levels(fitted.residuals, fitted.runs, noise) <= AT_NOISE):
        return ()
    for test in TESTS:
        try:
            found = tuple(test.find(fitted))
        except BudgetError:
            raise
        except ClusterEstError:  # a hint is missing then, and nothing else
            continue
        if found:
            return tuple(_with_column(fitted, each) for each in found)
    return ()


def _with_column(fitted: FittedRecords, fault: RecordFault) -> RecordFault:
    """Name the column of the table, where it is known."""
    key = f"{fault.sort}.{fault.variables[0]}"
    column = fitted.problem.columns.get(key, fault.column)
    return replace(fault, column=column)


def faults_of_fit(
    space: SearchSpace,
    solution: Solution,
    simulations: Sequence[Simulation],
    resources: Resources,
    runner: Runner,
) -> tuple[RecordFault, ...]:
    """Look for faults of records where a fit ended.

    Parameters
    ----------
    space, solution
        Of the training experiments, with a Jacobian.
    simulations
        Of every experiment of the problem at the estimates, with trajectories.
    resources, runner
        Of the fit, whose workers still stand ready.
    """
    if not _can_be_tested(space):
        return ()
    residuals = training_residuals(space, simulations)
    if residuals is None:
        return ()
    jacobian = solution.jacobian
    if jacobian is None or jacobian.shape[0] != len(residuals) or jacobian.size > MOST_ENTRIES:
        return ()
    return record_faults(
        FittedRecords(space.problem, space, solution.x, residuals, jacobian, runner, resources)
    )


def _can_be_tested(space: SearchSpace) -> bool:
    """Whether residuals are plain distances of outputs over their noise."""
    problem = space.problem
    outputs = [o for e in space.experiments for o in problem.experiments[e].outputs]
    compared = any(o.free_scale or o.free_offset for o in outputs)
    priors = any(p.prior is not None for p in problem.parameters)
    plain = problem.plain and isinstance(problem.cost, SumSquared) and not noise_names(problem)
    gaps = any(problem.experiments[e].own_starts for e in space.experiments)
    return plain and not (compared or priors or gaps or lack_normal_law(problem, space.experiments))
