"""Model, experiment and effects in, outputs at every time of the grid out, for many points."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import typeof

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.kernels.fmi import failure
from workers.kernels.fmi.hooks import no_hooks
from workers.kernels.solvers.cvode import CvodeBatch
from workers.kernels.solvers.stiffness import stiffness
from workers.messages import Effect, Experiment, FloatArray, Input, IntArray, Model
from workers.simulation.bind_experiment import BoundExperiment, install
from workers.simulation.integrator import FmuIntegrator, SimulationBatch
from workers.simulation.sensitivities import SensitivitySource

if TYPE_CHECKING:
    from workers.effects.definition import EffectDefinition
    from workers.simulation.bind_effects import BoundEffects, EffectBatch
    from workers.simulation.linearise import PreparedExperiment


class Simulator:
    """One instance of an FMU and the experiments that it can be asked to simulate.

    It must be loaded before it can be asked anything.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    experiments
        What `run` counts by index.
    progress
        Counters that simulations advance; see `workers.kernels.fmi.progress`.

    Raises
    ------
    ModelError
        If the FMU lacks a variable that an experiment or the model names.
    """

    def __init__(
        self,
        model: Model,
        description: ModelDescription,
        experiments: tuple[Experiment, ...],
        progress: IntArray | None = None,
    ) -> None:
        self._model, self._description = model, description
        self._experiments = tuple(_moving_first(description, e) for e in experiments)
        plain = [
            replace(e, signals=()) for e in self._experiments
        ]  # they act through effects alone
        self._installed = [install(model, description, e) for e in plain]
        self._signals = tuple(dict.fromkeys(s.variable for e in experiments for s in e.signals))
        self._effects: dict[tuple[Effect, ...], EffectBatch] = {}
        self._augmented: dict[
            tuple[int, tuple[tuple[EffectDefinition, int], ...]],
            tuple[BoundEffects, BoundExperiment],
        ] = {}
        self._prepared: dict[
            tuple[int, tuple[tuple[EffectDefinition, int], ...], int], PreparedExperiment
        ] = {}
        self._sensing = SensitivitySource(model, description)
        self._loop = FmuIntegrator(model, description, progress)

    def load(self, instance: FmuInstance | None = None) -> None:
        """Load the FMU and instantiate it, unless another's instance is to be used.

        Raises
        ------
        ModelError
            If that does not work on this machine.
        """
        self._loop.load(instance)

    @property
    def instance(self) -> FmuInstance:
        return self._loop.instance

    @property
    def gives_jacobian(self) -> bool:
        """Whether CVODE takes its Jacobian from the FMU, as far as it has simulated anything."""
        return self._loop.gives_jacobian

    def warm_up(self) -> None:
        """Have the loop compiled, or read from disk, before there is an FMU to run it on."""
        self._loop.warm_up(self._installed[0])

    def installed(self, experiment: int) -> BoundExperiment:
        return self._installed[experiment]

    def run(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> SimulationBatch:
        """Simulate one experiment for many points.

        Parameters
        ----------
        experiment
            Index of the experiment.
        points
            A row for each: values of the model's parameters, then of the effects' coefficients.
        effects
            What is added to the model.

        Raises
        ------
        EffectError
            If an effect does not fit the FMU.
        """
        self._loop.find_jacobian(self._installed[0])
        ready = self._installed[experiment]
        count = len(self._model.parameters)
        values, coefficients = points[:, :count], points[:, count:]
        if not effects:
            return self._loop.run(ready, values, no_hooks(len(points)))
        record = SimulationBatch.empty(len(points), len(ready.grid.times), len(ready.outputs))
        for rows, active in self._resolved(effects).groups(coefficients):
            part = self._run_augmented(experiment, values[rows], coefficients[rows], active)
            record.outputs[rows], record.codes[rows] = part.outputs, part.codes
            for row, message in zip(rows.tolist(), part.messages, strict=True):
                record.messages[row] = message
        return record

    def linearise(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> SimulationBatch:
        """Do the same, and take the derivatives of the model and its effects on the way.

        Raises
        ------
        ModelError
            In co-simulation.
        """
        if self._model.interface != "model_exchange":
            raise ModelError(
                f"{self._model.name}: a linearisation needs the states and their derivatives, "
                "which an FMU gives in model exchange only; set model.interface to "
                '"model_exchange", but it is "co_simulation"'
            )
        cvode = self._loop.batch if isinstance(self._loop.batch, CvodeBatch) else None
        if cvode is not None and self._description.event_indicators > 0:
            raise ModelError(
                f"{self._model.name}: has events, across which solver cvode cannot be linearised; "
                'set model.solver to "dormand_prince" or "rk4"'
            )
        plain = self._installed[experiment]
        record = SimulationBatch.empty(len(points), len(plain.grid.times), len(plain.outputs))
        for p, point in enumerate(points):
            prepared = self._prepare(experiment, point, effects)
            made = prepared.at(point, cvode)
            own = len(prepared.own_states)
            part = self._loop.run(made.ready, made.values, made.hooks, own, made)
            record.codes[p], record.messages[p] = part.codes[0], part.messages[0]
            if part.codes[0] == failure.FINISHED:
                record.linearisations[p] = made.result(part.outputs[0], plain)
                record.outputs[p] = record.linearisations[p].outputs
        return record

    def sensitivities(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> SimulationBatch:
        """Do as `run` does, and take the outputs' derivatives by the parameters along.

        A point without them has a message that says why, though its simulation may have reached its
        end.
        """
        ready = self._installed[experiment]
        record = SimulationBatch.empty(len(points), len(ready.grid.times), len(ready.outputs))
        for p, point in enumerate(points):
            part, why = self._sense(ready, point) if not effects else (None, "there are effects")
            if part is None:
                part = self.run(experiment, point[None], effects)
                part.messages[0] = part.messages[0] or f"no sensitivities: {why}"
            record.outputs[p], record.codes[p] = part.outputs[0], part.codes[0]
            record.messages[p] = part.messages[0]
            if part.slopes:
                record.slopes[p] = part.slopes[0]
        return record

    def _sense(
        self, ready: BoundExperiment, point: FloatArray
    ) -> tuple[SimulationBatch | None, str]:
        """One simulation with sensitivities, or why there are none."""
        why = self._sensing.why_not(ready)
        if why:
            return None, why
        row = np.concatenate([point, ready.known])
        kinds = self._sensing.find_kinds(
            self.instance, ready, self._loop.settings(), no_hooks(1), row,
            self._loop.workspace(ready, no_hooks(1)),
        )  # fmt: skip
        if isinstance(kinds, str):
            return None, kinds
        along = self._sensing.along(ready, point, kinds, self.instance.component.handle)
        part = self._loop.run(ready, point[None], no_hooks(1), 0, along)
        if part.codes[0] != failure.FINISHED:
            if part.codes[0] >= failure.FATAL:
                self._sensing.forget_twins()
            return None, part.messages[0]
        slopes = np.full((len(point), *part.outputs.shape[1:]), np.nan)
        slopes[along.forward.columns] = along.forward.record.transpose(1, 0, 2)
        part.slopes[0] = slopes
        return part, ""

    def stiff(self, experiment: int, point: FloatArray, max_steps: int = 5000) -> bool:
        """Whether a model exchange FMU is stiff at one point of an experiment, without effects.

        Solver "cvode" suits it then. So many steps of the Dormand-Prince method, or fewer, tell;
        it is not stiff if the simulation fails within them.
        """
        found, code = stiffness(*self._of_stiffness(experiment, point, max_steps))
        if code >= failure.FATAL:
            self.instance.renew()
        return bool(found)

    def compile_stiff(self) -> None:
        """Have what `stiff` needs compiled, or read from disk."""
        point = np.zeros(len(self._model.parameters))
        stiffness.compile(tuple(typeof(each) for each in self._of_stiffness(0, point, 1)))

    def compile_sensitivities(self) -> None:
        """Have what `sensitivities` needs compiled, or read from disk, if the FMU may have them."""
        ready, point = self._installed[0], np.zeros(len(self._model.parameters))
        if self._sensing.why_not(ready):
            return
        arguments = self._of_stiffness(0, point, 1)
        self._sensing.compile(ready, point, arguments)

    def _of_stiffness(self, experiment: int, point: FloatArray, max_steps: int) -> tuple[Any, ...]:
        ready, hooks = self._installed[experiment], no_hooks(1)
        return (
            self._loop.component(),
            ready.references,
            ready.starts,
            self._loop.settings()._replace(max_steps=max_steps),
            hooks,
            ready.grid,
            np.concatenate([point, ready.known]),
            self._loop.workspace(ready, hooks),
        )

    def close(self) -> None:
        self._sensing.close()
        self.instance.free()

    def _resolved(self, effects: tuple[Effect, ...]) -> EffectBatch:
        from workers.simulation.bind_effects import (
            EffectBatch,  # SymPy takes half a second to import
        )

        if effects not in self._effects:
            self._effects[effects] = EffectBatch(
                effects, self._description, self._model, self._signals
            )
        return self._effects[effects]

    def _prepare(
        self, experiment: int, point: FloatArray, effects: tuple[Effect, ...]
    ) -> PreparedExperiment:
        """Prepare an experiment to be linearised with the effects that act at a point, once."""
        from workers.simulation.linearise import prepare

        coefficients = point[None, len(self._model.parameters) :]
        ((_, active),) = self._resolved(effects).groups(coefficients)
        count = coefficients.shape[1]
        key = (experiment, tuple(active), count)
        if key not in self._prepared:
            run = self._experiments[experiment]
            self._prepared[key] = prepare(self._model, self._description, run, active, count)
        return self._prepared[key]

    def _run_augmented(
        self,
        experiment: int,
        values: FloatArray,
        coefficients: FloatArray,
        active: list[tuple[EffectDefinition, int]],
    ) -> SimulationBatch:
        """A group of points on which the same effects act."""
        plain = self._installed[experiment]
        if not active:
            return self._loop.run(plain, values, no_hooks(len(values)))
        augmentation, ready = self._augment(experiment, active)
        own = augmentation.inner.own_states if augmentation.inner is not None else 0
        record = SimulationBatch.empty(len(values), len(plain.grid.times), len(plain.outputs))
        chunks = [slice(p, p + 1) for p in range(len(values))]
        for chunk in chunks if augmentation.remembers else [slice(None)]:
            if augmentation.remembers:
                changed = augmentation.remembered(coefficients[chunk][0])
                ready = install(self._model, self._description, changed, augmentation.recorded)
            hooks = augmentation.hooks(
                ready.running, values[chunk], coefficients[chunk], self._model, self._description
            )
            part = self._loop.run(ready, values[chunk], hooks, own)
            for p, outputs in enumerate(part.outputs):
                augmentation.act_on(ready.grid, outputs, coefficients[chunk][p])
            kept = np.searchsorted(ready.grid.times, plain.grid.times)
            record.outputs[chunk] = part.outputs[:, kept, : len(plain.outputs)]
            record.codes[chunk] = part.codes
            record.messages[chunk] = part.messages
        return record

    def _augment(
        self, experiment: int, active: list[tuple[EffectDefinition, int]]
    ) -> tuple[BoundEffects, BoundExperiment]:
        """Prepare an experiment for the effects that act on it, once."""
        key = (experiment, tuple(active))
        if key not in self._augmented:
            from workers.simulation.bind_effects import augment

            run = self._experiments[experiment]
            exchange = self._model.interface == "model_exchange"
            made = augment(active, run, self._description, exchange=exchange)
            ready = install(self._model, self._description, made.experiment, made.recorded)
            self._augmented[key] = made, ready
        return self._augmented[key]


def _moving_first(description: ModelDescription, experiment: Experiment) -> Experiment:
    """The same with inputs that may move between events first: those are set together."""

    def is_discrete(given: Input) -> bool:
        variable = description.variables.get(given.variable)
        return variable is not None and not variable.moves

    return replace(experiment, inputs=tuple(sorted(experiment.inputs, key=is_discrete)))
