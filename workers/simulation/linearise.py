"""Linearisation of a model along a simulation, and the extended Kalman filter based on it.

This module prepares the structures of the core and reads their results.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import addressof, c_int64
from dataclasses import dataclass, replace

import numpy as np

from workers.core import library
from workers.core.failure import FINISHED, INITIALISATION
from workers.core.library import METHODS, Batch, Effects, Fmu, Kalman, Range, core
from workers.effects.definition import EffectDefinition, define
from workers.errors import ModelError
from workers.fmu.description import ModelDescription
from workers.fmu.variable import ModelVariable
from workers.grid import SignalGrid
from workers.messages import (
    Effect,
    Experiment,
    FloatArray,
    Input,
    Linearisation,
    MatrixSeries,
    Model,
)
from workers.simulation.batch import CvodeLoop
from workers.simulation.bind_effects import BoundEffects, bind_effects
from workers.simulation.bind_experiment import BoundExperiment, bind_experiment


@dataclass(frozen=True)
class PreparedExperiment:
    """An experiment with its active effects, ready for linearisation.

    Attributes
    ----------
    effects, with_offsets
        The effects, and the effects with an additional offset at each input. An offset is a
        coefficient, 0 in the simulation, that is added after all effects. None if no effect acts
        during the simulation; then the inputs themselves are perturbed.
    n_coefficients
        Number of coefficients of the task; those of the offsets follow.
    """

    model: Model
    description: ModelDescription
    effects: BoundEffects
    with_offsets: BoundEffects | None
    n_coefficients: int

    def at(
        self,
        point: FloatArray,
        component: Callable[[], Fmu],
        cvode: CvodeLoop | None = None,
    ) -> LinearisationPass:
        """Prepare the linearisation at a point: values of parameters, then coefficients.

        `component` returns the FMU for another simulation; `cvode` is the loop if the solver is
        CVODE.
        """
        effects, count = self.effects, len(self.model.parameters)
        values, coefficients = point[None, :count], point[None, count:]
        experiment = (
            effects.with_memory_effects(coefficients[0])
            if effects.has_memory
            else effects.experiment
        )
        bound = bind_experiment(self.model, self.description, experiment, effects.recorded)
        acting = effects.at_points(values, coefficients, self.model, self.description)
        offsets = acting
        if self.with_offsets is not None:
            zeros = np.zeros((1, len(self.inputs)))
            offsets = self.with_offsets.at_points(
                values, np.hstack([coefficients, zeros]), self.model, self.description
            )
        asked = self._structure(values[0], len(bound.grid.times), len(bound.outputs))
        asked.offsets, asked.first_offset = addressof(offsets), self.n_coefficients
        asked.held["offsets"] = offsets
        return LinearisationPass(
            self, bound, values, coefficients[0], acting, asked, component, cvode
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

    def _structure(self, values: FloatArray, n: int, outputs: int) -> library.Linearisation:
        """Return the structure for the derivatives by all variables, at n times."""
        known, inner = self.description.variables, self.effects.inner
        changed = inner.parameters if inner is not None else ()
        tunable = [known[name] for name in self.tunable]
        asked = linearisation(
            self.model,
            [*(known[name] for name in self.description.states), *[None] * len(self.effect_states)],
            [known[name] for name in self.inputs],
            tunable,
            (n, outputs),
        )
        asked.hold(np.uint32, references=[v.reference for v in tunable])
        asked.hold(
            np.float64, values=[values[self.model.parameters.index(n)] for n in self.tunable]
        )
        positions = [changed.index(n) if n in changed else -1 for n in self.tunable]
        return asked.hold(np.int64, effect_positions=positions)


@dataclass(frozen=True)
class LinearisationPass:
    """One point of a prepared experiment, simulated with this object instead of the solver's loop.

    Attributes
    ----------
    effects
        The active effects.
    asked
        Perturbed variables, and arrays of the derivatives.
    """

    prepared: PreparedExperiment
    bound: BoundExperiment
    values: FloatArray
    coefficients: FloatArray
    effects: Effects
    asked: library.Linearisation
    component: Callable[[], Fmu]
    cvode: CvodeLoop | None

    def __call__(self, batch: Batch) -> int:
        """Simulate one point; always return 1."""
        fmu = None
        if self.cvode is not None:  # first, because nothing else may call the FMU during its steps
            batch.states_out = self.asked.x
            self.cvode(batch)
            code = c_int64.from_address(batch.codes)
            if code.value != FINISHED:
                return 1
            try:
                fmu = self.component()
            except ModelError:
                code.value = INITIALISATION
                return 1
            batch.fmu = addressof(fmu)
        core().core_linearise(addressof(batch), addressof(self.asked))
        return 1

    def result(self, outputs: FloatArray, without_effects: BoundExperiment) -> Linearisation:
        """Return the linearisation at the times of the experiment's own grid.

        `outputs` are the recorded outputs.
        """
        found, effects = self.asked.held, self.prepared.effects
        kept = np.searchsorted(self.bound.grid.times, without_effects.grid.times)
        own = slice(len(without_effects.outputs))
        with_output_effects = outputs.copy()
        effects.apply_to_outputs(self.bound.grid, with_output_effects, self.coefficients)
        return Linearisation(
            times=without_effects.grid.times,
            states=found["x"][kept],
            derivatives=found["dx"][kept],
            inputs=self.bound.grid.inputs[kept, : len(self.prepared.inputs)],
            effective_inputs=found["effective"][kept],
            outputs=with_output_effects[kept, own],
            plain_outputs=outputs[kept, own],
            A=MatrixSeries.of(found["A"] if len(kept) == len(found["A"]) else found["A"][kept]),
            B=found["B"][kept],
            C=found["C"][kept, own],
            D=found["D"][kept, own],
            P=found["P"][kept],
            Q=found["Q"][kept, own],
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
    """Prepare an experiment for linearisation with its active effects.

    Parameters
    ----------
    active
        Each active effect with the position of its first coefficient.
    n_coefficients
        Number of coefficients of the task.
    """
    experiment = _with_all_inputs_driven(model, description, experiment)
    effects = bind_effects(active, experiment, description, n_coefficients, model_exchange=True)
    with_offsets = None
    if effects.inner is not None:
        added = [
            (define(Effect(f":{name}", f"input {name}", "bias"), description, model.interface), at)
            for at, name in enumerate(
                (given.variable for given in effects.experiment.inputs), n_coefficients
            )
        ]
        with_offsets = bind_effects(
            [*active, *added], experiment, description, n_coefficients + len(added),
            model_exchange=True,
        )  # fmt: skip
    return PreparedExperiment(model, description, effects, with_offsets, n_coefficients)


def _with_all_inputs_driven(
    model: Model, description: ModelDescription, experiment: Experiment
) -> Experiment:
    """Add a constant signal for each real input of the FMU that is not set.

    The FMU would keep these inputs at their start values, but here derivatives by them are needed.
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


