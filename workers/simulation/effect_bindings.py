"""Effects bound to the experiments of a simulator, with a cache."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from workers.fmu.description import ModelDescription
from workers.messages import Effect, Experiment, FloatArray, IntArray, Model
from workers.simulation.bind_experiment import BoundExperiment, bind_experiment

if TYPE_CHECKING:
    from workers.effects.definition import EffectDefinition
    from workers.simulation.bind_effects import BoundEffects, EffectBatch
    from workers.simulation.linearise import PreparedExperiment

# SymPy takes half a second to import, so modules that need it are imported with the first effect


class EffectBindings:
    """Defines effects, binds them to experiments and prepares linearisations, with caches.

    Parameters
    ----------
    model, description, experiments
        Those of the simulator.
    signals
        Measured signals on which effects may depend.
    """

    def __init__(
        self,
        model: Model,
        description: ModelDescription,
        experiments: tuple[Experiment, ...],
        signals: tuple[str, ...],
    ) -> None:
        self._model, self._description = model, description
        self._experiments, self._signals = experiments, signals
        self._effects: dict[tuple[Effect, ...], EffectBatch] = {}
        self._bound: dict[
            tuple[int, tuple[tuple[EffectDefinition, int], ...], int],
            tuple[BoundEffects, BoundExperiment],
        ] = {}
        self._prepared: dict[
            tuple[int, tuple[tuple[EffectDefinition, int], ...], int], PreparedExperiment
        ] = {}

    def groups(
        self, effects: tuple[Effect, ...], coefficients: FloatArray
    ) -> Iterator[tuple[IntArray, list[tuple[EffectDefinition, int]]]]:
        """Group the points with the same active effects; see `EffectBatch.groups`."""
        from workers.simulation.bind_effects import EffectBatch

        if effects not in self._effects:
            self._effects[effects] = EffectBatch(
                effects, self._description, self._model, self._signals
            )
        return self._effects[effects].groups(coefficients)

    def bind(
        self, experiment: int, active: list[tuple[EffectDefinition, int]], n_coefficients: int
    ) -> tuple[BoundEffects, BoundExperiment]:
        """Bind an experiment and the effects that are active in a task."""
        key = (experiment, tuple(active), n_coefficients)
        if key not in self._bound:
            from workers.simulation.bind_effects import bind_effects

            effects = bind_effects(
                active,
                self._experiments[experiment],
                self._description,
                n_coefficients,
                model_exchange=self._model.interface == "model_exchange",
            )
            bound = bind_experiment(
                self._model,
                self._description,
                effects.experiment,
                effects.recorded,
                seen=effects.seen,
            )
            self._bound[key] = effects, bound
        return self._bound[key]

    def prepare(
        self, experiment: int, point: FloatArray, effects: tuple[Effect, ...]
    ) -> PreparedExperiment:
        """Prepare the linearisation of an experiment with the effects active at a point."""
        from workers.simulation.linearise import prepare

        coefficients = point[None, len(self._model.parameters) :]
        ((_, active),) = self.groups(effects, coefficients)
        count = coefficients.shape[1]
        key = (experiment, tuple(active), count)
        if key not in self._prepared:
            plain = self._experiments[experiment]
            self._prepared[key] = prepare(self._model, self._description, plain, active, count)
        return self._prepared[key]
