"""Runs the tests of the records if the residual of a fit is more than noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cluster_est.errors import BudgetError, ClusterEstError
from cluster_est.methods.method import Solution
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names
from cluster_est.problem.search_space import SearchSpace
from cluster_est.results.observation import lack_normal_law
from cluster_est.results.output_errors import Simulation
from cluster_est.results.record_faults.all_records import clock_of_all_records, unit_of_all_records
from cluster_est.results.record_faults.fault import RecordFault
from cluster_est.results.record_faults.fitted_records import AT_NOISE, FittedRecords
from cluster_est.results.record_faults.foreign_source import foreign_source
from cluster_est.results.record_faults.odd_record import FEWEST_RECORDS, odd_record
from cluster_est.results.residual_diagnostics import training_residuals
from cluster_est.running.resources import Resources
from cluster_est.running.runner import Runner


@dataclass(frozen=True)
class RecordTest:
    """A test of the records: its name, and what it finds."""

    name: str
    find: Callable[[FittedRecords], Sequence[RecordFault]]


MOST_ENTRIES = 20_000_000
"""Largest number of entries of a Jacobian for these tests."""
TESTS: tuple[RecordTest, ...] = (
    RecordTest("foreign source", foreign_source),
    RecordTest("odd record", odd_record),
    RecordTest("unit of all records", unit_of_all_records),
    RecordTest("clock of all records", clock_of_all_records),
)
"""The tests in their order; the first one needs no simulations. The first finding is used."""


def record_faults(fitted: FittedRecords) -> tuple[RecordFault, ...]:
    """Search for faults of records; () if the residual is not more than noise."""
    if not _can_be_tested(fitted.problem, fitted.train) or not fitted.space.size:
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
        except ClusterEstError:  # then only this hint is missing
            continue
        if found:
            return tuple(with_column(fitted, each) for each in found)
    return ()


def with_column(fitted: FittedRecords, fault: RecordFault) -> RecordFault:
    """Add the name of the table's column, if it is known."""
    if fault.sort == "times":
        times = {table.time for table in fitted.problem.tables}
        (column,) = times if len(times) == 1 else (None,)
    else:
        column = fitted.problem.columns.get(f"{fault.sort}.{fault.variables[0]}")
    return replace(fault, column=column or fault.column)


def faults_of_fit(
    space: SearchSpace,
    solution: Solution,
    simulations: Sequence[Simulation],
    resources: Resources,
    runner: Runner,
) -> tuple[RecordFault, ...]:
    """Search for faults of records at the estimates of a fit.

    Parameters
    ----------
    space, solution
        Search space and solution of the training experiments, with a Jacobian.
    simulations
        Simulations of all experiments at the estimates, with trajectories.
    resources, runner
        Resources and runner of the fit; its workers must still be running.
    """
    if not _can_be_tested(space.problem, space.experiments):
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


def too_few_records(problem: Problem) -> tuple[str, ...]:
    """Return a note if there are too few training experiments to find a faulty one.

    It is meant for a fit that leaves clearly more than noise.
    """
    train = [i for i, each in enumerate(problem.experiments) if each.role == "train"]
    if len(train) >= FEWEST_RECORDS or not _can_be_tested(problem, train):
        return ()
    known = {problem.experiments[i].record_id for i in train}
    others = [e.id for e in problem.experiments if e.role == "test" and e.record_id not in known]
    missing = FEWEST_RECORDS - len(train)
    steps = [f'set role = "train" for {" and ".join(others[:missing])}'] if others else []
    steps += ["measure more experiments"] if len(others) < missing else []
    return (
        f"with fewer than {FEWEST_RECORDS} training experiments, a fault of one record, such as a "
        "late or scaled column, cannot be distinguished from a missing effect, so no such fault "
        f"was looked for; to look for one, {' and '.join(steps)}",
    )


def _can_be_tested(problem: Problem, train: Sequence[int]) -> bool:
    """Return whether all residuals are plain differences of outputs over sigma."""
    outputs = [o for e in train for o in problem.experiments[e].outputs]
    compared = any(o.free_scale or o.free_offset for o in outputs)
    priors = any(p.prior is not None for p in problem.parameters)
    plain = problem.plain and isinstance(problem.cost, SumSquared) and not noise_names(problem)
    gaps = any(problem.experiments[e].own_starts for e in train)
    return plain and not (compared or priors or gaps or lack_normal_law(problem, train))