def linearisation(
    model: Model,
    states: Sequence[ModelVariable | None],
    inputs: Sequence[ModelVariable],
    parameters: Sequence[ModelVariable],
    shape: tuple[int, int],
) -> library.Linearisation:
    """Return the structure for derivatives by some variables; `shape` is (times, outputs).

    None represents a state of an effect. With solver "cvode", the states must already be computed.
    """
    n, y = shape
    x, u, p = len(states), len(inputs), len(parameters)
    stepping = METHODS[model.solver.name]
    asked = library.Linearisation(stepping=stepping, n_inputs=u).hold(
        states=_range(states), inputs=_range(inputs), parameters=_range(parameters)
    )
    sizes = {"x": (x,), "dx": (x,), "effective": (u,), "A": (x, x), "B": (x, u), "P": (x, p)}
    sizes |= {"C": (y, x), "D": (y, u), "Q": (y, p)}
    return asked.hold(np.float64, **{name: np.zeros((n, *size)) for name, size in sizes.items()})


def _range(variables: Sequence[ModelVariable | None]) -> Range:
    """Return the nominal values and bounds of variables."""
    return Range(n=len(variables)).hold(
        np.float64,
        nominals=[1.0 if v is None else v.nominal for v in variables],
        lows=[-np.inf if v is None or v.low is None else v.low for v in variables],
        highs=[np.inf if v is None or v.high is None else v.high for v in variables],
    )


