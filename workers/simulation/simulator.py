"""Simulation of a model with its effects in an experiment, for many points."""

from __future__ import annotations

from ctypes import addressof
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from workers.core import failure
from workers.core.library import Batch, Settings, core
from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.messages import Effect, Experiment, FloatArray, IntArray, Model
from workers.simulation.batch import CvodeLoop, SimulationBatch
from workers.simulation.bind_experiment import BoundExperiment, bind_experiment
from workers.simulation.effect_bindings import EffectBindings
from workers.simulation.integrator import FmuIntegrator
from workers.simulation.sensitivities import SensitivitySource

if TYPE_CHECKING:
    from workers.effects.definition import EffectDefinition
    from workers.simulation.linearise import FilterPass, LinearisationPass


class Simulator:
    """One instance of an FMU and the experiments that it can simulate.

    It must be loaded before a simulation.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    experiments
        Experiments that `run` refers to by index.
    progress
        Progress that simulations record; see `workers.messages.types`.

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
        # inputs that may change between events come first, because they are set together
        driven = {given.variable for e in experiments for given in e.inputs}
        known = [description.variables[name] for name in driven & description.variables.keys()]
        discrete = {variable.name for variable in known if not variable.is_continuous}
        self._experiments = tuple(
            replace(e, inputs=tuple(sorted(e.inputs, key=lambda i: i.variable in discrete)))
            for e in experiments
        )
        without_effects = [
            replace(e, signals=()) for e in self._experiments
        ]  # signals act only through effects
        self._bound = [bind_experiment(model, description, e) for e in without_effects]
        signals = tuple(dict.fromkeys(s.variable for e in experiments for s in e.signals))
        self._bindings = EffectBindings(model, description, self._experiments, signals)
        self._sensitivity_source = SensitivitySource(model, description)
        self._integrator = FmuIntegrator(model, description, progress)

    def load(self, instance: FmuInstance | None = None) -> None:
        """Load and instantiate the FMU, or use the given instance.

        Raises
        ------
        ModelError
            If the FMU cannot be loaded on this machine.
        """
        self._integrator.load(instance)

    @property
    def instance(self) -> FmuInstance:
        return self._integrator.instance

    @property
    def gives_jacobian(self) -> bool:
        """Whether CVODE takes its Jacobian from the FMU; decided at the first simulation."""
        return self._integrator.gives_jacobian

    def bound_experiment(self, experiment: int) -> BoundExperiment:
        return self._bound[experiment]

    def run(
        self,
        experiment: int,
        points: FloatArray,
        effects: tuple[Effect, ...] = (),
        bounds: FloatArray | None = None,
        step_limit: int = 0,
    ) -> SimulationBatch:
        """Simulate one experiment for many points.

        Parameters
        ----------
        experiment
            Index of the experiment.
        points
            A row for each point: values of the model's parameters, then of the effects'
            coefficients.
        effects
            Effects that are added to the model.
        bounds : (points,)
            Sums of squared residuals above which simulations end early, if no effects act and the
            FMU communicates at all times of the grid; None for no bounds.
        step_limit
            See `Task`.

        Raises
        ------
        EffectError
            If an effect does not fit the FMU.
        """
        self._integrator.find_jacobian(self._bound[0])
        bound = self._bound[experiment]
        count = len(self._model.parameters)
        values, coefficients = points[:, :count], points[:, count:]
        if not effects:
            return self._integrator.run(bound, values, bounds=bounds, step_limit=step_limit)
        batch = SimulationBatch.empty(len(points), len(bound.grid.times), len(bound.outputs))
        for rows, active in self._bindings.groups(effects, coefficients):
            run = self._run_with_effects(
                experiment, values[rows], coefficients[rows], active, step_limit
            )
            batch.outputs[rows], batch.codes[rows] = run.outputs, run.codes
            batch.steps[rows] = run.steps
            for position, row in enumerate(rows.tolist()):
                batch.messages[row] = run.messages[position]
                if position in run.innovations:
                    batch.innovations[row] = run.innovations[position]
        return batch

    def linearise(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> SimulationBatch:
        """Simulate as `run` does, and linearise the model with its effects at each time.

        It stops at each time, even if the steps of `run` pass over it. With process noise, the
        model is linearised at the states corrected by a Kalman filter.

        Raises
        ------
        ModelError
            In co-simulation.
        """
        if self._model.interface != "model_exchange":
            raise ModelError(
                f"{self._model.name}: a linearisation needs the states and their derivatives, "
                "which an FMU provides only in model exchange, but model.interface is "
                '"co_simulation"; set it to "model_exchange"'
            )
        cvode = self._integrator.loop if isinstance(self._integrator.loop, CvodeLoop) else None
        if cvode is not None and self._description.event_indicators > 0:
            raise ModelError(
                f"{self._model.name}: has events, and solver cvode cannot be linearised across "
                'them; set model.solver to "dormand_prince" or "rk4"'
            )
        self._integrator.find_jacobian(self._bound[0])
        without_effects = self._bound[experiment]
        batch = SimulationBatch.empty(
            len(points), len(without_effects.grid.times), len(without_effects.outputs)
        )
        for p, point in enumerate(points):
            prepared = self._bindings.prepare(experiment, point, effects)
            one = prepared.at(point, self._integrator.component, cvode)
            filtered = self._filter_along(experiment, one, point, effects)
            loop = one if filtered is None else filtered
            run = self._integrator.run(one.bound, one.values, one.effects, loop)
            batch.codes[p], batch.messages[p] = run.codes[0], run.messages[0]
            if run.codes[0] != failure.FINISHED:
                continue
            found = one.result(run.outputs[0], without_effects)
            if filtered is not None:
                found = replace(found, log_spread=filtered.total_log_spread(one.bound.grid))
                batch.innovations[p] = filtered.standardised(one.bound.grid)
            batch.linearisations[p], batch.outputs[p] = found, found.outputs
        return batch

    def _filter_along(
        self,
        experiment: int,
        one: LinearisationPass,
        point: FloatArray,
        effects: tuple[Effect, ...],
    ) -> FilterPass | None:
        """Return the filter along which a model is linearised; None without process noise."""
        coefficients = point[len(self._model.parameters) :]
        ((_, active),) = self._bindings.groups(effects, coefficients[None])
        noise = [each for each in active if each[0].form.is_noise]
        if not noise:
            return None
        self._check_filter()
        from workers.simulation.linearise import StateNoise, prepare_filter

        states = (*self._description.states, *one.prepared.effect_states)
        found = [StateNoise.of(d, coefficients[first:]) for d, first in noise]
        log_spread = self._experiments[experiment].log_spread
        return prepare_filter(
            self._model, self._description, one.bound, states, found,
            log_spread=log_spread, linearised=one,
        )  # fmt: skip

    def sensitivities(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> SimulationBatch:
        """Simulate as `run` does, with the forward sensitivities of the outputs to the parameters.

        A point without sensitivities has a message with the reason, even if its simulation reached
        its end.
        """
        bound = self._bound[experiment]
        batch = SimulationBatch.empty(len(points), len(bound.grid.times), len(bound.outputs))
        for p, point in enumerate(points):
            run, reason = None, "there are effects"
            if not effects:
                try:
                    run, reason = self._run_with_sensitivities(bound, point)
                except ModelError as error:  # no further instance can be made
                    reason = str(error)
            if run is None:
                run = self.run(experiment, point[None], effects)
                run.messages[0] = run.messages[0] or f"no sensitivities: {reason}"
            batch.outputs[p], batch.codes[p] = run.outputs[0], run.codes[0]
            batch.steps[p] = run.steps[0]
            batch.messages[p] = run.messages[0]
            if run.sensitivities:
                batch.sensitivities[p] = run.sensitivities[0]
        return batch

    def _run_with_sensitivities(
        self, bound: BoundExperiment, point: FloatArray
    ) -> tuple[SimulationBatch | None, str]:
        """Run one simulation with sensitivities; return None and a reason if it fails."""
        reason = self._sensitivity_source.unavailable_reason(bound)
        if reason:
            return None, reason
        kinds = self._sensitivity_source.parameter_kinds(self._integrator, bound, point)
        if isinstance(kinds, str):
            return None, kinds
        for instance in (self.instance, *self._sensitivity_source.perturbed):
            if instance.is_new and not self._integrator.starts(instance, bound, point):
                return None, "an instance could not be started"
        sensitivity_pass = self._sensitivity_source.prepare_pass(
            bound, point, kinds, self.instance.component.handle
        )
        run = self._integrator.run(bound, point[None], loop=sensitivity_pass)
        if run.codes[0] != failure.FINISHED:
            if run.codes[0] >= failure.FATAL:
                for instance in self._sensitivity_source.perturbed:
                    instance.replace()
            return None, run.messages[0]
        sensitivities = np.full((len(point), *run.outputs.shape[1:]), np.nan)
        found = sensitivity_pass.structure.held
        sensitivities[found["positions"]] = found["sensitivities"].transpose(1, 0, 2)
        run.sensitivities[0] = sensitivities
        return run, ""

    def starts(self, experiment: int, point: FloatArray) -> bool:
        """Return whether the FMU can be initialised for an experiment."""
        return self._integrator.starts(self.instance, self._bound[experiment], point)

    def is_stiff(self, experiment: int, point: FloatArray, max_steps: int = 5000) -> bool:
        """Return whether a model exchange FMU without effects is stiff at a point.

        Then solver "cvode" is suitable. Stiffness is detected within `max_steps` steps of the
        Dormand-Prince method; False if the simulation fails within them.
        """
        found = [False]

        def look(batch: Batch) -> int:
            settings = Settings.from_address(batch.settings)
            limited = Settings.from_buffer_copy(settings)
            limited.max_steps = max_steps
            batch.settings = addressof(limited)
            found.append(bool(core().core_is_stiff(addressof(batch))))
            return 1

        self._integrator.run(self._bound[experiment], point[None], loop=look)
        return found[-1]

    def close(self) -> None:
        self._sensitivity_source.close()
        self.instance.free()

    def _run_with_effects(
        self,
        experiment: int,
        values: FloatArray,
        coefficients: FloatArray,
        active: list[tuple[EffectDefinition, int]],
        step_limit: int,
    ) -> SimulationBatch:
        """Simulate a group of points with the same active effects."""
        without_effects = self._bound[experiment]
        noise = [each for each in active if each[0].form.is_noise]
        if noise:
            return self._run_filtered(experiment, values, coefficients, active, noise)
        if not active:
            return self._integrator.run(without_effects, values, step_limit=step_limit)
        bound_effects, bound = self._bindings.bind(experiment, active, coefficients.shape[1])
        batch = SimulationBatch.empty(
            len(values), len(without_effects.grid.times), len(without_effects.outputs)
        )
        chunks = [slice(p, p + 1) for p in range(len(values))]
        for chunk in chunks if bound_effects.has_memory else [slice(None)]:
            if bound_effects.has_memory:
                with_memory = bound_effects.with_memory_effects(coefficients[chunk][0])
                bound = bind_experiment(
                    self._model,
                    self._description,
                    with_memory,
                    bound_effects.recorded,
                    passing=False,  # effects with memory have other samples than the inputs
                    seen=bound_effects.seen,
                )
            effects = bound_effects.at_points(
                values[chunk], coefficients[chunk], self._model, self._description
            )
            run = self._integrator.run(bound, values[chunk], effects, step_limit=step_limit)
            for p, outputs in enumerate(run.outputs):
                bound_effects.apply_to_outputs(bound.grid, outputs, coefficients[chunk][p])
            kept = _kept(bound, without_effects)
            batch.outputs[chunk] = run.outputs[:, kept, : len(without_effects.outputs)]
            batch.codes[chunk], batch.steps[chunk] = run.codes, run.steps
            batch.messages[chunk] = run.messages
        return batch

    def _run_filtered(
        self,
        experiment: int,
        values: FloatArray,
        coefficients: FloatArray,
        active: list[tuple[EffectDefinition, int]],
        noise: list[tuple[EffectDefinition, int]],
    ) -> SimulationBatch:
        """Simulate points with a Kalman filter for the noise of some of the effects."""
        self._check_filter()
        from workers.simulation.linearise import StateNoise, prepare_filter

        without_effects = self._bound[experiment]
        acting = [each for each in active if not each[0].form.is_noise or each[0].states]
        effects, bound = self._bindings.bind(experiment, acting, coefficients.shape[1])
        own = [str(z) for d in effects.definitions if d.site.kind != "output" for z in d.states]
        states = (*self._description.states, *own)
        batch = SimulationBatch.empty(
            len(values), len(without_effects.grid.times), len(without_effects.outputs)
        )
        kept = _kept(bound, without_effects)
        for p in range(len(values)):
            one = slice(p, p + 1)
            acting_here = effects.at_points(
                values[one], coefficients[one], self._model, self._description
            )
            found = [StateNoise.of(d, coefficients[p, first:]) for d, first in noise]
            chosen = prepare_filter(
                self._model, self._description, bound, states, found,
                log_spread=self._experiments[experiment].log_spread,
            )  # fmt: skip
            run = self._integrator.run(bound, values[one], acting_here, chosen)
            batch.outputs[p] = run.outputs[0, kept, : len(without_effects.outputs)]
            batch.codes[p], batch.messages[p] = run.codes[0], run.messages[0]
            if run.codes[0] == failure.FINISHED:
                batch.innovations[p] = chosen.standardised(bound.grid)
        return batch

    def _check_filter(self) -> None:
        """Check that the filter has access to the states.

        Raises
        ------
        ModelError
            In co-simulation, or with solver CVODE.
        """
        solver = self._model.solver.name
        if self._model.interface != "model_exchange" or solver == "cvode":
            raise ModelError(
                f"{self._model.name}: process noise needs model.interface = model_exchange and "
                f"model.solver = dormand_prince or rk4, but they are {self._model.interface} and "
                f"{solver}; change them"
            )


def _kept(bound: BoundExperiment, without_effects: BoundExperiment) -> IntArray | slice:
    """Return the indices of the times of `without_effects` in the grid of `bound`."""
    times, wanted = bound.grid.times, without_effects.grid.times
    if len(times) == len(wanted):  # the wanted times are among the others
        return slice(None)
    return np.asarray(np.searchsorted(times, wanted))
