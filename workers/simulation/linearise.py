"""One simulation and the model's derivatives along it: what the compiled loop needs and fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.effects.definition import EffectDefinition, define
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.failure import FINISHED
from workers.kernels.fmi.hooks import EffectHooks
from workers.kernels.linearise import (
    ADAPTIVE,
    FIXED,
    GIVEN,
    LinearisationArrays,
    PerturbationRange,
    PerturbedVariables,
    linearise,
)
from workers.kernels.solvers.cvode import CvodeBatch
from workers.messages import (
    Effect,
    Experiment,
    FloatArray,
    Input,
    Linearisation,
    Model,
)
from workers.simulation.bind_effects import BoundEffects, augment
from workers.simulation.bind_experiment import BoundExperiment, install


@dataclass(frozen=True)
class PreparedExperiment:
    """An experiment with the effects that act on it, ready to be linearised.

    Attributes
    ----------
    augmentation, probing
        The effects, and the same with a knob at each input: a coefficient, 0 in the simulation,
        that is added behind all effects. None where nothing acts while the simulation runs; the
        inputs themselves are changed then.
    knobs
        Where the knobs' coefficients begin.
    """

    model: Model
    description: ModelDescription
    augmentation: BoundEffects
    probing: BoundEffects | None
    knobs: int

    def at(self, point: FloatArray, cvode: CvodeBatch | None = None) -> LinearisationPass:
        """Make ready for one point: values of the model's parameters, then coefficients.

        `cvode` is the solver if that is the one.
        """
        made, count = self.augmentation, len(self.model.parameters)
        values, coefficients = point[None, :count], point[None, count:]
        run = made.remembered(coefficients[0]) if made.remembers else made.experiment
        ready = install(self.model, self.description, run, made.recorded)
        knobs = np.zeros((1, len(self.inputs) if self.probing else 0))
        widened = np.hstack([coefficients, knobs])
        hooks = made.hooks(ready.grid, values, widened, self.model, self.description)
        probing = hooks
        if self.probing is not None:
            probing = self.probing.hooks(ready.grid, values, widened, self.model, self.description)
        probe = self._probe(values[0])
        found = _allocate(probe, len(ready.grid.times), len(ready.outputs))
        return LinearisationPass(
            self, ready, values, coefficients[0], hooks, probing, probe, found, cvode
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """The FMU's inputs, without the measured signals that may follow them on the grid."""
        return tuple(given.variable for given in self.augmentation.experiment.inputs)

    @property
    def own_states(self) -> tuple[str, ...]:
        """Names of the states that effects bring along, in the order of the array of states."""
        inside = [d for d in self.augmentation.definitions if d.site.kind != "output"]
        return tuple(str(state) for d in inside for state in d.states)

    @property
    def tunable(self) -> tuple[str, ...]:
        """The parameters that may change while a simulation runs."""
        return tuple(n for n in self.model.parameters if self.description.variables[n].tunable)

    def _probe(self, values: FloatArray) -> PerturbedVariables:
        known, inner = self.description.variables, self.augmentation.inner
        states: list[ModelVariable | None] = [known[name] for name in self.description.states]
        states += [None] * len(self.own_states)
        varied = inner.parameters if inner is not None else ()
        return PerturbedVariables(
            states=_range(states),
            inputs=_range([known[name] for name in self.inputs]),
            parameters=_range([known[name] for name in self.tunable]),
            references=np.array([known[name].reference for name in self.tunable], np.uint32),
            values=np.array([values[self.model.parameters.index(n)] for n in self.tunable]),
            varied=np.array(
                [varied.index(n) if n in varied else -1 for n in self.tunable], np.int64
            ),
            knobs=self.knobs,
        )