LEAST_SPREAD_FACTOR = 1e-6
"""Smallest factor of the squares of residuals for a `log_spread` of another model."""


@dataclass(frozen=True)
class FilterPass:
    """One point of an experiment, filtered with this object instead of the solver's loop.

    Attributes
    ----------
    asked
        Perturbed variables, and arrays of the derivatives. Without offsets, the active effects are
        used.
    kalman
        Noise, measurements, innovations.
    log_spread
        See `Experiment`.
    """

    asked: library.Linearisation
    kalman: Kalman
    log_spread: float

    def __call__(self, batch: Batch) -> int:
        """Simulate one point; always return 1."""
        if not self.asked.offsets:
            self.asked.offsets = batch.effects
        core().core_filter(addressof(batch), addressof(self.asked), addressof(self.kalman))
        return 1

    def total_log_spread(self, grid: SignalGrid) -> float:
        """Return the sum of log(S / sigma^2) over all measured values."""
        spreads = self.kalman.held["spreads"].ravel()[grid.gather]
        return float(np.add.reduce(np.log(spreads / grid.sigmas**2)))

    def standardised(self, grid: SignalGrid) -> FloatArray:
        """Return innovations whose sum of squares is -2 log likelihood, (residuals,).

        Up to a constant, -2 log likelihood is e'e / S + log(S / sigma^2), summed over all values.
        The second part is not negative, because S is at least sigma^2. So the innovations over
        their standard deviations, r = e / sqrt(S), are scaled until their sum of squares includes
        it:

            r sqrt(1 + sum log(S / sigma^2) / r'r).

        Sums of squares of records add up, whatever their lengths and times. The `log_spread` of the
        experiment is subtracted from the sum. Near the model of that `log_spread`, the residuals
        are r itself, white and of variance 1.
        """
        spreads = self.kalman.held["spreads"].ravel()[grid.gather]
        plain = self.kalman.held["innovations"].ravel()[grid.gather] / np.sqrt(spreads)
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
        Name of the state, which may be an effect's own state.
    density
        q^2.
    variance
        Additional variance of the state at the start: the stationary variance of an
        Ornstein-Uhlenbeck process.
    """

    state: str
    density: float
    variance: float = 0.0

    @classmethod
    def of(cls, definition: EffectDefinition, coefficients: FloatArray) -> StateNoise:
        """Return the noise of an effect; `coefficients` start with its first coefficient."""
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
    """Prepare the filter for one point of an experiment.

    Parameters
    ----------
    model, description, bound
        The FMU and the experiment, with its active effects.
    states
        States of the FMU, then own states of those effects.
    noise
        Noise at some of the states.
    log_spread
        That of the experiment.
    linearised
        The pass whose derivatives are computed along the filter; None for only those that the
        filter needs.
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
    kalman = Kalman().hold(
        np.float64,
        diffusion=diffusion,
        measured=measured.reshape(n, y),
        variances=variances.reshape(n, y),
        innovations=np.zeros((n, y)),
        spreads=np.ones((n, y)),
        covariance=covariance,
    )
    if linearised is not None:
        return FilterPass(linearised.asked, kalman, log_spread)
    known = [description.variables[name] for name in description.states]
    own: list[None] = [None] * (count - len(known))
    asked = linearisation(model, [*known, *own], (), (), (n, y))
    return FilterPass(asked, kalman, log_spread)
