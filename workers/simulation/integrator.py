"""Integration of an FMU by the core: rows of parameter values to a batch of outputs."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from workers.core import failure
from workers.core.library import METHODS, NO_EFFECTS, Effects, Fmu, Settings
from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.fmu.process_environment import kept_signal_handlers
from workers.messages import FloatArray, IntArray, Model
from workers.messages.types import RUNNING, no_watcher
from workers.simulation.batch import BatchRun, CvodeLoop, Loop, SimulationBatch, simulate
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.jacobian import (
    MAX_JACOBIAN_ERROR,
    compare_with_differences,
    directional_jacobian,
)

UNTOLD, EXPERIMENT_STOP = -1.0, 0.0
STOP_UNITS = (EXPERIMENT_STOP, 1.0, 86400.0)
"""Units of stop times that FMUs require: that of the experiment, whole seconds, whole days
(EnergyPlus)."""
_stop_units: dict[str, float] = {}
"""Required units of stop times in this process, by the FMU's hash."""

DEFAULT_RTOL = 1e-8
"""Default tolerance of Dormand-Prince. Sampled inputs already limit the steps, so accuracy costs
little."""


class FmuIntegrator:
    """One instance of an FMU, and the solver's loop that simulates experiments with it.

    It must be loaded before a simulation.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    progress
        Progress that the loop records; see `workers.messages.types`.
    """

    instance: FmuInstance

    def __init__(
        self, model: Model, description: ModelDescription, progress: IntArray | None = None
    ) -> None:
        self._model, self._description = model, description
        name = model.solver.name
        self._method = METHODS[name]
        self.loop: Loop = CvodeLoop() if name == "cvode" else simulate
        self._checks_jacobian = name == "cvode" and _may_use_jacobian(model, description)
        self._has_started = False
        self._settings: dict[int, Settings] = {}
        self._progress = no_watcher() if progress is None else progress
        self._progress_at = self._progress.ctypes.data
        self._largest_array = max((v.size for v in description.variables.values()), default=1)

    def load(self, instance: FmuInstance | None = None) -> None:
        """Load and instantiate the FMU, or use the given instance.

        Raises
        ------
        ModelError
            If the FMU cannot be loaded on this machine.
        """
        self.instance = (
            FmuInstance(self._model, self._description) if instance is None else instance
        )

    def run(
        self,
        bound: BoundExperiment,
        values: FloatArray,
        effects: Effects = NO_EFFECTS,
        loop: Loop | None = None,
        bounds: FloatArray | None = None,
        step_limit: int = 0,
    ) -> SimulationBatch:
        """Simulate an experiment for many points.

        Parameters
        ----------
        bound
            The experiment.
        values
            A row for each point: values of the model's parameters.
        effects
            The effects that act.
        loop
            Replaces the solver's loop.
        bounds : (points,)
            Sums of squared residuals above which simulations end early; None for no bounds.
        step_limit
            Number of steps after which a simulation fails, if the solver chooses its steps; 0 for
            no limit.
        """
        run = BatchRun(bound, values, effects, bounds, step_limit)
        loop = self.loop if loop is None else loop
        point = 0
        while point < len(values):
            point = self._simulate_from(run, loop, point)
        if bound.communication is not None:
            return replace(run.result, outputs=bound.communication.interpolate(run.result.outputs))
        return run.result

    def starts(self, instance: FmuInstance, bound: BoundExperiment, point: FloatArray) -> bool:
        """Start a new instance, so that it can be reset later; return whether this succeeded."""
        started = self._starts(instance, self._told(instance.begin()), bound, point)
        return started or self._lacked_stop_time(instance, bound, point)

    def _starts(
        self,
        instance: FmuInstance,
        component: Fmu,
        bound: BoundExperiment,
        point: FloatArray,
    ) -> bool:
        run = BatchRun(bound.start_alone(), point[None], NO_EFFECTS)
        self._simulate(run, self.loop, component, 0, 1)
        code = int(run.result.codes[0])
        if code >= failure.FATAL:
            instance.replace()
        return code == failure.FINISHED

    def _lacked_stop_time(
        self, instance: FmuInstance, bound: BoundExperiment, point: FloatArray
    ) -> bool:
        """Return whether a failed start succeeds with a stop time, which is then always set.

        The previous setting is tried once more, because some FMUs fail randomly.
        """
        before = self._stop_unit
        if self._model.stop_time is False:
            return False
        for unit in dict.fromkeys((before, *STOP_UNITS)):
            try:
                component = instance.begin_anew()
                component.stop_unit = unit
                started = self._starts(instance, component, bound, point)
            except ModelError:  # no further instance can be made
                return False
            if started and unit != before:
                _stop_units[self._model.archive_hash] = unit
            if started:
                return unit != before
        return False

    @property
    def _stop_unit(self) -> float:
        if self._model.stop_time is False:
            return UNTOLD
        return _stop_units.get(
            self._model.archive_hash, EXPERIMENT_STOP if self._model.stop_time else UNTOLD
        )

    def _told(self, component: Fmu) -> Fmu:
        """Set an instance's unit of the stop time, if the FMU needs one."""
        component.stop_unit = self._stop_unit
        return component

    def find_jacobian(self, bound: BoundExperiment) -> None:
        """Make CVODE use the FMU's directional derivatives, if they are correct at the start.

        They are checked at the FMU's own start values, so that all workers come to the same result.
        The check uses a separate instance, because the other instance must be new in its first
        simulation.
        """
        if not self._checks_jacobian or not isinstance(self.loop, CvodeLoop):
            return
        self._checks_jacobian = False
        known = self._description.variables
        values = np.array([known[name].start or 0.0 for name in self._model.parameters])
        jacobian = directional_jacobian(self._description)
        try:
            apart = self._instance_apart()
        except ModelError:
            return
        try:
            if not self.starts(apart, bound, values):
                return
            with kept_signal_handlers():
                found = compare_with_differences(apart.fmu, self._description.version, jacobian)
        except ModelError:
            return
        finally:
            apart.free()
        if found.error <= MAX_JACOBIAN_ERROR:  # zeros instead of derivatives give an error of 1
            self.loop.jacobian = jacobian

    def _instance_apart(self) -> FmuInstance:
        """Return a second instance; if there is no seat for it, free the worker's instance first.

        The first simulation makes the worker's instance again.

        Raises
        ------
        ModelError
            If no instance can be made.
        """
        try:
            return FmuInstance(self._model, self._description)
        except ModelError:
            if self._model.seats is None or self._description.once_per_process:
                raise
        self.instance.free()
        return FmuInstance(self._model, self._description)

    @property
    def gives_jacobian(self) -> bool:
        """Whether CVODE takes its Jacobian from the FMU; decided at the first simulation."""
        return isinstance(self.loop, CvodeLoop) and len(self.loop.jacobian.states) > 0

    def component(self) -> Fmu:
        """Return the instance for the next simulation."""
        anew = self._new_instance_each
        return self._told(self.instance.begin_anew() if anew else self.instance.begin())

    def _settings_for(self, run: BatchRun) -> Settings:
        """Return the settings of the solver, with tolerances for the effects' states."""
        states = run.effects.n_states
        if states not in self._settings:
            self._settings[states] = self._make_settings(states)
        settings, fixed = self._settings[states], run.bound.communication
        if fixed is not None or run.step_limit:
            settings = Settings.from_buffer_copy(settings)
            settings.all_steps = run.step_limit
        if fixed is not None:
            settings.step, settings.fixed = fixed.max_step, fixed.step
        return settings

    def _make_settings(self, n_effect_states: int) -> Settings:
        solver = self._model.solver
        rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
        atol = rtol if solver.atol is None else solver.atol
        nominals = [self._description.variables[name].nominal for name in self._description.states]
        nominals += [1.0] * n_effect_states
        return Settings(
            step=solver.step or 0.0,
            rtol=rtol,
            atol=atol,
            max_steps=solver.max_steps,
            fmu_tolerance=solver.rtol or 0.0,
        ).hold(np.float64, atols=np.maximum(atol * np.array(nominals), np.finfo(np.float64).tiny))

    @property
    def _new_instance_each(self) -> bool:
        """Whether each simulation has a new instance."""
        return self._model.reset in ("instance", "process")

    def _simulate_from(self, run: BatchRun, loop: Loop, first: int) -> int:
        """Simulate points up to the first failure; return the next point to simulate."""
        self.instance.log.clear()
        alone = self._new_instance_each or self.instance.is_new
        try:
            component = self.component()
        except ModelError as error:
            run.result.codes[first] = failure.INITIALISATION
            run.result.messages[first] = str(error)
            return first + 1
        count = 1 if alone else len(run.values) - first
        following = first + self._simulate(run, loop, component, first, count)
        last = following - 1
        code = int(run.result.codes[last])
        if code == failure.FINISHED:
            self._has_started = True
            return following
        if code == failure.DISCARDED and (end := self.instance.termination_time()) is not None:
            run.result.codes[last] = code = failure.TERMINATED
            run.stopped_at[last] = max(run.stopped_at[last], end)
        if last > first and self.instance.log and code != failure.ENDED_EARLY:
            following = last  # repeat it alone: the log may contain messages of other points
        else:
            run.result.messages[last] = self._explain(run, code, last)
        if code >= failure.FATAL:
            self.instance.replace()
        if code % failure.FATAL != failure.INITIALISATION:
            self._has_started = True
        elif (
            not self._has_started
            and following > last
            and self._lacked_stop_time(self.instance, run.bound, run.values[last])
        ):
            run.result.messages[last], following = "", last
        return following

    def _simulate(self, run: BatchRun, loop: Loop, fmu: Fmu, first: int, count: int) -> int:
        """Simulate points up to the first failure; return their number."""
        settings = self._settings_for(run)
        batch = run.batch(first, count, fmu, settings, self._method)
        batch.largest_array, batch.progress = self._largest_array, self._progress_at
        process = os.getpid()
        try:
            with kept_signal_handlers():
                return loop(batch)
        finally:
            if os.getpid() != process:  # the FMU has forked; only the original answers
                os._exit(0)
            self._progress[RUNNING] = 0

    def _explain(self, run: BatchRun, code: int, point: int) -> str:
        log = " | ".join(dict.fromkeys(self.instance.log)) if code != failure.ENDED_EARLY else ""
        said = failure.MESSAGES[code % failure.FATAL].format(limit=run.step_limit)
        message = f"{said} at t = {run.stopped_at[point]:.9g} s"
        if code in failure.SUGGEST_STIFFNESS and self._model.solver.name == "dormand_prince":
            message += (
                '; if the model is stiff, set model.solver = "cvode", which can continue with '
                "longer steps"
            )
        return f"{message}; the FMU said: {log}" if log else message


def _may_use_jacobian(model: Model, description: ModelDescription) -> bool:
    """Return whether an FMU provides directional derivatives, and may be started to check them."""
    offered = description.offer(model.interface).provides_directional_derivatives
    new_process = model.reset == "process"
    return offered and not new_process and len(directional_jacobian(description).states) > 0
