"""Model and experiment in, outputs at every time of the grid out: many points in one call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import typeof

from workers.description import Description
from workers.errors import ModelError
from workers.fmu import Instance
from workers.install import Installed, install
from workers.jacobian import AGREES, compare, named
from workers.kernels import failure, linearise
from workers.kernels.co_simulation import co_simulate_batch
from workers.kernels.component import Component, Workspace, nothing_loaded, workspace
from workers.kernels.cvode import CvodeBatch
from workers.kernels.dormand_prince import dormand_prince_batch
from workers.kernels.hooks import Hooks, no_hooks
from workers.kernels.initialise import Settings
from workers.kernels.rk4 import rk4_batch
from workers.kernels.stiffness import stiffness
from workers.messages import Effect, Experiment, FloatArray, Input, IntArray, Linearisation, Model
from workers.sensitivities import Sensing

if TYPE_CHECKING:
    from workers.augment import Augmentation, Effects
    from workers.effects.definition import Definition
    from workers.linearise import Prepared

BATCHES = {"fmu": co_simulate_batch, "rk4": rk4_batch, "dormand_prince": dormand_prince_batch}

DEFAULT_RTOL = 1e-8
"""Of Dormand-Prince: on sampled inputs its steps are short anyhow, so accuracy costs little."""


@dataclass(frozen=True)
class Record:
    """What a batch of simulations gave.

    Attributes
    ----------
    outputs : (points, times, outputs)
    messages : (points,)
        Empty where a simulation reached its end, else a sentence.
    codes : (points,)
        See `workers.kernels.failure`.
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
    def empty(cls, points: int, times: int, outputs: int) -> Record:
        """Nothing simulated yet."""
        return cls(
            np.full((points, times, outputs), np.nan), [""] * points, np.zeros(points, np.int64)
        )


