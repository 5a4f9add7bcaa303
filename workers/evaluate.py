"""Tasks in, outcomes out. A failed simulation is an outcome like any other; nothing raises."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from workers.fmu.description import describe_model
from workers.kernels.fmi import failure
from workers.messages import (
    REDUCTIONS,
    Experiment,
    FloatArray,
    IntArray,
    Linearisation,
    Model,
    Outcome,
    Status,
    Trajectory,
    Want,
)
from workers.residuals.base import SimulatedBatch
from workers.residuals.experiment import BatchComparison, ExperimentComparison
from workers.residuals.reduce import reduce_residuals
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.integrator import SimulationBatch
from workers.simulation.simulator import Simulator
from workers.wire import TaskBatch

MAX_VALUES = 4_000_000
"""Simulated values that are kept at once: 32 MB, however long the experiments are."""

TOO_LARGE = 1e100
"""Of a residual or constraint: with its square, or its derivative, a method could not count."""


class Evaluator:
    """Everything that one worker needs to answer tasks: a loaded FMU and its experiments.

    Parameters
    ----------
    model, experiments
        What tasks refer to.
    name
        What outcomes call this worker.
    load
        Whether the FMU is loaded. If not, all else is made ready, and `load` follows later: in
        processes that are forked from this one, each of which loads it for itself.
    progress
        Counters that simulations advance; see `workers.kernels.fmi.progress`.

    Raises
    ------
    ModelError
        If the FMU cannot be loaded on this machine or lacks a variable.
    """

    def __init__(
        self,
        model: Model,
        experiments: Sequence[Experiment],
        name: str,
        *,
        load: bool = True,
        progress: IntArray | None = None,
    ) -> None:
        description = describe_model(model)
        self.model, self.description = model, description
        self._simulator = Simulator(model, description, tuple(experiments), progress)
        self.experiments = self._experiments = tuple(experiments)
        self._comparisons = [
            ExperimentComparison(e, self._simulator.installed(i).grid, model.parameters)
            for i, e in enumerate(experiments)
        ]
        self._name = name
        self._simulator.warm_up()  # also so that no simulation seems to take as long as compiling
        if load:
            self.load()

    @property
    def simulator(self) -> Simulator:
        """What it simulates with, once it is loaded."""
        return self._simulator

    def load(self) -> None:
        """Load the FMU.

        Raises
        ------
        ModelError
            If that does not work on this machine.
        """
        self._simulator.load()

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Answer every task of a batch, in its order."""
        answers: dict[int, Outcome] = {}
        for experiment in np.unique(batch.experiments):
            chosen = np.flatnonzero(batch.experiments == experiment)
            for part in self._parts(int(experiment), chosen):
                ids, values = batch.ids[part], batch.values[part]
                outcomes = self._simulate(int(experiment), ids, values, batch)
                answers.update(zip(part.tolist(), outcomes, strict=True))
        return [answers[i] for i in range(len(batch.ids))]

    def close(self) -> None:
        """Free the FMU."""
        self._simulator.close()

    def _parts(self, experiment: int, chosen: IntArray) -> list[IntArray]:
        """Cut a batch so that its outputs fit into memory."""
        ready = self._simulator.installed(experiment)
        size = max(1, len(ready.grid.times) * len(ready.outputs))
        most = max(1, MAX_VALUES // size)
        return [chosen[first : first + most] for first in range(0, len(chosen), most)]

    def _simulate(
        self, experiment: int, ids: IntArray, values: FloatArray, batch: TaskBatch
    ) -> list[Outcome]:
        ready = self._simulator.installed(experiment)
        begin = time.perf_counter()
        ways = {
            "linearisation": self._simulator.linearise,
            "sensitivities": self._simulator.sensitivities,
        }
        record = ways.get(batch.want, self._simulator.run)(experiment, values, batch.effects)
        simulated = SimulatedBatch(ready.grid.times, ready.outputs, record.outputs, values)
        judged = self._comparisons[experiment].judge(simulated)
        seconds = (time.perf_counter() - begin) / len(ids)
        outcomes = [
            self._outcome(task, ready, record, p, judged, batch.want, seconds)
            for p, task in enumerate(ids.tolist())
        ]
        if batch.want == "sensitivities":
            return [
                self._with_slopes(experiment, simulated, record, p, outcome)
                for p, outcome in enumerate(outcomes)
            ]
        if batch.want not in REDUCTIONS:
            return outcomes
        return [_reduced(self._experiments[experiment], o, batch.want) for o in outcomes]

    def _with_slopes(
        self,
        experiment: int,
        simulated: SimulatedBatch,
        record: SimulationBatch,
        p: int,
        outcome: Outcome,
    ) -> Outcome:
        """The same with derivatives by the parameters, or why it has none."""
        if not outcome.ok:
            return outcome
        if p not in record.slopes:
            return replace(outcome, message=record.messages[p])
        one = slice(p, p + 1)
        alone = replace(simulated, record=simulated.record[one], values=simulated.values[one])
        slopes = self._comparisons[experiment].slopes(alone, record.slopes[p])
        return replace(outcome, sensitivities=slopes)

    def _outcome(
        self,
        task: int,
        ready: BoundExperiment,
        record: SimulationBatch,
        p: int,
        judged: BatchComparison,
        want: Want,
        seconds: float,
    ) -> Outcome:
        found = np.concatenate([judged.residuals[p], judged.constraints[p]])
        finite = (np.abs(found) < TOO_LARGE).all()  # no number is not less
        if record.codes[p] != failure.FINISHED:
            status, message = Status.SOLVER_FAILURE, record.messages[p]
        elif p in judged.failures:
            reason = judged.failures[p] or _where_not_finite(ready, record.outputs[p])
            status, message = Status.NOT_FINITE, reason
        elif not finite:
            status, message = Status.NOT_FINITE, _where_not_finite(ready, record.outputs[p])
        elif (said := _where_not_linear(record.linearisations.get(p))) is not None:
            status, message = Status.NOT_FINITE, said
        else:
            wanted = want == "trajectory"
            trajectory = (
                Trajectory(ready.outputs, ready.grid.times, record.outputs[p]) if wanted else None
            )
            return Outcome(
                task,
                Status.OK,
                judged.residuals[p],
                trajectory,
                seconds=seconds,
                worker=self._name,
                linearisation=record.linearisations.get(p),
                constraints=judged.constraints[p],
            )
        return Outcome(task, status, message=message, seconds=seconds, worker=self._name)


def _reduced(experiment: Experiment, outcome: Outcome, want: Want) -> Outcome:
    if outcome.residuals is None:
        return outcome
    return replace(outcome, residuals=reduce_residuals(outcome.residuals, experiment.counts, want))


def _where_not_finite(ready: BoundExperiment, outputs: FloatArray) -> str:
    if np.isfinite(outputs).all():
        return "the outputs are finite but too large for their residuals or constraints"
    row, column = np.argwhere(~np.isfinite(outputs))[0]
    return (
        f"output {ready.outputs[column]!r} is {outputs[row, column]} from "
        f"t = {ready.grid.times[row]:.9g} s on"
    )


def _where_not_linear(found: Linearisation | None) -> str | None:
    """A sentence if a derivative is not finite."""
    if found is None:
        return None
    slopes, outputs = tuple(f"der({name})" for name in found.state_names), found.output_names
    named = [
        (found.A, slopes, found.state_names),
        (found.B, slopes, found.input_names),
        (found.P, slopes, found.parameter_names),
        (found.C, outputs, found.state_names),
        (found.D, outputs, found.input_names),
        (found.Q, outputs, found.parameter_names),
    ]
    for matrix, rows, names in named:
        if not np.isfinite(matrix).all():
            at, row, column = np.argwhere(~np.isfinite(matrix))[0]
            return (
                f"the derivative of {rows[row]!r} by {names[column]!r} is "
                f"{matrix[at, row, column]} at t = {found.times[at]:.9g} s"
            )
    return None
