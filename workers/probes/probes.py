"""Probes of `cluster-est check`, each run with the FMU in a separate process."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from workers.core import failure
from workers.errors import ModelError
from workers.evaluate import Evaluator, FmuProbe
from workers.fmu.instance import FmuInstance
from workers.fmu.process_environment import resident_bytes
from workers.messages import Experiment, FloatArray, Model, Outcome, ResetPolicy, Solver, Task
from workers.simulation.batch import SimulationBatch
from workers.simulation.jacobian import (
    StateJacobian,
    compare_with_differences,
    directional_jacobian,
)
from workers.simulation.simulator import Simulator
from workers.wire import TaskBatch

WARM_UP_SIMULATIONS = 10
"""Number of simulations after which the memory of a process no longer grows without a leak."""
BATCH_SIZE = 5
"""Number of simulations in one timed call."""


def difference(found: FloatArray, truth: FloatArray) -> float:
    """Return the largest relative difference of two tables of outputs; see `differences`."""
    return float(differences(found, truth).max(initial=0.0))


def differences(found: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the largest difference of each output of two tables, over its largest value.

    For an output that is always 0, the divisor is 1, the default nominal value.
    """
    if found.tobytes() == truth.tobytes():
        return np.zeros(truth.shape[1])
    with np.errstate(all="ignore"):
        sizes = np.abs(truth).max(axis=0)
        sizes[sizes == 0.0] = 1.0
        far: FloatArray = np.abs(found - truth).max(axis=0, initial=0.0) / sizes
        return far


@dataclass(frozen=True)
class SimulationProbe(FmuProbe):
    """Returns the outcome of one task."""

    task: Task

    def answer(self, evaluator: Evaluator) -> Outcome:
        found = evaluator.evaluate(TaskBatch.of([self.task]))[0]
        if not self.task.effects or not found.ok:
            return found
        # repeated to measure the time without the import of SymPy
        simulator = _simulator_with_reset(evaluator, self.task.experiment, "instance")
        begin = time.perf_counter()
        batch = simulator.run(0, self.task.values[None], self.task.effects)
        done = batch.codes[0] == failure.FINISHED
        return replace(found, seconds=time.perf_counter() - begin) if done else found


@dataclass(frozen=True)
class RepetitionResult:
    """One simulation, started in several ways, with the distances from the first outputs.

    Attributes
    ----------
    first : (times, outputs)
        In a new process and a new instance.
    reset, instance
        Distance after a reset, and in a new instance of the same process. 0 means the same bits;
        None means that it failed or was not tried. The latter is tried only if the former is not 0.
    """

    first: FloatArray = field(repr=False)
    reset: float | None
    instance: float | None


@dataclass(frozen=True)
class RepeatProbe(FmuProbe):
    """Tests whether a simulation is repeatable within a process.

    `policies` are the reset policies to try; a reset may crash.
    """

    experiment: int
    point: FloatArray
    policies: tuple[ResetPolicy, ...] = ("reset", "instance")

    def answer(self, evaluator: Evaluator) -> RepetitionResult:
        model, experiment = evaluator.model, evaluator.experiments[self.experiment]
        fresh = _simulator_of(evaluator, replace(model, reset="instance"), experiment)
        reset = _simulator_of(evaluator, replace(model, reset="reset"), experiment)
        first = _outputs(fresh.run(0, self.point[None]))
        after = _distance(reset, self.point, first) if "reset" in self.policies else None
        if after == 0.0 or "instance" not in self.policies:
            return RepetitionResult(first, after, after)
        return RepetitionResult(first, after, _distance(fresh, self.point, first))