class Simulator:
    """One instance of an FMU and the experiments that it can be asked to simulate.

    It must be loaded before it can be asked anything.

    Parameters
    ----------
    model, description
        The FMU; the description must be of the same archive.
    experiments
        What `run` counts by index.

    Raises
    ------
    ModelError
        If the FMU lacks a variable that an experiment or the model names.
    """

    instance: Instance

    def __init__(
        self, model: Model, description: Description, experiments: tuple[Experiment, ...]
    ) -> None:
        self._model, self._description = model, description
        self._experiments = tuple(_moving_first(description, e) for e in experiments)
        plain = [
            replace(e, signals=()) for e in self._experiments
        ]  # they act through effects alone
        self._installed = [install(model, description, e) for e in plain]
        self._signals = tuple(dict.fromkeys(s.variable for e in experiments for s in e.signals))
        self._effects: dict[tuple[Effect, ...], Effects] = {}
        self._augmented: dict[
            tuple[int, tuple[tuple[Definition, int], ...]], tuple[Augmentation, Installed]
        ] = {}
        self._prepared: dict[tuple[int, tuple[tuple[Definition, int], ...], int], Prepared] = {}
        name = model.solver.name
        self._batch = CvodeBatch() if name == "cvode" else BATCHES[name]
        self._asks_for_jacobian = name == "cvode" and _may_give_jacobian(model, description)
        self._workspaces: dict[tuple[int, ...], Workspace] = {}
        self._widest = max((v.size for v in description.variables.values()), default=1)
        self._sensing = Sensing(model, description)

    def load(self) -> None:
        """Load the FMU and instantiate it.

        Raises
        ------
        ModelError
            If that does not work on this machine.
        """
        self.instance = Instance(self._model, self._description)

    def warm_up(self) -> None:
        """Have the loops compiled, or read from disk, before there is an FMU to run them on."""
        ready = self._installed[0]
        rows = np.empty((0, len(self._model.parameters) + len(ready.known)))
        sizes = len(ready.grid.times), len(ready.outputs)
        nowhere, record = nothing_loaded(self._description.version), Record.empty(0, *sizes)
        self._call(self._batch, nowhere, ready, no_hooks(0), 0, rows, record, np.empty(0))

    def installed(self, experiment: int) -> Installed:
        return self._installed[experiment]

    def run(self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()) -> Record:
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
        self._find_jacobian()
        ready = self._installed[experiment]
        count = len(self._model.parameters)
        values, coefficients = points[:, :count], points[:, count:]
        if not effects:
            return self._run(ready, values, no_hooks(len(points)), 0)
        record = Record.empty(len(points), len(ready.grid.times), len(ready.outputs))
        for rows, active in self._resolved(effects).groups(coefficients):
            part = self._run_augmented(experiment, values[rows], coefficients[rows], active)
            record.outputs[rows], record.codes[rows] = part.outputs, part.codes
            for row, message in zip(rows.tolist(), part.messages, strict=True):
                record.messages[row] = message
        return record

    def linearise(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> Record:
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
        cvode = self._batch if isinstance(self._batch, CvodeBatch) else None
        if cvode is not None and self._description.event_indicators > 0:
            raise ModelError(
                f"{self._model.name}: has events, across which solver cvode cannot be linearised; "
                'set model.solver to "dormand_prince" or "rk4"'
            )
        plain = self._installed[experiment]
        record = Record.empty(len(points), len(plain.grid.times), len(plain.outputs))
        for p, point in enumerate(points):
            prepared = self._prepare(experiment, point, effects)
            made = prepared.at(point, cvode)
            own = len(prepared.own_states)
            part = self._run(made.ready, made.values, made.hooks, own, made)
            record.codes[p], record.messages[p] = part.codes[0], part.messages[0]
            if part.codes[0] == failure.FINISHED:
                record.linearisations[p] = made.result(part.outputs[0], plain)
                record.outputs[p] = record.linearisations[p].outputs
        return record

    def sensitivities(
        self, experiment: int, points: FloatArray, effects: tuple[Effect, ...] = ()
    ) -> Record:
        """Do as `run` does, and take the outputs' derivatives by the parameters along.

        A point without them has a message that says why, though its simulation may have reached its
        end.
        """
        ready = self._installed[experiment]
        record = Record.empty(len(points), len(ready.grid.times), len(ready.outputs))
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

    def _sense(self, ready: Installed, point: FloatArray) -> tuple[Record | None, str]:
        """One simulation with sensitivities, or why there are none."""
        why = self._sensing.why_not(ready)
        if why:
            return None, why
        row = np.concatenate([point, ready.known])
        kinds = self._sensing.find_kinds(
            self.instance, ready, _settings(self._model, self._description, 0), no_hooks(1), row,
            self._workspace(ready, no_hooks(1), 0),
        )  # fmt: skip
        if isinstance(kinds, str):
            return None, kinds
        along = self._sensing.along(ready, point, kinds, self.instance.component.handle)
        part = self._run(ready, point[None], no_hooks(1), 0, along)
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

    def _of_stiffness(self, experiment: int, point: FloatArray, max_steps: int) -> tuple[Any, ...]:
        ready, hooks = self._installed[experiment], no_hooks(1)
        return (
            self._component(),
            ready.references,
            ready.starts,
            _settings(self._model, self._description, 0)._replace(max_steps=max_steps),
            hooks,
            ready.grid,
            np.concatenate([point, ready.known]),
            self._workspace(ready, hooks, 0),
        )

    def close(self) -> None:
        self._sensing.close()
        self.instance.free()

    @property
    def gives_jacobian(self) -> bool:
        """Whether CVODE takes its Jacobian from the FMU, as far as it has simulated anything."""
        return isinstance(self._batch, CvodeBatch) and len(self._batch.jacobian.states) > 0

    def _find_jacobian(self) -> None:
        """Let CVODE have the FMU's directional derivatives, if they are right where it starts.

        That is at the FMU's own start values, so that all workers find the same.
        """
        if not self._asks_for_jacobian or not isinstance(self._batch, CvodeBatch):
            return
        self._asks_for_jacobian = False
        ready, known = self._installed[0], self._description.variables
        start = replace(ready, grid=ready.grid._replace(times=ready.grid.times[:1]))
        values = np.array([[known[name].start or 0.0 for name in self._model.parameters]])
        if self._run(start, values, no_hooks(1), 0).codes[0] != failure.FINISHED:
            return
        jacobian = named(self._description)
        try:
            found = compare(self.instance.fmu, self._description.version, jacobian)
        except ModelError:
            return
        if found.error <= AGREES and not found.zero:
            self._batch.jacobian = jacobian

    def _resolved(self, effects: tuple[Effect, ...]) -> Effects:
        from workers.augment import Effects  # SymPy takes half a second to import

        if effects not in self._effects:
            self._effects[effects] = Effects(effects, self._description, self._model, self._signals)
        return self._effects[effects]

    def _prepare(self, experiment: int, point: FloatArray, effects: tuple[Effect, ...]) -> Prepared:
        """Prepare an experiment to be linearised with the effects that act at a point, once."""
        from workers.linearise import prepare

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
        active: list[tuple[Definition, int]],
    ) -> Record:
        """A group of points on which the same effects act."""
        plain = self._installed[experiment]
        if not active:
            return self._run(plain, values, no_hooks(len(values)), 0)
        augmentation, ready = self._augment(experiment, active)
        own = augmentation.inner.own_states if augmentation.inner is not None else 0
        record = Record.empty(len(values), len(plain.grid.times), len(plain.outputs))
        chunks = [slice(p, p + 1) for p in range(len(values))]
        for chunk in chunks if augmentation.remembers else [slice(None)]:
            if augmentation.remembers:
                changed = augmentation.remembered(coefficients[chunk][0])
                ready = install(self._model, self._description, changed, augmentation.recorded)
            hooks = augmentation.hooks(
                ready.running, values[chunk], coefficients[chunk], self._model, self._description
            )
            part = self._run(ready, values[chunk], hooks, own)
            for p, outputs in enumerate(part.outputs):
                augmentation.act_on(ready.grid, outputs, coefficients[chunk][p])
            kept = np.searchsorted(ready.grid.times, plain.grid.times)
            record.outputs[chunk] = part.outputs[:, kept, : len(plain.outputs)]
            record.codes[chunk] = part.codes
            record.messages[chunk] = part.messages
        return record

    def _augment(
        self, experiment: int, active: list[tuple[Definition, int]]
    ) -> tuple[Augmentation, Installed]:
        """Prepare an experiment for the effects that act on it, once."""
        key = (experiment, tuple(active))
        if key not in self._augmented:
            from workers.augment import augment

            run = self._experiments[experiment]
            exchange = self._model.interface == "model_exchange"
            made = augment(active, run, self._description, exchange=exchange)
            ready = install(self._model, self._description, made.experiment, made.recorded)
            self._augmented[key] = made, ready
        return self._augmented[key]

    def _run(
        self,
        ready: Installed,
        values: FloatArray,
        hooks: Hooks,
        own_states: int,
        batch: Callable[..., int] | None = None,
    ) -> Record:
        known = np.broadcast_to(ready.known, (len(values), len(ready.known)))
        # hstack keeps columns together if its parts do; the loops need rows
        rows = np.ascontiguousarray(np.hstack([values, known]))
        record = Record.empty(len(rows), len(ready.running.times), len(ready.outputs))
        stopped_at = np.zeros(len(rows))
        batch = self._batch if batch is None else batch
        tried = 0
        while tried < len(rows):
            self.instance.log.clear()
            first = tried
            try:
                component = self._component()
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

    @property
    def _renews(self) -> bool:
        """Whether each simulation has an instance of its own."""
        return self._model.renew in ("instance", "process")

    def _component(self) -> Component:
        """What the next simulation runs on."""
        return self.instance.fresh() if self._renews else self.instance.component

    def _call(
        self,
        batch: Callable[..., int],
        component: Component,
        ready: Installed,
        hooks: Hooks,
        own_states: int,
        rows: FloatArray,
        record: Record,
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
        settings = _settings(self._model, self._description, own_states)
        if (fixed := ready.communication) is not None:
            settings = settings._replace(step=fixed.longest, fixed=fixed.step)
        return batch(
            component,
            ready.references,
            ready.starts,
            settings,
            rest,
            ready.running,
            rows[left],
            self._workspace(ready, hooks, own_states),
            record.outputs[left],
            record.codes[left],
            stopped_at[left],
        )

    def _workspace(self, ready: Installed, hooks: Hooks, own_states: int) -> Workspace:
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
            self._workspaces[sizes] = workspace(*sizes)
        return self._workspaces[sizes]

    def _explain(self, code: int, time: float) -> str:
        said = " | ".join(dict.fromkeys(self.instance.log))
        sentences = failure.SENTENCES | linearise.SENTENCES
        sentence = f"{sentences[code % failure.FATAL]} at t = {time:.9g} s"
        if code in failure.OF_STIFFNESS and self._model.solver.name == "dormand_prince":
            sentence += '; if the model is stiff, model.solver = "cvode" goes on in long steps'
        return f"{sentence}; it said: {said}" if said else sentence


def _may_give_jacobian(model: Model, description: Description) -> bool:
    """Whether an FMU offers it, and may be started only to be asked whether it is right."""
    offered = description.offer(model.interface).provides_directional_derivatives
    renewed = model.renew == "process"
    return offered and not renewed and len(named(description).states) > 0


def _moving_first(description: Description, experiment: Experiment) -> Experiment:
    """The same with inputs that may move between events first: those are set together."""

    def is_discrete(given: Input) -> bool:
        variable = description.variables.get(given.variable)
        return variable is not None and not variable.moves

    return replace(experiment, inputs=tuple(sorted(experiment.inputs, key=is_discrete)))


def _settings(model: Model, description: Description, own_states: int) -> Settings:
    solver = model.solver
    rtol = DEFAULT_RTOL if solver.rtol is None else solver.rtol
    atol = rtol if solver.atol is None else solver.atol
    nominals = [description.variables[name].nominal for name in description.states]
    nominals += [1.0] * own_states
    return Settings(
        step=solver.step or 0.0,
        rtol=rtol,
        atol=atol,
        atols=np.maximum(atol * np.array(nominals, np.float64), np.finfo(np.float64).tiny),
        max_steps=solver.max_steps,
        fmu_tolerance=solver.rtol or 0.0,
    )
