"""Probes that simulate an experiment in another way: as it may have been meant, or two at once.

Whether two instances in one process disturb each other is found out in one thread: the calls of one
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
    """What one experiment gave; `values[i, j]` is the j-th recorded variable at `times[i]`."""

    times: FloatArray = field(repr=False)
    values: FloatArray = field(repr=False)


@dataclass(frozen=True)
class VariantProbe(FmuProbe):
    """Asks for simulations of variants of an experiment: with inputs or times in other units.

    Attributes
    ----------
    variants
        Experiments, each with the factor by which its times were multiplied: the solver's step is
        multiplied too.
    point, reset
        Values of the model's parameters, and what each simulation begins with.
    seconds
        After which the rest is left out.
    """

    variants: tuple[tuple[Experiment, float], ...]
    point: FloatArray
    reset: ResetPolicy
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[SimulatedVariant | None]:
        """For each variant its outputs; None if it failed."""
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
        The solver's step in seconds; None for that of the model.
    """

    parameters: tuple[int, ...]
    step: float | None = None


@dataclass(frozen=True)
class RemedyProbe(FmuProbe):
    """Asks in which of some ways an experiment can be simulated, each with a new instance.

    Where the number of instances is limited, each is made when the one before was freed.

    Attributes
    ----------
    experiment, point
        What is simulated, with the values of the model's parameters.
    variants
        The ways to try.
    seconds
        After which the rest is left out.
    """

    experiment: int
    point: FloatArray
    variants: tuple[SimulationVariant, ...]
    seconds: float

    def answer(self, evaluator: Evaluator) -> list[bool]:
        """For each variant whether it ended well; those without time are left out."""
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
"""The worst status of a call with which a simulation goes on."""


@dataclass(frozen=True)
class InstanceSimulation:
    """A simulation that an instance is asked for.

    Attributes
    ----------
    experiment
        Index of it.
    point : (values,)
        Of the model's parameters.
    """

    experiment: int
    point: FloatArray = field(repr=False)


@dataclass(frozen=True)
class SideBySideProbe(FmuProbe):
    """Asks whether a simulation has other bits while another instance is initialised and simulated.

    An FMU that keeps in static variables what belongs to an instance is right as long as instances
    take turns, and wrong without any sign of it where threads simulate several at once. Threads
    would show that by chance only. So one instance is initialised, then the other one is, and
    simulated to its end, and only then the first goes on: four simulations in all.

    Attributes
    ----------
    one, other
        The two simulations; with other values and in other experiments, if there are any.
    together
        False to simulate them alone only: if that does not crash but the rest does, it is because
        of the second instance.
    """

    one: InstanceSimulation
    other: InstanceSimulation
    together: bool = True

    def answer(self, evaluator: Evaluator) -> bool | None:
        """True if they disturb each other; None if one fails alone or does not repeat itself."""
        if evaluator.model.seats is not None:
            evaluator.free_instance()  # the two below are all that there may be
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
        self._model = replace(evaluator.model, reset="reset")  # of a new one it does nothing
        self._description = evaluator.description
        self._experiment = evaluator.experiments[asked.experiment]
        self._point = asked.point

    def bits(self) -> bytes | None:
        """Return the outputs as bytes; None if the simulation fails.

        Raises
        ------
        ModelError
            If there is no instance to be had.
        """
        return self._simulate(FmuInstance(self._model, self._description))

    def bits_around(self, other: _InstanceRun) -> tuple[bytes | None, bytes | None]:
        """Return the same, and that of another one simulated as soon as this one is initialised.

        Raises
        ------
        ModelError
            If there are no two instances to be had.
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
        del called  # the loop has called it by its address up to here
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
    """Call something at the end of an instance's next initialisation; return what must live on."""
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
