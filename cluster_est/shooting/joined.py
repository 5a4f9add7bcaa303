"""From segments back to whole records: simulations, residuals and the Jacobian of the fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_est.methods.base import Solution
from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.problem.search_space.space import SearchSpace
from cluster_est.results.output_errors import Simulation
from cluster_est.running.evaluation import assemble_evaluation, with_priors
from cluster_est.running.runner import Runner
from cluster_est.shooting.segment_solution import SegmentSolution, response
from cluster_est.shooting.segments import SegmentedProblem
from cluster_est.uncertainty.covariance.jacobian import jacobian_blocks
from workers.messages import FloatArray, Outcome, Trajectory


def joined_simulations(
    runner: Runner, segmented: SegmentedProblem, found: SegmentSolution
) -> list[Simulation]:
    """Simulate the segments once more, and join those of each record.

    Where a segment failed, so has its record.
    """
    everything = tuple(range(len(segmented.segments)))
    values = found.space.physical(found.solution.x)
    outcomes = runner.simulate(
        values, everything, "trajectory", "segments", segmented.problem.effects
    )
    records = segmented.original.indices("train")
    return [Simulation(r, _joined(segmented, r, outcomes)) for r in records]


def _joined(segmented: SegmentedProblem, record: int, outcomes: list[Outcome]) -> Outcome:
    rows = segmented.of_record(record)
    failed = [outcomes[row] for row in rows if not outcomes[row].ok]
    if failed:
        return replace(failed[0], trajectory=None, residuals=None)
    experiment = segmented.original.experiments[record]
    residuals = np.zeros(experiment.size)
    times, values = [], []
    names = experiment.recorded
    for row in rows:
        segment, outcome = segmented.segments[row], outcomes[row]
        path = outcome.trajectory
        assert path is not None
        assert outcome.residuals is not None
        own = segment.places >= 0
        residuals[segment.places[own]] = outcome.residuals[own]
        kept = slice(None) if segment.is_last else path.times < segment.experiment.stop
        times.append(path.times[kept])
        columns = [path.variables.index(name) for name in names]
        values.append(path.values[:, columns][kept])
    first = outcomes[rows[0]]
    return replace(
        first,
        residuals=residuals,
        trajectory=Trajectory(names, np.concatenate(times), np.concatenate(values)),
        steps=sum(outcomes[row].steps for row in rows),
        seconds=sum(outcomes[row].seconds for row in rows),
    )


def joined_solution(
    segmented: SegmentedProblem,
    train: SearchSpace,
    found: SegmentSolution,
    simulations: list[Simulation],
) -> Solution:
    """Return the solution on segments as one of the fit.

    Its Jacobian has the derivatives by the fit's unknowns while the states of all segments follow:
    they are eliminated from the Jacobian of the segments, which stays accurate where the
    sensitivities of a whole simulation would grow beyond all bounds.
    """
    solution = found.solution
    x = solution.x[: train.size]
    outcomes = tuple(
        with_priors(train, x, e, replace(each.outcome, trajectory=None))
        for e, each in enumerate(simulations)
    )
    at = assemble_evaluation(train, x, outcomes, -1)
    steps, frozen = solution.difference_steps, solution.frozen
    blocks = jacobian_blocks(found.space, solution)
    return replace(
        solution,
        x=x,
        cost=at.cost,
        at=at,
        jacobian=None if blocks is None else _reduced(segmented, train, blocks),
        block_jacobian=None,
        difference_steps=None if steps is None else steps[: train.size],
        frozen=None if frozen is None else frozen[: train.size],
    )


def _reduced(segmented: SegmentedProblem, train: SearchSpace, blocks: BlockMatrix) -> FloatArray:
    """(residuals of the fit, unknowns of the fit)."""
    moved = response(blocks, train.size)
    result = np.zeros((train.rows[-1].stop, train.size))
    position = {record: i for i, record in enumerate(train.experiments)}
    for row, segment in enumerate(segmented.segments):
        own = blocks.blocks[row] @ moved[blocks.columns[row]]
        rows = train.rows[position[segment.record]]
        measured = segment.places >= 0
        result[rows.start + segment.places[measured]] = own[: len(segment.places)][measured]
        priors = own[len(segment.places) :]
        result[rows.stop - len(priors) : rows.stop] += priors if len(priors) else 0.0
    return result
