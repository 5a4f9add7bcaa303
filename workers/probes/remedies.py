"""A probe of `cluster-est check` that simulates what failed in other ways."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.kernels.fmi import failure
from workers.messages import FloatArray
from workers.probes.base import FmuProbe
from workers.simulation.simulator import Simulator


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
