"""Probes that simulate variants of an experiment, or two instances at once.

A single thread tests whether two instances in one process disturb each other: all calls of one
simulation are made in the middle of the other.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from workers.core import failure
from workers.errors import ModelError
from workers.evaluate import Evaluator, FmuProbe
from workers.fmu.instance import FmuInstance
from workers.messages import Experiment, FloatArray, Model, ResetPolicy
from workers.simulation.simulator import Simulator


@dataclass(frozen=True)
class SimulatedVariant:
    """Result of one experiment; `values[i, j]` is the j-th recorded variable at `times[i]`."""

    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)


@dataclass(frozen=True)
class VariantProbe(FmuProbe):
    """Simulates variants of an experiment, with inputs or times in other units.

    Attributes
    ----------
    variants
        Experiments, each with the factor by which its times were multiplied; the solver's step is
        multiplied by it too.
    point, reset
        Values of the model's parameters, and the reset policy.
    seconds
        Time limit, after which the remaining variants are omitted.
    """

    variants: tuple[tuple[Experiment, float], ...]
    point: FloatArray
    reset: ResetPolicy
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[SimulatedVariant | None]:
        """Return the outputs of each variant; None if it failed."""
        end = time.monotonic() + self.seconds
        found: list[SimulatedVariant | None] = []
        for experiment, factor in self.variants:
            if time.monotonic() > end:
                break
            found.append(_simulated(evaluator, experiment, factor, self.point, self.reset))
        return found


def _simulated(
    evaluator: Evaluator,
    experiment: Experiment,
    factor: float,
    point: FloatArray,
    reset: ResetPolicy,
) -> SimulatedVariant | None:
    model: Model = replace(evaluator.model, reset=reset)
    step = model.solver.step
    if step is not None:
        model = replace(model, solver=replace(model.solver, step=step * factor))
    try:
        simulator = Simulator(model, evaluator.description, (experiment,))
        simulator.load(evaluator.simulator.instance)
        batch = simulator.run(0, point[None])
    except ModelError:
        return None
    if batch.codes[0] != failure.FINISHED:
        return None
    return SimulatedVariant(simulator.bound_experiment(0).grid.times, batch.outputs[0])


@dataclass(frozen=True)
class SimulationVariant:
    """A way to simulate an experiment.

    Attributes
    ----------
    parameters
        Positions of the model's parameters that are set; the others keep the FMU's own values.
    step
        The solver's step in seconds; None for the model's step.
    """

    parameters: tuple[int, ...]
    step: float | None = None


@dataclass(frozen=True)
class RemedyProbe(FmuProbe):
    """Tries several ways to simulate an experiment, each with a new instance.

    If the number of instances is limited, the previous instance is freed first.

    Attributes
    ----------
    experiment, point
        Index of the experiment, and values of the model's parameters.
    variants
        The ways to try.
    seconds
        Time limit, after which the remaining variants are omitted.
    """

    experiment: int
    point: FloatArray
    variants: tuple[SimulationVariant, ...]
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[bool]:
        """Return whether each variant succeeded; those beyond the time limit are omitted."""
        end = time.monotonic() + self.seconds
        found: list[bool] = []
        for variant in self.variants:
            if time.monotonic() > end or evaluator.has_lost_seat:
                break
            found.append(self._runs(evaluator, variant))
        return found

    def _runs(self, evaluator: Evaluator, variant: SimulationVariant) -> bool:
        kept = list(variant.parameters)
        names = tuple(evaluator.model.parameters[i] for i in kept)
        model = replace(evaluator.model, parameters=names, reset="instance")
        if variant.step is not None:
            model = replace(model, solver=replace(model.solver, step=variant.step))
        experiment = evaluator.experiments[self.experiment]
        simulator = Simulator(model, evaluator.description, (experiment,))
        limited = model.seats is not None
        try:
            simulator.load(evaluator.simulator.instance if limited else None)
            batch = simulator.run(0, np.ascontiguousarray(self.point[None, kept]))
        except ModelError:
            return False
        return bool(batch.codes[0] == failure.FINISHED)


_EXIT_INITIALISATION = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)
_WARNING = 1
"""The worst status of a call after which a simulation continues."""


@dataclass(frozen=True)
class InstanceSimulation:
    """A simulation for an instance.

    Attributes
    ----------
    experiment
        Index of the experiment.
    point : (values,)
        Values of the model's parameters.
    """

    experiment: int
    point: FloatArray = field(repr=False)


@dataclass(frozen=True)
class SideBySideProbe(FmuProbe):
    """Tests whether a second instance changes the bits of a simulation.

    Some FMUs keep data of an instance in static variables. They are correct as long as instances
    take turns. If threads simulate several instances at once, they are wrong without any sign.
    Threads would show this only by chance. So one instance is initialised, then the other is
    initialised and simulated to its end, and then the first continues: four simulations in total.

    Attributes
    ----------
    one, other
        The two simulations; with different values and experiments if possible.
    together
        False to simulate them only separately. If this does not crash but the complete test does,
        the second instance is the cause.
    """

    one: InstanceSimulation
    other: InstanceSimulation
    together: bool = True

    def answer(self, evaluator: Evaluator) -> bool | None:
        """Return True if they disturb each other, None if one fails alone or is not repeatable."""
        if evaluator.model.seats is not None:
            evaluator.free_instance()  # the two instances below may be all that are allowed
        first, second = _InstanceRun(evaluator, self.one), _InstanceRun(evaluator, self.other)
        alone = first.bits(), second.bits()
        if None in alone:
            return None
        if not self.together or first.bits_around(second) == alone:
            return False
        return True if (first.bits(), second.bits()) == alone else None


class _InstanceRun:
    """Simulates one experiment at one point, each time with a new instance."""

    def __init__(self, evaluator: Evaluator, asked: InstanceSimulation) -> None:
        self._model = replace(evaluator.model, reset="reset")  # for a new instance, it does nothing
        self._description = evaluator.description
        self._experiment = evaluator.experiments[asked.experiment]
        self._point = asked.point

    def bits(self) -> bytes | None:
        """Return the outputs as bytes; None if the simulation fails.

        Raises
        ------
        ModelError
            If no instance can be made.
        """
        return self._simulate(FmuInstance(self._model, self._description))

    def bits_around(self, other: _InstanceRun) -> tuple[bytes | None, bytes | None]:
        """Return the outputs as bytes, and those of `other`, simulated after this initialisation.

        Raises
        ------
        ModelError
            If two instances cannot be made.
        """
        instance = FmuInstance(self._model, self._description)
        found: list[bytes | ModelError | None] = []

        def simulate_the_other() -> None:
            try:
                found.append(other.bits())
            except ModelError as error:
                found.append(error)

        called = _hook(instance, simulate_the_other)
        own = self._simulate(instance)
        del called  # until here, the core may call it by its address
        between = found[0] if found else None
        if isinstance(between, ModelError):
            raise between
        return own, between

    def _simulate(self, instance: FmuInstance) -> bytes | None:
        simulator = Simulator(self._model, self._description, (self._experiment,))
        simulator.load(instance)
        try:
            batch = simulator.run(0, self._point[None])
        finally:
            simulator.close()
        return batch.outputs.tobytes() if batch.codes[0] == failure.FINISHED else None


def _hook(instance: FmuInstance, then: Callable[[], None]) -> object:
    """Call a function after the next initialisation; return an object that must stay alive."""
    address = instance.component.exit_initialization_mode
    exit_initialisation = _EXIT_INITIALISATION(address)

    def called(handle: int) -> int:
        status: int = exit_initialisation(handle)
        if status <= _WARNING:
            then()
        return status

    hooked = _EXIT_INITIALISATION(called)
    at = ctypes.cast(hooked, ctypes.c_void_p).value or address
    instance.component.exit_initialization_mode = at
    return hooked
