"""A probe of `cluster-est check` that simulates an experiment as it may have been meant."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.kernels.fmi import failure
from workers.messages import Experiment, FloatArray, Model, ResetPolicy
from workers.probes.base import FmuProbe
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
