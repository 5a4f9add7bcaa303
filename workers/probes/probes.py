"""Probes of `cluster-est check`, each run beside the FMU in a process of its own."""

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
"""Simulations after which a process has all the memory that it will need, if it does not leak."""
BATCH_SIZE = 5
"""Simulations in one call, of which the cost is taken."""


def difference(found: FloatArray, truth: FloatArray) -> float:
    """Return the largest difference of two tables of outputs, each over the size of its output."""
    return float(differences(found, truth).max(initial=0.0))


def differences(found: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the largest difference of each output of two tables, over its size.

    That of an output which stays at 0 is 1, the nominal value of a variable that declares none.
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
    """Asks for the outcome of one task."""

    task: Task

    def answer(self, evaluator: Evaluator) -> Outcome:
        found = evaluator.evaluate(TaskBatch.of([self.task]))[0]
        if not self.task.effects or not found.ok:
            return found
        # once more, for the time that it takes without importing SymPy
        simulator = _simulator_with_reset(evaluator, self.task.experiment, "instance")
        begin = time.perf_counter()
        batch = simulator.run(0, self.task.values[None], self.task.effects)
        done = batch.codes[0] == failure.FINISHED
        return replace(found, seconds=time.perf_counter() - begin) if done else found


@dataclass(frozen=True)
class RepetitionResult:
    """One simulation, begun in several ways: how far the outputs are from those of the first.

    Attributes
    ----------
    first : (times, outputs)
        In a process and an instance that nothing had been simulated with.
    reset, instance
        After a reset, and in a new instance of the same process; 0 for the same bits, None where
        it could not be simulated, or was not asked for. The latter is only tried where the first is
        not 0.
    """

    first: FloatArray = field(repr=False)
    reset: float | None
    instance: float | None


@dataclass(frozen=True)
class RepeatProbe(FmuProbe):
    """Asks whether a simulation can be repeated in a process.

    `policies` are those that are tried: a reset may crash.
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
    """Asks whether the FMU can be initialised without a stop time, and with one."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> tuple[bool, bool]:
        """Whether it can without, and with one."""
        model, experiment = evaluator.model, evaluator.experiments[self.experiment]
        without, told = (
            _simulator_of(evaluator, replace(model, reset="instance", stop_time=t), experiment)
            for t in (False, True)
        )
        return without.starts(0, self.point), told.starts(0, self.point)


@dataclass(frozen=True)
class LeftoverProbe(FmuProbe):
    """Asks how far values that were set survive a reset, in the outputs.

    That is how far a simulation with the FMU's own values comes from what it was, once others were
    simulated.
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
        Of one, the median.
    leak
        Bytes that each leaves behind; None if there were too few to say.
    count
        How many were simulated.
    """

    seconds: float
    leak: float | None
    count: int


@dataclass(frozen=True)
class CostProbe(FmuProbe):
    """Asks for the cost of many simulations, within about some seconds and a number of them."""

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
    """Asks for the number of instances at once, up to `max_count`, and the message of the next."""

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
    """Asks how far each of some points comes from the first one, in the outputs.

    Attributes
    ----------
    experiment, point
        Where it begins.
    others : (n, values)
        What is compared with it.
    seconds
        After which the rest is left out.
    """

    experiment: int
    point: FloatArray
    reset: ResetPolicy
    others: FloatArray = field(repr=False)
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[float | str]:
        """For each point a distance, or what went wrong there."""
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
    """Asks how far another solver, or other settings of it, take each output from the model's."""

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
    """Asks whether the model is stiff."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> bool:
        return evaluator.simulator.is_stiff(self.experiment, self.point)


def _simulator_with_reset(evaluator: Evaluator, experiment: int, reset: ResetPolicy) -> Simulator:
    """Return a simulator of the same with another reset policy."""
    model = replace(evaluator.model, reset=reset)
    return _simulator_of(evaluator, model, evaluator.experiments[experiment])


def _simulator_of(evaluator: Evaluator, model: Model, experiment: Experiment) -> Simulator:
    """Return a simulator of another model or experiment, on the same instance."""
    simulator = Simulator(model, evaluator.description, (experiment,))
    simulator.load(evaluator.simulator.instance)
    return simulator


def _outputs(batch: SimulationBatch) -> FloatArray:
    """Return the outputs of the first simulation.

    Raises
    ------
    ModelError
        If it failed.
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
"""The quicker of so many counts: the first has something to prepare."""


@dataclass(frozen=True)
class SensitivityCost:
    """Seconds of a simulation.

    Attributes
    ----------
    plain, carrying
        Without and with the derivatives by all parameters.
    """

    plain: float
    carrying: float


@dataclass(frozen=True)
class SensitivityCostProbe(FmuProbe):
    """Times both ways at one point of an experiment; no answer without sensitivities."""

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
    """Asks for them at the end of a simulation, in model exchange."""

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
