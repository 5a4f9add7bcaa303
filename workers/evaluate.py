"""Evaluators, which answer tasks with outcomes; a failed simulation raises no exception.

Probes use an evaluator to find out other properties of an FMU for `cluster-est check`.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from workers.core import failure
from workers.core.library import core
from workers.fmu.description import describe_model
from workers.fmu.seats import has_lost
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
from workers.residuals.comparison import SimulatedOutputs
from workers.residuals.experiment_residuals import (
    BatchComparison,
    ExperimentComparison,
    reduce_residuals,
)
from workers.simulation.batch import SimulationBatch
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.simulator import Simulator
from workers.wire import TaskBatch

MAX_VALUES = 4_000_000
"""Largest number of simulated values kept at once (32 MB), however long the experiments are."""

TOO_LARGE = 1e100
"""Limit of the size of a residual or constraint: its square and the derivative of the square must
not overflow."""


class Evaluator:
    """A loaded FMU and its experiments, with which one worker answers tasks.

    Parameters
    ----------
    model, experiments
        Model and experiments of the tasks.
    name
        Name of this worker in outcomes.
    load
        Whether to load the FMU now. Otherwise everything else is prepared, and `load` is called
        later in forked processes, each of which loads the FMU itself.
    progress
        Array in which simulations record their progress; see `workers.messages.types`.

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
            ExperimentComparison(e, self._simulator.bound_experiment(i).grid, model.parameters)
            for i, e in enumerate(experiments)
        ]
        self._name = name
        core()  # so that its compilation does not count as simulation time
        if load:
            self.load()

    @property
    def simulator(self) -> Simulator:
        """The simulator."""
        return self._simulator

    def load(self) -> None:
        """Load the FMU.

        Raises
        ------
        ModelError
            If the FMU cannot be loaded on this machine.
        """
        self._simulator.load()

    def evaluate(self, batch: TaskBatch) -> list[Outcome]:
        """Answer every task of a batch, in the same order."""
        process = os.getpid()
        answers: dict[int, Outcome] = {}
        positions: dict[tuple[int, int], list[int]] = {}
        pairs = zip(batch.experiments.tolist(), batch.step_limits.tolist(), strict=True)
        for position, pair in enumerate(pairs):
            positions.setdefault(pair, []).append(position)
        for (experiment, _), chosen in sorted(positions.items()):
            for part in self._parts(experiment, chosen):
                outcomes = self._simulate(experiment, part, batch)
                if os.getpid() != process:  # the FMU has forked; the copy must not answer
                    os._exit(1)
                answers.update(zip(part, outcomes, strict=True))
        return [answers[i] for i in range(len(batch.ids))]

    def free_instance(self) -> None:
        """Free the instance; the next simulation creates a new one."""
        self._simulator.instance.free()

    @property
    def has_lost_seat(self) -> bool:
        """Whether a fatal error has used up an instance of a limited number."""
        return has_lost(self.model.seats)

    def close(self) -> None:
        """Free the FMU."""
        self._simulator.close()

    def _parts(self, experiment: int, chosen: list[int]) -> list[list[int]]:
        """Divide a batch so that the outputs of each part fit into memory."""
        bound = self._simulator.bound_experiment(experiment)
        size = max(1, len(bound.grid.times) * len(bound.outputs))
        most = max(1, MAX_VALUES // size)
        return [chosen[first : first + most] for first in range(0, len(chosen), most)]

    def _simulate(self, experiment: int, part: list[int], batch: TaskBatch) -> list[Outcome]:
        ids, values = batch.ids[part], batch.values[part]
        bound = self._simulator.bound_experiment(experiment)
        start = time.perf_counter()
        simulations = {
            "linearisation": self._simulator.linearise,
            "sensitivities": self._simulator.sensitivities,
        }
        if batch.want in simulations:
            result = simulations[batch.want](experiment, values, batch.effects)
        else:
            bounded = self._comparisons[experiment].is_plain and batch.want != "trajectory"
            bounds = batch.bounds[part] if bounded else None
            limit = int(batch.step_limits[part[0]])
            result = self._simulator.run(experiment, values, batch.effects, bounds, limit)
        simulated = SimulatedOutputs(bound.grid.times, bound.outputs, result.outputs, values)
        comparison = self._comparisons[experiment].compare(simulated)
        if result.innovations:
            comparison = comparison._replace(residuals=_as_innovations(comparison, result))
        seconds = (time.perf_counter() - start) / len(ids)
        evaluation = _BatchEvaluation(bound, result, comparison, batch.want, seconds, self._name)
        outcomes = [evaluation.outcome(task, p) for p, task in enumerate(ids.tolist())]
        if batch.want == "sensitivities":
            return [
                self._with_sensitivities(experiment, simulated, result, p, outcome)
                for p, outcome in enumerate(outcomes)
            ]
        if batch.want not in REDUCTIONS:
            return outcomes
        return [_reduced(self._experiments[experiment], o, batch.want) for o in outcomes]

    def _with_sensitivities(
        self,
        experiment: int,
        simulated: SimulatedOutputs,
        result: SimulationBatch,
        p: int,
        outcome: Outcome,
    ) -> Outcome:
        """Add derivatives by the parameters to an outcome, or the reason why there are none."""
        if not outcome.ok:
            return outcome
        if p not in result.sensitivities:
            return replace(outcome, message=result.messages[p])
        one = slice(p, p + 1)
        alone = replace(simulated, outputs=simulated.outputs[one], values=simulated.values[one])
        jacobian = self._comparisons[experiment].jacobian(alone, result.sensitivities[p])
        return replace(outcome, sensitivities=jacobian)


@dataclass(frozen=True)
class _BatchEvaluation:
    """A batch of simulations of one experiment, with residuals and constraints.

    `seconds` is the time of each simulation, `worker` the name of the worker.
    """

    bound: BoundExperiment
    result: SimulationBatch
    comparison: BatchComparison
    want: Want
    seconds: float
    worker: str

    def outcome(self, task: int, p: int) -> Outcome:
        """Return the outcome of one point."""
        failed = self._failure(p)
        if failed is not None:
            status, message = failed
            return Outcome(task, status, message=message, seconds=self.seconds, worker=self.worker)
        trajectory = None
        if self.want == "trajectory":
            trajectory = Trajectory(
                self.bound.outputs, self.bound.grid.times, self.result.outputs[p]
            )
        return Outcome(
            task,
            Status.OK,
            self.comparison.residuals[p],
            trajectory,
            seconds=self.seconds,
            worker=self.worker,
            linearisation=self.result.linearisations.get(p),
            constraints=self.comparison.constraints[p],
            steps=int(self.result.steps[p]),
        )

    @cached_property
    def _sound(self) -> list[bool]:
        """Whether the simulation of each point has finished, with numbers below `TOO_LARGE`."""
        finished = self.result.codes == failure.FINISHED
        sound: list[bool] = (finished & self._countable).tolist()
        return sound

    @cached_property
    def _countable(self) -> npt.NDArray[np.bool_]:
        """Whether all residuals and constraints of each point are numbers below `TOO_LARGE`."""
        residuals, constraints = self.comparison.residuals, self.comparison.constraints
        countable = (np.abs(residuals) < TOO_LARGE).all(axis=1)
        if constraints.shape[1]:
            countable &= (np.abs(constraints) < TOO_LARGE).all(axis=1)
        return np.asarray(countable)

    def _failure(self, p: int) -> tuple[Status, str] | None:
        """Return the status and message of a failed point, None for others."""
        result, comparison = self.result, self.comparison
        if self._sound[p] and not comparison.failures and not result.linearisations:
            return None
        if result.codes[p] == failure.ENDED_EARLY:
            return Status.ENDED_EARLY, result.messages[p]
        if result.codes[p] != failure.FINISHED:
            return Status.SOLVER_FAILURE, result.messages[p]
        if p in comparison.failures:
            message = comparison.failures[p] or _where_not_finite(self.bound, result.outputs[p])
            return Status.NOT_FINITE, message
        if not self._countable[p]:
            return Status.NOT_FINITE, _where_not_finite(self.bound, result.outputs[p])
        not_linear = _where_not_linear(result.linearisations.get(p))
        return None if not_linear is None else (Status.NOT_FINITE, not_linear)


def _as_innovations(comparison: BatchComparison, result: SimulationBatch) -> FloatArray:
    """Return the residuals; at points with innovations, the innovations replace them."""
    residuals = comparison.residuals.copy()
    for p, innovations in result.innovations.items():
        residuals[p] = innovations
    return residuals


def _reduced(experiment: Experiment, outcome: Outcome, want: Want) -> Outcome:
    if outcome.residuals is None:
        return outcome
    return replace(outcome, residuals=reduce_residuals(outcome.residuals, experiment.counts, want))


def _where_not_finite(bound: BoundExperiment, outputs: FloatArray) -> str:
    if np.isfinite(outputs).all():
        return (
            "the outputs are finite, but so large that the residuals or constraints computed from "
            "them overflow"
        )
    row, column = np.argwhere(~np.isfinite(outputs))[0]
    return (
        f"output {bound.outputs[column]!r} is {outputs[row, column]} from t = "
        f"{bound.grid.times[row]:.9g} s on"
    )


def _where_not_linear(found: Linearisation | None) -> str | None:
    """Return a message if a derivative is not finite, else None."""
    if found is None:
        return None
    derivatives = tuple(f"der({name})" for name in found.state_names)
    named = [
        (found.B, derivatives, found.input_names),
        (found.P, derivatives, found.parameter_names),
        (found.C, found.output_names, found.state_names),
        (found.D, found.output_names, found.input_names),
        (found.Q, found.output_names, found.parameter_names),
    ]
    if not np.isfinite(found.A.values).all():
        named.insert(0, (np.asarray(found.A), derivatives, found.state_names))
    for matrix, rows, names in named:
        if not np.isfinite(matrix).all():
            at, row, column = np.argwhere(~np.isfinite(matrix))[0]
            return (
                f"the derivative of {rows[row]!r} with respect to {names[column]!r} is "
                f"{matrix[at, row, column]} at t = {found.times[at]:.9g} s"
            )
    return None


class FmuProbe(ABC):
    """A question about an FMU that a simulation does not answer, for `cluster-est check`."""

    @abstractmethod
    def answer(self, evaluator: Evaluator) -> Any:
        """Compute the answer with a newly loaded FMU. The answer is sent to the calling process.

        Raises
        ------
        ModelError
            If there is no answer; the exception is sent to the calling process too.
        """
