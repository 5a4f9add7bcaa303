"""An instance of an FMU and the compiled loop that simulates it: rows of values in, outputs out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.instance import FmuInstance
from workers.kernels import linearise
from workers.kernels.fmi import failure
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import FmiComponent, KernelWorkspace, nothing_loaded, workspace
from workers.kernels.fmi.hooks import EffectHooks, no_hooks
from workers.kernels.fmi.initialise import SolverSettings
from workers.kernels.fmi.progress import RUNNING, no_watcher
from workers.kernels.solvers.co_simulation import co_simulate_batch
from workers.kernels.solvers.cvode import CvodeBatch
from workers.kernels.solvers.dormand_prince import dormand_prince_batch
from workers.kernels.solvers.rk4 import rk4_batch
from workers.messages import FloatArray, IntArray, Linearisation, Model
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.jacobian import AGREES, compare, named

Batch = Callable[[KernelArguments], int]
"""Simulates many points and returns how many of them: up to the first that failed."""
BATCHES: dict[str, Batch] = {
    "fmu": lambda asked: int(co_simulate_batch(*asked)),
    "rk4": lambda asked: int(rk4_batch(*asked)),
    "dormand_prince": lambda asked: int(dormand_prince_batch(*asked)),
}

DEFAULT_RTOL = 1e-8
"""Of Dormand-Prince: on sampled inputs its steps are short anyhow, so accuracy costs little."""


@dataclass(frozen=True)
class SimulationBatch:
    """What a batch of simulations gave.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty where a simulation reached its end, else a sentence.
    codes : (points,)
        See `workers.kernels.fmi.failure`.
    linearisations
        By point, where that was asked for and the simulation reached its end.
    slopes
        (parameters, times, outputs) by point, where sensitivities were asked for and to be had;
        NaN for parameters by which there are none.
    """

    outputs: FloatArray
    messages: list[str]
    codes: IntArray
    linearisations: dict[int, Linearisation] = field(default_factory=dict)
    slopes: dict[int, FloatArray] = field(default_factory=dict)

    @classmethod
    def empty(cls, points: int, times: int, outputs: int) -> SimulationBatch:
        """Nothing simulated yet."""
        return cls(
            np.full((points, times, outputs), np.nan), [""] * points, np.zeros(points, np.int64)
        )


class FmuIntegrator:
    """One instance of an FMU, and the solver's loop that takes it along an experiment.

    It must be loaded before it can simulate anything.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    progress
        Counters that the loop advances; see `workers.kernels.fmi.progress`.
    """

    instance: FmuInstance

    def __init__(
        self, model: Model, description: ModelDescription, progress: IntArray | None = None
    ) -> None:
        self._model, self._description = model, description
        name = model.solver.name
        self.batch: Batch = CvodeBatch() if name == "cvode" else BATCHES[name]
        self._asks_for_jacobian = name == "cvode" and _may_give_jacobian(model, description)
        self._workspaces: dict[tuple[int, ...], KernelWorkspace] = {}
        self._progress = no_watcher() if progress is None else progress
        self._widest = max((v.size for v in description.variables.values()), default=1)

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

    def warm_up(self, ready: BoundExperiment) -> None:
        """Have the loop compiled, or read from disk, before there is an FMU to run it on."""
        rows = np.empty((0, len(self._model.parameters) + len(ready.known)))
        sizes = len(ready.grid.times), len(ready.outputs)
        nowhere, record = (
            nothing_loaded(self._description.version),
            SimulationBatch.empty(0, *sizes),
        )
        self._call(self.batch, nowhere, ready, no_hooks(0), 0, rows, record, np.empty(0))

    def run(
        self,
        ready: BoundExperiment,
        values: FloatArray,
        hooks: EffectHooks,
        own_states: int = 0,
        batch: Batch | None = None,
    ) -> SimulationBatch:
        """Simulate an experiment for many points.

        Parameters
        ----------
        ready
            The experiment.
        values
            A row for each point: values of the model's parameters.
        hooks, own_states
            The effects that act, which have so many states of their own.
        batch
            What simulates, in place of the solver.
        """
        known = np.broadcast_to(ready.known, (len(values), len(ready.known)))
        # hstack keeps columns together if its parts do; the loops need rows
        rows = np.ascontiguousarray(np.hstack([values, known]))
        record = SimulationBatch.empty(len(rows), len(ready.running.times), len(ready.outputs))
        stopped_at = np.zeros(len(rows))
        batch = self.batch if batch is None else batch
        tried = 0
        while tried < len(rows):
            self.instance.log.clear()
            first = tried
            try:
                component = self.component()
            except ModelError as error:
                record.codes[first], record.messages[first] = failure.INITIALISATION, str(error)
                tried += 1
                continue
            tried += self._call(
                batch,
                component,
                ready,
                hooks,
                own_states,
                rows,
                record,
                stopped_at,
                first,
            )
            last = tried - 1
            code = int(record.codes[last])
            if code == failure.FINISHED:
                continue
            if code == failure.DISCARDED and (end := self.instance.ended_at()) is not None:
                record.codes[last] = code = failure.TERMINATED
                stopped_at[last] = max(stopped_at[last], end)
            if last > first and self.instance.log:
                tried = last  # again, alone: its neighbours may have said some of this
            else:
                record.messages[last] = self._explain(code, float(stopped_at[last]))
            if code >= failure.FATAL:
                self.instance.renew()
        if ready.communication is not None:
            record = replace(record, outputs=ready.communication.read(record.outputs))
        return record

    def find_jacobian(self, ready: BoundExperiment) -> None:
        """Let CVODE have the FMU's directional derivatives, if they are right where it starts.

        That is at the FMU's own start values, so that all workers find the same.
        """
        if not self._asks_for_jacobian or not isinstance(self.batch, CvodeBatch):
            return
        self._asks_for_jacobian = False
        known = self._description.variables
        start = replace(ready, grid=ready.grid._replace(times=ready.grid.times[:1]))
        values = np.array([[known[name].start or 0.0 for name in self._model.parameters]])
        if self.run(start, values, no_hooks(1)).codes[0] != failure.FINISHED:
            return
        jacobian = named(self._description)
        try:
            found = compare(self.instance.fmu, self._description.version, jacobian)
        except ModelError:
            return
        if found.error <= AGREES:  # zeros in the place of slopes are an error of 1
            self.batch.jacobian = jacobian

    @property
    def gives_jacobian(self) -> bool:
        """Whether CVODE takes its Jacobian from the FMU, as far as it has simulated anything."""
        return isinstance(self.batch, CvodeBatch) and len(self.batch.jacobian.states) > 0

    def component(self) -> FmiComponent:
        """What the next simulation runs on."""
        return self.instance.fresh() if self._renews else self.instance.component

    def settings(self, own_states: int = 0) -> SolverSettings:
        """What the loop is told about accuracy, with states of effects."""
        solver = self._model.solver
        rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
        atol = rtol if solver.atol is None else solver.atol
        nominals = [self._description.variables[name].nominal for name in self._description.states]
        nominals += [1.0] * own_states
        return SolverSettings(
            step=solver.step or 0.0,
            rtol=rtol,
            atol=atol,
            atols=np.maximum(atol * np.array(nominals, np.float64), np.finfo(np.float64).tiny),
            max_steps=solver.max_steps,
            fmu_tolerance=solver.rtol or 0.0,
        )

    def workspace(
        self, ready: BoundExperiment, hooks: EffectHooks, own_states: int = 0
    ) -> KernelWorkspace:
        states = own_states
        if self._model.interface == "model_exchange":
            states += len(self._description.states)
        sizes = (
            ready.grid.inputs.shape[1],
            states,
            hooks.coefficients.shape[1],
            hooks.base.shape[1],
            self._description.event_indicators,
            self._widest,
        )
        if sizes not in self._workspaces:
            self._workspaces[sizes] = workspace(*sizes, self._progress)
        return self._workspaces[sizes]

    @property
    def _renews(self) -> bool:
        """Whether each simulation has an instance of its own."""
        return self._model.renew in ("instance", "process")

    def _call(
        self,
        batch: Batch,
        component: FmiComponent,
        ready: BoundExperiment,
        hooks: EffectHooks,
        own_states: int,
        rows: FloatArray,
        record: SimulationBatch,
        stopped_at: FloatArray,
        first: int = 0,
    ) -> int:
        """Simulate rows from the first to one that fails; how many."""
        left = slice(first, first + 1 if self._renews else None)
        rest = hooks._replace(
            substeps=hooks.substeps[left],
            coefficients=hooks.coefficients[left],
            base=hooks.base[left],
        )
        settings = self.settings(own_states)
        if (fixed := ready.communication) is not None:
            settings = settings._replace(step=fixed.longest, fixed=fixed.step)
        asked = KernelArguments(
            component,
            ready.references,
            ready.starts,
            settings,
            rest,
            ready.running,
            rows[left],
            self.workspace(ready, hooks, own_states),
            record.outputs[left],
            record.codes[left],
            stopped_at[left],
        )
        try:
            return batch(asked)
        finally:
            self._progress[RUNNING] = 0

    def _explain(self, code: int, time: float) -> str:
        said = " | ".join(dict.fromkeys(self.instance.log))
        sentences = failure.SENTENCES | linearise.SENTENCES
        sentence = f"{sentences[code % failure.FATAL]} at t = {time:.9g} s"
        if code in failure.OF_STIFFNESS and self._model.solver.name == "dormand_prince":
            sentence += '; if the model is stiff, model.solver = "cvode" goes on in long steps'
        return f"{sentence}; it said: {said}" if said else sentence


def _may_give_jacobian(model: Model, description: ModelDescription) -> bool:
    """Whether an FMU offers it, and may be started only to be asked whether it is right."""
    offered = description.offer(model.interface).provides_directional_derivatives
    renewed = model.renew == "process"
    return offered and not renewed and len(named(description).states) > 0
