"""Integration of one FMU by a compiled loop: rows of values in, a batch of outputs out."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.fmu.process_environment import kept_signal_handlers
from workers.kernels import linearise
from workers.kernels.fmi import failure
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import FmiComponent, KernelWorkspace, nothing_loaded, workspace
from workers.kernels.fmi.hooks import EffectHooks, no_hooks
from workers.kernels.fmi.initialise import SolverSettings
from workers.kernels.solvers.co_simulation import co_simulate_batch
from workers.kernels.solvers.cvode import CvodeBatch
from workers.kernels.solvers.dormand_prince import dormand_prince_batch
from workers.kernels.solvers.rk4 import rk4_batch
from workers.messages import FloatArray, IntArray, Linearisation, Model
from workers.messages.types import RUNNING, no_watcher
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.jacobian import (
    MAX_JACOBIAN_ERROR,
    compare_with_differences,
    directional_jacobian,
)


@dataclass(frozen=True)
class SimulationBatch:
    """Results of a batch of simulations.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty where a simulation reached its end, else a sentence.
    codes : (points,)
        See `workers.kernels.fmi.failure`.
    steps : (points,)
        Steps of the solver; 0 where that is not known.
    linearisations
        By point, where that was asked for and the simulation reached its end.
    sensitivities
        (parameters, times, outputs) by point, where sensitivities were asked for and to be had;
        NaN for parameters by which there are none.
    innovations
        (residuals,) by point, where there is process noise: they take the place of the residuals,
        and `outputs` are predictions from one measured time to the next.
    """

    outputs: FloatArray
    messages: list[str]
    codes: IntArray
    steps: IntArray
    linearisations: dict[int, Linearisation] = field(default_factory=dict)
    sensitivities: dict[int, FloatArray] = field(default_factory=dict)
    innovations: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def empty(cls, points: int, times: int, outputs: int) -> SimulationBatch:
        """Make one of which nothing is simulated yet."""
        return cls(
            np.full((points, times, outputs), np.nan),
            [""] * points,
            np.zeros(points, np.int64),
            np.zeros(points, np.int64),
        )


Batch = Callable[[KernelArguments], int]
"""Simulates many points and returns how many of them: up to the first that failed."""
BATCHES: dict[str, Batch] = {
    "fmu": lambda arguments: int(co_simulate_batch(*arguments)),
    "rk4": lambda arguments: int(rk4_batch(*arguments)),
    "dormand_prince": lambda arguments: int(dormand_prince_batch(*arguments)),
}

UNTOLD, EXPERIMENT_STOP = -1.0, 0.0
STOP_UNITS = (EXPERIMENT_STOP, 1.0, 86400.0)
"""What FMUs ask of a stop time: that of the experiment, whole seconds, whole days (EnergyPlus)."""
_stop_units: dict[str, float] = {}
"""What stop times FMUs have asked for in this process, by the FMU's hash, where there must be
one."""

DEFAULT_RTOL = 1e-8
"""Tolerance of Dormand-Prince: on sampled inputs its steps are short anyhow, so accuracy costs
little."""


@dataclass(frozen=True)
class _BatchRun:
    """A batch of points on their way through the loop.

    Attributes
    ----------
    batch
        Simulates them.
    rows : (points, k)
        Values of the parameters, then known values.
    bounds : (points,)
        Sums of squares above which simulations end early.
    hooks, n_effect_states
        The effects that act, and the number of their own states.
    stopped_at : (points,)
        Times of failures.
    """

    batch: Batch
    bound: BoundExperiment
    rows: FloatArray
    bounds: FloatArray
    hooks: EffectHooks
    n_effect_states: int
    result: SimulationBatch
    stopped_at: FloatArray

    @classmethod
    def of(
        cls,
        batch: Batch,
        bound: BoundExperiment,
        values: FloatArray,
        hooks: EffectHooks,
        n_effect_states: int,
        bounds: FloatArray | None = None,
    ) -> _BatchRun:
        """Allocate the results of some points."""
        given = values.shape[1]
        rows = np.empty((len(values), given + len(bound.known_values)))
        rows[:, :given], rows[:, given:] = values, bound.known_values
        result = SimulationBatch.empty(
            len(rows), len(bound.integration_grid.times), len(bound.outputs)
        )
        bounds = np.full(len(rows), np.inf) if bounds is None else bounds
        ends = np.zeros(len(rows))
        return cls(batch, bound, rows, bounds, hooks, n_effect_states, result, ends)

    def arguments(
        self,
        points: slice,
        component: FmiComponent,
        settings: SolverSettings,
        work: KernelWorkspace,
    ) -> KernelArguments:
        """Return the arguments of the loop for some of the points."""
        if (fixed := self.bound.communication) is not None:
            settings = settings._replace(step=fixed.max_step, fixed=fixed.step)
        return KernelArguments(
            component,
            self.bound.references,
            self.bound.starts,
            settings,
            self.hooks._replace(
                fastest_rates=self.hooks.fastest_rates[points],
                coefficients=self.hooks.coefficients[points],
                base_parameters=self.hooks.base_parameters[points],
            ),
            self.bound.integration_grid,
            self.rows[points],
            self.bounds[points],
            work,
            self.result.outputs[points],
            self.result.codes[points],
            self.stopped_at[points],
            self.result.steps[points],
        )


class FmuIntegrator:
    """One instance of an FMU, and the solver's loop that simulates experiments with it.

    It must be loaded before it can simulate anything.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    progress
        Progress that the loop notes; see `workers.messages.types`.
    """

    instance: FmuInstance

    def __init__(
        self, model: Model, description: ModelDescription, progress: IntArray | None = None
    ) -> None:
        self._model, self._description = model, description
        name = model.solver.name
        self.batch: Batch = CvodeBatch() if name == "cvode" else BATCHES[name]
        self._checks_jacobian = name == "cvode" and _may_use_jacobian(model, description)
        self._has_started = False
        self._workspaces: dict[tuple[int, ...], KernelWorkspace] = {}
        self._settings: dict[int, SolverSettings] = {}
        self._progress = no_watcher() if progress is None else progress
        self._largest_array = max((v.size for v in description.variables.values()), default=1)

    def load(self, instance: FmuInstance | None = None) -> None:
        """Load the FMU and instantiate it, unless another's instance is to be used.

        Raises
        ------
        ModelError
            If that does not work on this machine.
        """
        self.instance = (
            FmuInstance(self._model, self._description) if instance is None else instance
        )

    def warm_up(self, bound: BoundExperiment) -> None:
        """Compile the loop, or read it from disk, before there is an FMU to run it on."""
        nothing = np.empty((0, len(self._model.parameters)))
        run = _BatchRun.of(self.batch, bound, nothing, no_hooks(0), 0)
        self._simulate(run, nothing_loaded(self._description.version), slice(0))

    def run(
        self,
        bound: BoundExperiment,
        values: FloatArray,
        hooks: EffectHooks,
        n_effect_states: int = 0,
        batch: Batch | None = None,
        bounds: FloatArray | None = None,
    ) -> SimulationBatch:
        """Simulate an experiment for many points.

        Parameters
        ----------
        bound
            The experiment.
        values
            A row for each point: values of the model's parameters.
        hooks, n_effect_states
            The effects that act, and the number of their own states.
        batch
            Simulates in place of the solver.
        bounds : (points,)
            Sums of squared residuals above which simulations end early; none if None.
        """
        batch = self.batch if batch is None else batch
        run = _BatchRun.of(batch, bound, values, hooks, n_effect_states, bounds)
        point = 0
        while point < len(run.rows):
            point = self._simulate_from(run, point)
        if bound.communication is not None:
            return replace(run.result, outputs=bound.communication.interpolate(run.result.outputs))
        return run.result

    def starts(self, instance: FmuInstance, bound: BoundExperiment, point: FloatArray) -> bool:
        """Start a new instance, which can be reset from then on; False if that does not work."""
        started = self._starts(instance, self._told(instance.begin()), bound, point)
        return started or self._lacked_stop_time(instance, bound, point)

    def _starts(
        self,
        instance: FmuInstance,
        component: FmiComponent,
        bound: BoundExperiment,
        point: FloatArray,
    ) -> bool:
        start_alone = replace(bound, grid=bound.grid._replace(times=bound.grid.times[:1]))
        run = _BatchRun.of(self.batch, start_alone, point[None], no_hooks(1), 0)
        self._simulate(run, component, slice(1))
        code = int(run.result.codes[0])
        if code >= failure.FATAL:
            instance.replace()
        return code == failure.FINISHED

    def _lacked_stop_time(
        self, instance: FmuInstance, bound: BoundExperiment, point: FloatArray
    ) -> bool:
        """Return whether a start that failed works with a stop time, which is told from then on.

        What was told before is tried once more, because some FMUs fail by chance.
        """
        before = self._stop_unit
        if self._model.stop_time is False:
            return False
        for unit in dict.fromkeys((before, *STOP_UNITS)):
            try:
                component = instance.begin_anew()._replace(stop_unit=unit)
                started = self._starts(instance, component, bound, point)
            except ModelError:  # there is no other instance to be had
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

    def _told(self, component: FmiComponent) -> FmiComponent:
        """Return an instance that is told the stop time if the FMU needs it."""
        return component._replace(stop_unit=self._stop_unit)

    def find_jacobian(self, bound: BoundExperiment) -> None:
        """Let CVODE use the FMU's directional derivatives, if they are right at the start.

        That is at the FMU's own start values, so that all workers find the same, and in an instance
        of its own: the other one must be new when its first simulation begins.
        """
        if not self._checks_jacobian or not isinstance(self.batch, CvodeBatch):
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
        if found.error <= MAX_JACOBIAN_ERROR:  # zeros in place of derivatives are an error of 1
            self.batch.jacobian = jacobian

    def _instance_apart(self) -> FmuInstance:
        """Return another instance; where there is no seat for it, that of the worker goes before.

        The worker's is made again with the first simulation.

        Raises
        ------
        ModelError
            If no instance is to be had.
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
        """True once CVODE takes its Jacobian from the FMU; decided at the first simulation."""
        return isinstance(self.batch, CvodeBatch) and len(self.batch.jacobian.states) > 0

    def component(self) -> FmiComponent:
        """Return the instance for the next simulation."""
        anew = self._new_instance_each
        return self._told(self.instance.begin_anew() if anew else self.instance.begin())

    def settings(self, n_effect_states: int = 0) -> SolverSettings:
        """Return the solver settings, with tolerances of the effects' states."""
        if n_effect_states not in self._settings:
            self._settings[n_effect_states] = self._make_settings(n_effect_states)
        return self._settings[n_effect_states]

    def _make_settings(self, n_effect_states: int) -> SolverSettings:
        solver = self._model.solver
        rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
        atol = rtol if solver.atol is None else solver.atol
        nominals = [self._description.variables[name].nominal for name in self._description.states]
        nominals += [1.0] * n_effect_states
        return SolverSettings(
            step=solver.step or 0.0,
            rtol=rtol,
            atol=atol,
            atols=np.maximum(atol * np.array(nominals, np.float64), np.finfo(np.float64).tiny),
            max_steps=solver.max_steps,
            fmu_tolerance=solver.rtol or 0.0,
        )

    def workspace(
        self, bound: BoundExperiment, hooks: EffectHooks, n_effect_states: int = 0
    ) -> KernelWorkspace:
        states = n_effect_states
        if self._model.interface == "model_exchange":
            states += len(self._description.states)
        sizes = (
            bound.grid.inputs.shape[1],
            states,
            hooks.coefficients.shape[1],
            hooks.base_parameters.shape[1],
            self._description.event_indicators,
            self._largest_array,
        )
        if sizes not in self._workspaces:
            self._workspaces[sizes] = workspace(*sizes, self._progress)
        return self._workspaces[sizes]

    @property
    def _new_instance_each(self) -> bool:
        """True if each simulation has an instance of its own."""
        return self._model.reset in ("instance", "process")

    def _simulate_from(self, run: _BatchRun, first: int) -> int:
        """Simulate points from the first to one that fails; returns the next one to simulate."""
        self.instance.log.clear()
        alone = self._new_instance_each or self.instance.is_new
        try:
            component = self.component()
        except ModelError as error:
            run.result.codes[first] = failure.INITIALISATION
            run.result.messages[first] = str(error)
            return first + 1
        points = slice(first, first + 1 if alone else None)
        following = first + self._simulate(run, component, points)
        last = following - 1
        code = int(run.result.codes[last])
        if code == failure.FINISHED:
            self._has_started = True
            return following
        if code == failure.DISCARDED and (end := self.instance.termination_time()) is not None:
            run.result.codes[last] = code = failure.TERMINATED
            run.stopped_at[last] = max(run.stopped_at[last], end)
        if last > first and self.instance.log and code != failure.ENDED_EARLY:
            following = last  # again, alone: its neighbours may have said some of this
        else:
            run.result.messages[last] = self._explain(code, float(run.stopped_at[last]))
        if code >= failure.FATAL:
            self.instance.replace()
        if code % failure.FATAL != failure.INITIALISATION:
            self._has_started = True
        elif not self._has_started and following > last:
            values = run.rows[last, : len(self._model.parameters)]
            if self._lacked_stop_time(self.instance, run.bound, values):
                run.result.messages[last], following = "", last
        return following

    def _simulate(self, run: _BatchRun, component: FmiComponent, points: slice) -> int:
        """Simulate points, up to one that fails; returns how many."""
        settings = self.settings(run.n_effect_states)
        work = self.workspace(run.bound, run.hooks, run.n_effect_states)
        process = os.getpid()
        try:
            with kept_signal_handlers():
                return run.batch(run.arguments(points, component, settings, work))
        finally:
            if os.getpid() != process:  # the FMU has copied it: who answers already is enough
                os._exit(0)
            self._progress[RUNNING] = 0

    def _explain(self, code: int, time: float) -> str:
        log = " | ".join(dict.fromkeys(self.instance.log)) if code != failure.ENDED_EARLY else ""
        messages = failure.MESSAGES | linearise.MESSAGES
        message = f"{messages[code % failure.FATAL]} at t = {time:.9g} s"
        if code in failure.SUGGEST_STIFFNESS and self._model.solver.name == "dormand_prince":
            message += '; if the model is stiff, model.solver = "cvode" goes on in long steps'
        return f"{message}; it said: {log}" if log else message


def _may_use_jacobian(model: Model, description: ModelDescription) -> bool:
    """Return whether an FMU offers it, and may be started once only to check it."""
    offered = description.offer(model.interface).provides_directional_derivatives
    new_process = model.reset == "process"
    return offered and not new_process and len(directional_jacobian(description).states) > 0
