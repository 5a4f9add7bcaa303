"""A probe of `cluster-est check` that simulates an experiment as it may have been meant."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from workers.errors import ModelError
from workers.evaluate import Evaluator, FmuProbe
from workers.kernels.fmi import failure
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