@dataclass(frozen=True)
class LinearisationPass:
    """One point of a prepared experiment. Takes the place of a solver's batch function."""

    prepared: PreparedExperiment
    ready: BoundExperiment
    values: FloatArray
    coefficients: FloatArray
    hooks: EffectHooks
    probing: EffectHooks
    probe: PerturbedVariables
    found: LinearisationArrays
    cvode: CvodeBatch | None

    def __call__(self, asked: KernelArguments) -> int:
        """Simulate one point. Always returns 1."""
        way = ADAPTIVE if self.prepared.model.solver.name == "dormand_prince" else FIXED
        if self.cvode is not None:  # it goes ahead, because nobody may call the FMU in between
            way = GIVEN
            self.cvode(asked, self.found.states)
            if asked.codes[0] != FINISHED:
                return 1
        asked.codes[0], asked.stopped_at[0] = linearise(
            way, *asked[:5], self.probing, asked.grid, asked.points[0], asked.work, self.probe,
            self.found, asked.outputs[0],
        )  # fmt: skip
        return 1

    def result(self, outputs: FloatArray, plain: BoundExperiment) -> Linearisation:
        """What was found at the times of the experiment's own grid; `outputs` are as recorded."""
        found, made = self.found, self.prepared.augmentation
        kept = np.searchsorted(self.ready.grid.times, plain.grid.times)
        own = slice(len(plain.outputs))
        acted = outputs.copy()
        made.act_on(self.ready.grid, acted, self.coefficients)
        return Linearisation(
            times=plain.grid.times,
            states=found.states[kept],
            slopes=found.slopes[kept],
            inputs=self.ready.grid.inputs[kept, : len(self.prepared.inputs)],
            edited=found.edited[kept],
            outputs=acted[kept, own],
            plain_outputs=outputs[kept, own],
            A=found.slopes_by_state[kept],
            B=found.slopes_by_input[kept],
            C=found.outputs_by_state[kept, own],
            D=found.outputs_by_input[kept, own],
            P=found.slopes_by_parameter[kept],
            Q=found.outputs_by_parameter[kept, own],
            state_names=(*self.prepared.description.states, *self.prepared.own_states),
            input_names=self.prepared.inputs,
            output_names=plain.outputs,
            parameter_names=self.prepared.tunable,
        )


def prepare(
    model: Model,
    description: ModelDescription,
    experiment: Experiment,
    active: Sequence[tuple[EffectDefinition, int]],
    knobs: int,
) -> PreparedExperiment:
    """Prepare an experiment to be linearised with the effects that act on it.

    Parameters
    ----------
    active
        Each effect that does something, with the position of its first coefficient.
    knobs
        How many coefficients the task has.
    """
    run = _every_input_driven(model, description, experiment)
    made = augment(active, run, description, exchange=True)
    probing = None
    if made.inner is not None:
        added = [
            (define(_knob(name), description, model.interface), knobs + j)
            for j, name in enumerate(given.variable for given in made.experiment.inputs)
        ]
        probing = augment([*active, *added], run, description, exchange=True)
    return PreparedExperiment(model, description, made, probing, knobs)


def _knob(name: str) -> Effect:
    return Effect(f":{name}", f"input {name}", "bias")


def _every_input_driven(
    model: Model, description: ModelDescription, experiment: Experiment
) -> Experiment:
    """The experiment with a constant signal for each real input that nothing sets.

    The FMU would keep these at their start values by itself; here, they have derivatives.
    """
    given = {signal.variable for signal in experiment.inputs} | set(model.parameters)
    known = dict(experiment.values)
    ends = np.array([experiment.start, experiment.stop])
    added = []
    for variable in description.inputs():
        value = known.get(variable.name, variable.start)
        if variable.kind == "real" and variable.name not in given and value is not None:
            added.append(Input(variable.name, ends, np.full(2, float(value)), "hold"))
    return replace(experiment, inputs=(*experiment.inputs, *added))


def _range(variables: Sequence[ModelVariable | None]) -> PerturbationRange:
    """None stands for a state of an effect, which says nothing about its size."""
    return PerturbationRange(
        nominals=np.array([1.0 if v is None else v.nominal for v in variables]),
        lows=np.array([-np.inf if v is None or v.low is None else v.low for v in variables]),
        highs=np.array([np.inf if v is None or v.high is None else v.high for v in variables]),
    )


def _allocate(probe: PerturbedVariables, n: int, outputs: int) -> LinearisationArrays:
    states, inputs = len(probe.states.nominals), len(probe.inputs.nominals)
    parameters = len(probe.references)
    return LinearisationArrays(
        states=np.zeros((n, states)),
        slopes=np.zeros((n, states)),
        edited=np.zeros((n, inputs)),
        slopes_by_state=np.zeros((n, states, states)),
        slopes_by_input=np.zeros((n, states, inputs)),
        slopes_by_parameter=np.zeros((n, states, parameters)),
        outputs_by_state=np.zeros((n, outputs, states)),
        outputs_by_input=np.zeros((n, outputs, inputs)),
        outputs_by_parameter=np.zeros((n, outputs, parameters)),
        upper_slopes=np.zeros(states),
        lower_slopes=np.zeros(states),
        upper_outputs=np.zeros(outputs),
        lower_outputs=np.zeros(outputs),
        value=np.zeros(1),
    )
