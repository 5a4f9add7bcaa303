"""Linearisation of a model along one simulation, and the extended Kalman filter that rests on it.

Arguments and results of the compiled loops are prepared here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from workers.effects.definition import EffectDefinition, define
from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.grid import SignalGrid
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.component import FmiComponent
from workers.kernels.fmi.failure import FINISHED, INITIALISATION
from workers.kernels.fmi.hooks import EffectHooks
from workers.kernels.kalman import KalmanArrays, filter_states
from workers.kernels.linearise import (
    ADAPTIVE,
    FIXED,
    PRECOMPUTED,
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
    MatrixSeries,
    Model,
)
from workers.simulation.bind_effects import BoundEffects, bind_effects
from workers.simulation.bind_experiment import BoundExperiment, bind_experiment


@dataclass(frozen=True)
class PreparedExperiment:
    """An experiment with the effects that act on it, ready to be linearised.

    Attributes
    ----------
    effects, with_offsets
        The effects, and the same with an offset at each input: a coefficient, 0 in the simulation,
        that is added behind all effects. None where nothing acts while the simulation runs; the
        inputs themselves are perturbed then.
    n_coefficients
        Coefficients of the task, after which those of the offsets follow.
    """

    model: Model
    description: ModelDescription
    effects: BoundEffects
    with_offsets: BoundEffects | None
    n_coefficients: int

    def at(
        self,
        point: FloatArray,
        component: Callable[[], FmiComponent],
        cvode: CvodeBatch | None = None,
    ) -> LinearisationPass:
        """Prepare the linearisation at one point: values of parameters, then coefficients.

        `component` gives the FMU for one more simulation; `cvode` is the solver, if the model names
        that one.
        """
        effects, count = self.effects, len(self.model.parameters)
        values, coefficients = point[None, :count], point[None, count:]
        experiment = (
            effects.with_memory_effects(coefficients[0])
            if effects.has_memory
            else effects.experiment
        )
        bound = bind_experiment(self.model, self.description, experiment, effects.recorded)
        offsets = np.zeros((1, len(self.inputs) if self.with_offsets else 0))
        with_zero_offsets = np.hstack([coefficients, offsets])
        hooks = effects.hooks(values, with_zero_offsets, self.model, self.description)
        with_offsets = hooks
        if self.with_offsets is not None:
            with_offsets = self.with_offsets.hooks(
                values, with_zero_offsets, self.model, self.description
            )
        perturbed = self._perturbed_variables(values[0])
        arrays = allocate(perturbed, len(bound.grid.times), len(bound.outputs))
        return LinearisationPass(
            self,
            bound,
            values,
            coefficients[0],
            hooks,
            with_offsets,
            perturbed,
            arrays,
            component,
            cvode,
        )

    @property
    def inputs(self) -> tuple[str, ...]:
        """The FMU's inputs, without the measured signals that may follow them on the grid."""
        return tuple(given.variable for given in self.effects.experiment.inputs)

    @property
    def effect_states(self) -> tuple[str, ...]:
        """Names of the effects' own states, in the order of the array of states."""
        inside = [d for d in self.effects.definitions if d.site.kind != "output"]
        return tuple(str(state) for d in inside for state in d.states)

    @property
    def tunable(self) -> tuple[str, ...]:
        """The parameters that may change while a simulation runs."""
        return tuple(n for n in self.model.parameters if self.description.variables[n].tunable)

    def _perturbed_variables(self, values: FloatArray) -> PerturbedVariables:
        known, inner = self.description.variables, self.effects.inner
        states: list[ModelVariable | None] = [known[name] for name in self.description.states]
        states += [None] * len(self.effect_states)
        effect_positions = inner.parameters if inner is not None else ()
        return PerturbedVariables(
            states=perturbation_range(states),
            inputs=perturbation_range([known[name] for name in self.inputs]),
            parameters=perturbation_range([known[name] for name in self.tunable]),
            references=np.array([known[name].reference for name in self.tunable], np.uint32),
            values=np.array([values[self.model.parameters.index(n)] for n in self.tunable]),
            effect_positions=np.array(
                [effect_positions.index(n) if n in effect_positions else -1 for n in self.tunable],
                np.int64,
            ),
            input_offsets=self.n_coefficients,
        )


