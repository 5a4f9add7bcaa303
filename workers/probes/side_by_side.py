"""Whether two instances in one process disturb each other, found out in one thread."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.fmu.instance import FmuInstance
from workers.kernels.fmi import failure
from workers.messages import FloatArray
from workers.probes.base import FmuProbe
from workers.simulation.simulator import Simulator

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
    simulated to its end, and only then the first goes on; and the other way round.

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
        first, second = _InstanceRun(evaluator, self.one), _InstanceRun(evaluator, self.other)
        alone = first.bits(), second.bits()
        if None in alone or (first.bits(), second.bits()) != alone:
            return None
        if not self.together:
            return False
        return first.bits(around=second) != alone[0] or second.bits(around=first) != alone[1]


class _InstanceRun:
    """Simulates one experiment at one point, each time with a new instance."""

    def __init__(self, evaluator: Evaluator, asked: InstanceSimulation) -> None:
        self._model = replace(evaluator.model, reset="reset")  # of a new one it does nothing
        self._description = evaluator.description
        self._experiment = evaluator.experiments[asked.experiment]
        self._point = asked.point

    def bits(self, around: _InstanceRun | None = None) -> bytes | None:
        """Return the outputs as bytes; None if the simulation fails.

        With `around`, that is simulated as soon as this one is initialised.

        Raises
        ------
        ModelError
            If there is no instance to be had.
        """
        instance = FmuInstance(self._model, self._description)
        raised: list[ModelError] = []

        def simulate_the_other() -> None:
            try:
                if around is not None:
                    around.bits()
            except ModelError as error:
                raised.append(error)

        calls = _hook(instance, simulate_the_other) if around is not None else None
        simulator = Simulator(self._model, self._description, (self._experiment,))
        simulator.load(instance)
        try:
            batch = simulator.run(0, self._point[None])
        finally:
            simulator.close()
            del calls  # the loop has called it by its address up to here
        if raised:
            raise raised[0]
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
    instance.component = instance.component._replace(exit_initialization_mode=at)
    return hooked
