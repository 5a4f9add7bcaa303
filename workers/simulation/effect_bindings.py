"""Effects bound to the experiments of a simulator, each combination once."""

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
    """Resolves effects, binds them to experiments and prepares linearisations, each once.

    Parameters
    ----------
    model, description, experiments
        What the simulator simulates.
    signals
        Measured signals that effects may depend on.
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
        """Group points on which the same effects act; see `EffectBatch.groups`."""
        from workers.simulation.bind_effects import EffectBatch

        if effects not in self._effects:
            self._effects[effects] = EffectBatch(
                effects, self._description, self._model, self._signals
            )
        return self._effects[effects].groups(coefficients)

    def bind(
        self, experiment: int, active: list[tuple[EffectDefinition, int]], n_coefficients: int
    ) -> tuple[BoundEffects, BoundExperiment]:
        """Bind an experiment and the effects that act on it, of a task with some coefficients."""
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
        """Prepare an experiment to be linearised with the effects that act at a point."""
        from workers.simulation.linearise import prepare

        coefficients = point[None, len(self._model.parameters) :]
        ((_, active),) = self.groups(effects, coefficients)
        count = coefficients.shape[1]
        key = (experiment, tuple(active), count)
        if key not in self._prepared:
            plain = self._experiments[experiment]
            self._prepared[key] = prepare(self._model, self._description, plain, active, count)
        return self._prepared[key]