@dataclass(frozen=True)
class LinearisationPass:
    """One point of a prepared experiment. Takes the place of a solver's batch function."""

    prepared: PreparedExperiment
    bound: BoundExperiment
    values: FloatArray
    coefficients: FloatArray
    hooks: EffectHooks
    with_offsets: EffectHooks
    perturbed: PerturbedVariables
    arrays: LinearisationArrays
    component: Callable[[], FmiComponent]
    cvode: CvodeBatch | None

    def __call__(self, arguments: KernelArguments) -> int:
        """Simulate one point. Always returns 1."""
        stepping = ADAPTIVE if self.prepared.model.solver.name == "dormand_prince" else FIXED
        if (
            self.cvode is not None
        ):  # it simulates first: nothing else may call the FMU during its steps
            stepping = PRECOMPUTED
            self.cvode(arguments, self.arrays.states)
            if arguments.codes[0] != FINISHED:
                return 1
            try:
                arguments = arguments._replace(c=self.component())
            except ModelError:
                arguments.codes[0] = INITIALISATION
                return 1
        arguments.codes[0], arguments.stopped_at[0] = linearise(
            stepping, *arguments[:5], self.with_offsets, arguments.grid, arguments.points[0],
            arguments.work, self.perturbed, self.arrays, arguments.outputs[0],
        )  # fmt: skip
        return 1

    def result(self, outputs: FloatArray, without_effects: BoundExperiment) -> Linearisation:
        """Return the linearisation at the times of the experiment's own grid.

        `outputs` are as recorded.
        """
        arrays, effects = self.arrays, self.prepared.effects
        kept = np.searchsorted(self.bound.grid.times, without_effects.grid.times)
        own = slice(len(without_effects.outputs))
        with_output_effects = outputs.copy()
        effects.apply_to_outputs(self.bound.grid, with_output_effects, self.coefficients)
        return Linearisation(
            times=without_effects.grid.times,
            states=arrays.states[kept],
            derivatives=arrays.derivatives[kept],
            inputs=self.bound.grid.inputs[kept, : len(self.prepared.inputs)],
            effective_inputs=arrays.effective_inputs[kept],
            outputs=with_output_effects[kept, own],
            plain_outputs=outputs[kept, own],
            A=MatrixSeries.of(arrays.A if len(kept) == len(arrays.A) else arrays.A[kept]),
            B=arrays.B[kept],
            C=arrays.C[kept, own],
            D=arrays.D[kept, own],
            P=arrays.P[kept],
            Q=arrays.Q[kept, own],
            state_names=(*self.prepared.description.states, *self.prepared.effect_states),
            input_names=self.prepared.inputs,
            output_names=without_effects.outputs,
            parameter_names=self.prepared.tunable,
        )


def prepare(
    model: Model,
    description: ModelDescription,
    experiment: Experiment,
    active: Sequence[tuple[EffectDefinition, int]],
    n_coefficients: int,
) -> PreparedExperiment:
    """Prepare an experiment to be linearised with the effects that act on it.

    Parameters
    ----------
    active
        Each effect that does something, with the position of its first coefficient.
    n_coefficients
        Number of coefficients of the task.
    """
    experiment = _with_all_inputs_driven(model, description, experiment)
    effects = bind_effects(active, experiment, description, model_exchange=True)
    with_offsets = None
    if effects.inner is not None:
        added = [
            (define(Effect(f":{name}", f"input {name}", "bias"), description, model.interface), at)
            for at, name in enumerate(
                (given.variable for given in effects.experiment.inputs), n_coefficients
            )
        ]
        with_offsets = bind_effects([*active, *added], experiment, description, model_exchange=True)
    return PreparedExperiment(model, description, effects, with_offsets, n_coefficients)