@dataclass(frozen=True)
class StopTimeProbe(FmuProbe):
    """Tests whether the FMU can be initialised without a stop time, and with one."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> tuple[bool, bool]:
        """Return whether it can be initialised without a stop time, and with one."""
        model, experiment = evaluator.model, evaluator.experiments[self.experiment]
        without, told = (
            _simulator_of(evaluator, replace(model, reset="instance", stop_time=t), experiment)
            for t in (False, True)
        )
        return without.starts(0, self.point), told.starts(0, self.point)


@dataclass(frozen=True)
class LeftoverProbe(FmuProbe):
    """Measures how much values that were set before a reset change the outputs after it.

    The result is the change of a simulation with the FMU's own values after one with other values.
    """

    experiment: int
    other: FloatArray

    def answer(self, evaluator: Evaluator) -> float:
        bare = replace(evaluator.experiments[self.experiment], values=())
        nothing = np.empty((1, 0))

        def simulator(reset: ResetPolicy) -> Simulator:
            model = replace(evaluator.model, reset=reset, parameters=())
            return _simulator_of(evaluator, model, bare)

        before = _outputs(simulator("instance").run(0, nothing))
        evaluator.simulator.run(self.experiment, self.other[None])
        return difference(_outputs(simulator("reset").run(0, nothing)), before)


@dataclass(frozen=True)
class SimulationCost:
    """The time and memory that simulations take.

    Attributes
    ----------
    seconds
        Median time of a simulation.
    leak
        Bytes leaked by each simulation; None if there were too few simulations.
    count
        Number of simulations.
    """

    seconds: float
    leak: float | None
    count: int


@dataclass(frozen=True)
class CostProbe(FmuProbe):
    """Measures the cost of simulations, within a time limit and a maximum number."""

    experiment: int
    point: FloatArray
    reset: ResetPolicy
    seconds: float
    max_count: int = 300

    def answer(self, evaluator: Evaluator) -> SimulationCost:
        end = time.monotonic() + self.seconds
        points = np.repeat(self.point[None], BATCH_SIZE, axis=0)
        simulator = _simulator_with_reset(evaluator, self.experiment, self.reset)
        durations: list[float] = []
        memory: list[tuple[int, int]] = []
        while len(durations) * BATCH_SIZE < self.max_count and (
            len(durations) < 2 or time.monotonic() < end
        ):
            begin = time.perf_counter()
            _outputs(simulator.run(0, points))
            durations.append((time.perf_counter() - begin) / BATCH_SIZE)
            memory.append((len(durations) * BATCH_SIZE, resident_bytes("self")))
        warm = [each for each in memory if each[0] >= WARM_UP_SIMULATIONS]
        leak = None
        if len(warm) > 1:
            (first, before), (last, after) = warm[0], warm[-1]
            leak = max(after - before, 0) / (last - first)
        return SimulationCost(float(np.median(durations)), leak, len(durations) * BATCH_SIZE)


@dataclass(frozen=True)
class InstanceProbe(FmuProbe):
    """Returns the possible number of instances, up to `max_count`, and the error of the next."""

    max_count: int = 3

    def answer(self, evaluator: Evaluator) -> tuple[int, str]:
        instances: list[FmuInstance] = []
        for count in range(1, self.max_count):
            try:
                instances.append(FmuInstance(evaluator.model, evaluator.description))
            except ModelError as error:
                return count, str(error)
        return self.max_count, ""


@dataclass(frozen=True)
class MovementProbe(FmuProbe):
    """Measures the distance of the outputs at several points from those at the first point.

    Attributes
    ----------
    experiment, point
        The experiment and the first point.
    others : (n, values)
        The other points.
    seconds
        Time limit, after which the remaining points are omitted.
    """

    experiment: int
    point: FloatArray
    reset: ResetPolicy
    others: FloatArray = field(repr=False)
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[float | str]:
        """Return the distance of each point, or the error message of its simulation."""
        end = time.monotonic() + self.seconds
        simulator = _simulator_with_reset(evaluator, self.experiment, self.reset)
        base = _outputs(simulator.run(0, self.point[None]))
        found: list[float | str] = []
        for other in self.others:
            if time.monotonic() > end:
                break
            batch = simulator.run(0, other[None])
            failed = batch.codes[0] != failure.FINISHED
            found.append(batch.messages[0] if failed else difference(batch.outputs[0], base))
        return found


@dataclass(frozen=True)
class SolverProbe(FmuProbe):
    """Measures how much other solver settings change each output."""

    experiment: int
    point: FloatArray
    reset: ResetPolicy
    solver: Solver

    def answer(self, evaluator: Evaluator) -> FloatArray:
        model = replace(evaluator.model, solver=self.solver, reset=self.reset)
        other = _simulator_of(evaluator, model, evaluator.experiments[self.experiment])
        usual = _simulator_with_reset(evaluator, self.experiment, self.reset)
        base = _outputs(usual.run(0, self.point[None]))
        return differences(base, _outputs(other.run(0, self.point[None])))


@dataclass(frozen=True)
class StiffnessProbe(FmuProbe):
    """Tests whether the model is stiff."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> bool:
        return evaluator.simulator.is_stiff(self.experiment, self.point)


def _simulator_with_reset(evaluator: Evaluator, experiment: int, reset: ResetPolicy) -> Simulator:
    """Return a simulator of the same model and experiment with another reset policy."""
    model = replace(evaluator.model, reset=reset)
    return _simulator_of(evaluator, model, evaluator.experiments[experiment])


def _simulator_of(evaluator: Evaluator, model: Model, experiment: Experiment) -> Simulator:
    """Return a simulator of another model or experiment with the same instance."""
    simulator = Simulator(model, evaluator.description, (experiment,))
    simulator.load(evaluator.simulator.instance)
    return simulator


def _outputs(batch: SimulationBatch) -> FloatArray:
    """Return the outputs of the first simulation.

    Raises
    ------
    ModelError
        If the simulation failed.
    """
    if batch.codes[0] != failure.FINISHED:
        raise ModelError(batch.messages[0])
    outputs: FloatArray = batch.outputs[0]
    return outputs


def _distance(simulator: Simulator, point: FloatArray, first: FloatArray) -> float | None:
    try:
        return difference(_outputs(simulator.run(0, point[None])), first)
    except ModelError:
        return None


REPEATS = 2
"""Number of repetitions, of which the fastest counts; the first includes preparations."""


@dataclass(frozen=True)
class SensitivityCost:
    """Seconds of a simulation.

    Attributes
    ----------
    plain, carrying
        Without and with derivatives by all parameters.
    """

    plain: float
    carrying: float


@dataclass(frozen=True)
class SensitivityCostProbe(FmuProbe):
    """Measures the time with and without sensitivities; None if they are not available."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> SensitivityCost | None:
        simulator, points = evaluator.simulator, self.point[None]
        plain, carrying = [], []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            simulator.run(self.experiment, points)
            middle = time.perf_counter()
            found = simulator.sensitivities(self.experiment, points)
            plain.append(middle - begin)
            carrying.append(time.perf_counter() - middle)
            if not found.sensitivities:
                return None
        return SensitivityCost(min(plain), min(carrying))


@dataclass(frozen=True)
class DirectionalProbe(FmuProbe):
    """Checks directional derivatives at the end of a simulation, in model exchange."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> StateJacobian:
        simulator, description = evaluator.simulator, evaluator.description
        record = simulator.run(self.experiment, self.point[None])
        if record.codes[0] != failure.FINISHED:
            raise ModelError(record.messages[0])
        jacobian = directional_jacobian(description)
        if len(jacobian.states) < len(description.states):
            raise ModelError("the FMU does not say which variables are its state derivatives")
        return compare_with_differences(simulator.instance.fmu, description.version, jacobian)
