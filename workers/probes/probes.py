"""What `cluster-est check` asks of an FMU, beside it in a process of its own."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.fmu.instance import FmuInstance
from workers.kernels.fmi import failure
from workers.messages import Experiment, FloatArray, Model, Outcome, Renewal, Solver, Task
from workers.probes.base import FmuProbe
from workers.probes.memory import resident_bytes
from workers.simulation.integrator import SimulationBatch
from workers.simulation.simulator import Simulator
from workers.wire import TaskBatch

WARM = 10
"""Simulations after which a process has all the memory that it will need, if it does not leak."""
AT_ONCE = 5
"""Simulations in one call, of which the cost is taken."""


def difference(found: FloatArray, truth: FloatArray) -> float:
    """The largest difference of two tables of outputs, each over the size of its output."""
    if found.tobytes() == truth.tobytes():
        return 0.0
    with np.errstate(all="ignore"):
        sizes = np.maximum(np.abs(truth).max(axis=0), np.finfo(np.float64).tiny)
        return float((np.abs(found - truth).max(axis=0) / sizes).max(initial=0.0))


@dataclass(frozen=True)
class SimulationProbe(FmuProbe):
    """Asks for the outcome of one task."""

    task: Task

    def answer(self, evaluator: Evaluator) -> Outcome:
        found = evaluator.evaluate(TaskBatch.of([self.task]))[0]
        if not self.task.effects or not found.ok:
            return found
        return evaluator.evaluate(TaskBatch.of([self.task]))[0]  # without importing SymPy


@dataclass(frozen=True)
class RepetitionResult:
    """One simulation, begun in several ways: how far the outputs are from those of the first.

    Attributes
    ----------
    first : (times, outputs)
        In a process and an instance that nothing had been simulated with.
    reset, instance
        After a reset, and in a new instance of the same process; 0 for the same bits, None where
        it could not be simulated. The latter is only tried where the first is not 0.
    """

    first: FloatArray = field(repr=False)
    reset: float | None
    instance: float | None


@dataclass(frozen=True)
class RepeatProbe(FmuProbe):
    """Asks whether a simulation can be repeated in a process."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> RepetitionResult:
        model, experiment = evaluator.model, evaluator.experiments[self.experiment]
        fresh = _twin(evaluator, replace(model, renew="instance"), experiment)
        reset = _twin(evaluator, replace(model, renew="reset"), experiment)
        first = _outputs(fresh.run(0, self.point[None]))
        after = _distance(reset, self.point, first)
        again = after if after == 0.0 else _distance(fresh, self.point, first)
        return RepetitionResult(first, after, again)


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

        def simulator(renew: Renewal) -> Simulator:
            model = replace(evaluator.model, renew=renew, parameters=())
            return _twin(evaluator, model, bare)

        before = _outputs(simulator("instance").run(0, nothing))
        evaluator.simulator.run(self.experiment, self.other[None])
        return difference(_outputs(simulator("reset").run(0, nothing)), before)


@dataclass(frozen=True)
class SimulationCost:
    """What simulations take.

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
    """Asks what many simulations take, for about some seconds and at most so many of them."""

    experiment: int
    point: FloatArray
    renew: Renewal
    seconds: float
    most: int = 300

    def answer(self, evaluator: Evaluator) -> SimulationCost:
        end = time.monotonic() + self.seconds
        points = np.repeat(self.point[None], AT_ONCE, axis=0)
        simulator = _renewing(evaluator, self.experiment, self.renew)
        took: list[float] = []
        grown: list[tuple[int, int]] = []
        while len(took) * AT_ONCE < self.most and (len(took) < 2 or time.monotonic() < end):
            begin = time.perf_counter()
            _outputs(simulator.run(0, points))
            took.append((time.perf_counter() - begin) / AT_ONCE)
            grown.append((len(took) * AT_ONCE, resident_bytes("self")))
        warm = [each for each in grown if each[0] >= WARM]
        leak = None
        if len(warm) > 1:
            (first, before), (last, after) = warm[0], warm[-1]
            leak = max(after - before, 0) / (last - first)
        return SimulationCost(float(np.median(took)), leak, len(took) * AT_ONCE)


@dataclass(frozen=True)
class InstanceProbe(FmuProbe):
    """Asks how many instances there can be at once, up to `most`; and what the next one said."""

    most: int = 3

    def answer(self, evaluator: Evaluator) -> tuple[int, str]:
        held: list[FmuInstance] = []
        for count in range(1, self.most):
            try:
                held.append(FmuInstance(evaluator.model, evaluator.description))
            except ModelError as error:
                return count, str(error)
        return self.most, ""


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
    renew: Renewal
    others: FloatArray = field(repr=False)
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[float | str]:
        """For each point a distance, or what went wrong there."""
        end = time.monotonic() + self.seconds
        simulator = _renewing(evaluator, self.experiment, self.renew)
        base = _outputs(simulator.run(0, self.point[None]))
        found: list[float | str] = []
        for other in self.others:
            if time.monotonic() > end:
                break
            record = simulator.run(0, other[None])
            failed = record.codes[0] != failure.FINISHED
            found.append(record.messages[0] if failed else difference(record.outputs[0], base))
        return found


@dataclass(frozen=True)
class SolverProbe(FmuProbe):
    """Asks how far another solver, or other settings of it, come from the model's."""

    experiment: int
    point: FloatArray
    renew: Renewal
    solver: Solver

    def answer(self, evaluator: Evaluator) -> float:
        model = replace(evaluator.model, solver=self.solver, renew=self.renew)
        other = _twin(evaluator, model, evaluator.experiments[self.experiment])
        usual = _renewing(evaluator, self.experiment, self.renew)
        base = _outputs(usual.run(0, self.point[None]))
        return difference(base, _outputs(other.run(0, self.point[None])))


@dataclass(frozen=True)
class CompileProbe(FmuProbe):
    """Asks for what other probes need to be compiled and on disk, which takes long once."""

    def answer(self, evaluator: Evaluator) -> None:
        evaluator.simulator.compile_stiff()
        evaluator.simulator.compile_sensitivities()


@dataclass(frozen=True)
class StiffnessProbe(FmuProbe):
    """Asks whether the model is stiff."""

    experiment: int
    point: FloatArray

    def answer(self, evaluator: Evaluator) -> bool:
        return evaluator.simulator.stiff(self.experiment, self.point)


def _renewing(evaluator: Evaluator, experiment: int, renew: Renewal) -> Simulator:
    """Each of its simulations begins with a new instance, if that is wanted."""
    model = replace(evaluator.model, renew=renew)
    return _twin(evaluator, model, evaluator.experiments[experiment])


def _twin(evaluator: Evaluator, model: Model, experiment: Experiment) -> Simulator:
    """A simulator of something slightly else, on the same instance."""
    twin = Simulator(model, evaluator.description, (experiment,))
    twin.load(evaluator.simulator.instance)
    return twin


def _outputs(record: SimulationBatch) -> FloatArray:
    """Of the first simulation.

    Raises
    ------
    ModelError
        If it failed.
    """
    if record.codes[0] != failure.FINISHED:
        raise ModelError(record.messages[0])
    outputs: FloatArray = record.outputs[0]
    return outputs


def _distance(simulator: Simulator, point: FloatArray, first: FloatArray) -> float | None:
    try:
        return difference(_outputs(simulator.run(0, point[None])), first)
    except ModelError:
        return None