def _with_all_inputs_driven(
    model: Model, description: ModelDescription, experiment: Experiment
) -> Experiment:
    """Add a constant signal for each real input of the FMU that nothing sets.

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


def perturbation_range(variables: Sequence[ModelVariable | None]) -> PerturbationRange:
    """Nominal values and bounds; None stands for a state of an effect, which has neither."""
    return PerturbationRange(
        nominals=np.array([1.0 if v is None else v.nominal for v in variables]),
        lows=np.array([-np.inf if v is None or v.low is None else v.low for v in variables]),
        highs=np.array([np.inf if v is None or v.high is None else v.high for v in variables]),
    )


def allocate(perturbed: PerturbedVariables, n: int, outputs: int) -> LinearisationArrays:
    """Return arrays for the derivatives at n times."""
    states, inputs = len(perturbed.states.nominals), len(perturbed.inputs.nominals)
    parameters = len(perturbed.references)
    return LinearisationArrays(
        states=np.zeros((n, states)),
        derivatives=np.zeros((n, states)),
        effective_inputs=np.zeros((n, inputs)),
        A=np.zeros((n, states, states)),
        B=np.zeros((n, states, inputs)),
        P=np.zeros((n, states, parameters)),
        C=np.zeros((n, outputs, states)),
        D=np.zeros((n, outputs, inputs)),
        Q=np.zeros((n, outputs, parameters)),
        upper_derivatives=np.zeros(states),
        lower_derivatives=np.zeros(states),
        upper_outputs=np.zeros(outputs),
        lower_outputs=np.zeros(outputs),
        value=np.zeros(1),
    )


LEAST_SPREAD_FACTOR = 1e-6
"""Factor of the squares of residuals that a `log_spread` of another model leaves at least."""


@dataclass(frozen=True)
class FilterPass:
    """One point of an experiment. Takes the place of a solver's batch function.

    Attributes
    ----------
    offsets
        The effects with an offset at each input, where inputs are perturbed.
    log_spread
        See `Experiment`.
    """

    stepping: int
    perturbed: PerturbedVariables
    arrays: LinearisationArrays
    kalman: KalmanArrays
    offsets: EffectHooks | None = None
    log_spread: float = 0.0

    def __call__(self, arguments: KernelArguments) -> int:
        """Simulate one point. Always returns 1."""
        offsets = arguments.hooks if self.offsets is None else self.offsets
        arguments.codes[0], arguments.stopped_at[0] = filter_states(
            self.stepping, *arguments[:5], offsets, arguments.grid, arguments.points[0],
            arguments.work, self.perturbed, self.arrays, self.kalman, arguments.outputs[0],
        )  # fmt: skip
        return 1

    def total_log_spread(self, grid: SignalGrid) -> float:
        """Return the sum of log(S / sigma^2) over all measured values."""
        spreads = self.kalman.spreads.ravel()[grid.gather]
        return float(np.add.reduce(np.log(spreads / grid.sigmas**2)))

    def standardised(self, grid: SignalGrid) -> FloatArray:
        """Return (residuals,): innovations whose sum of squares is -2 log likelihood.

        Up to a constant that is e'e / S + log(S / sigma^2), summed over all values. The second part
        is not negative, as S is at least sigma^2; so the innovations over their spreads,
        r = e / sqrt(S), are lengthened until their squares have both:

            r sqrt(1 + sum log(S / sigma^2) / r'r).

        Records add up, whatever their lengths and times. Where the experiment has a `log_spread`,
        that is taken off the sum: near the model that it is of, the residuals are r itself, white
        and of variance 1.
        """
        spreads = self.kalman.spreads.ravel()[grid.gather]
        plain = self.kalman.innovations.ravel()[grid.gather] / np.sqrt(spreads)
        squares = float(np.add.reduce(plain * plain))
        if squares == 0.0:
            return np.asarray(plain)
        wider = max(self.total_log_spread(grid), 0.0) - self.log_spread
        return np.asarray(plain * np.sqrt(max(1.0 + wider / squares, LEAST_SPREAD_FACTOR)))


@dataclass(frozen=True)
class StateNoise:
    """White noise at the derivative of a state.

    Attributes
    ----------
    state
        Its name, that of an effect's own state among them.
    density
        q^2.
    variance
        Of the state at the start, besides: that of an Ornstein-Uhlenbeck process that has gone on
        for long.
    """

    state: str
    density: float
    variance: float = 0.0

    @classmethod
    def of(cls, definition: EffectDefinition, coefficients: FloatArray) -> StateNoise:
        """Return the noise of an effect, from where its coefficients begin."""
        density = float(coefficients[0]) ** 2
        if not definition.states:
            return cls(definition.site.target, density)
        return cls(str(definition.states[0]), density, 0.5 * density * float(coefficients[1]))


def prepare_filter(
    model: Model,
    description: ModelDescription,
    bound: BoundExperiment,
    states: Sequence[str],
    noise: Sequence[StateNoise],
    *,
    log_spread: float,
    linearised: LinearisationPass | None = None,
) -> FilterPass:
    """Prepare one point of an experiment.

    Parameters
    ----------
    model, description, bound
        The FMU and the experiment, with the effects that act on it.
    states
        Of the FMU, then the own ones of those effects.
    noise
        On some of them.
    log_spread
        Of the experiment.
    linearised
        The pass whose derivatives are to be taken along the filter; None for those that it needs.
    """
    grid, count = bound.grid, len(states)
    n, y = len(grid.times), len(bound.outputs)
    diffusion, covariance = np.zeros(count), np.zeros((count, count))
    for each in noise:
        state = states.index(each.state)
        diffusion[state] += each.density
        covariance[state, state] += each.variance
    measured, variances = np.full(n * y, np.nan), np.ones(n * y)
    measured[grid.gather] = grid.measured
    variances[grid.gather] = grid.sigmas**2
    square = (count, count)
    kalman = KalmanArrays(
        diffusion=diffusion,
        measured=measured.reshape(n, y),
        variances=variances.reshape(n, y),
        innovations=np.zeros((n, y)),
        spreads=np.ones((n, y)),
        covariance=covariance,
        transition=np.zeros(square),
        noise=np.zeros(square),
        product=np.zeros(square),
        other=np.zeros(square),
        change=np.zeros(count),
        gain=np.zeros(count),
    )
    stepping = ADAPTIVE if model.solver.name == "dormand_prince" else FIXED
    if linearised is not None:
        return FilterPass(
            stepping, linearised.perturbed, linearised.arrays, kalman, linearised.with_offsets,
            log_spread,
        )  # fmt: skip
    perturbed = _states_alone(description, count - len(description.states))
    arrays = allocate(perturbed, n, y)
    return FilterPass(stepping, perturbed, arrays, kalman, log_spread=log_spread)


def _states_alone(description: ModelDescription, n_effect_states: int) -> PerturbedVariables:
    """Return what is perturbed for the derivatives by the states, those of effects behind."""
    known = [description.variables[name] for name in description.states]
    nothing = perturbation_range([])
    return PerturbedVariables(
        states=perturbation_range([*known, *[None] * n_effect_states]),
        inputs=nothing,
        parameters=nothing,
        references=np.zeros(0, np.uint32),
        values=np.zeros(0),
        effect_positions=np.zeros(0, np.int64),
        input_offsets=0,
    )
