"""Simulations behind an extended Kalman filter: arguments and results of the compiled loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from workers.effects.definition import EffectDefinition
from workers.fmu.description import ModelDescription
from workers.grid import SignalGrid
from workers.kernels.fmi.arguments import KernelArguments
from workers.kernels.fmi.hooks import EffectHooks
from workers.kernels.kalman import KalmanArrays, filter_states
from workers.kernels.linearise import (
    ADAPTIVE,
    FIXED,
    LinearisationArrays,
    PerturbedVariables,
)
from workers.messages import FloatArray, Model
from workers.simulation.bind_experiment import BoundExperiment
from workers.simulation.linearise import LinearisationPass, allocate, perturbation_range

SHORTEST = 1e-6
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
        return np.asarray(plain * np.sqrt(max(1.0 + wider / squares, SHORTEST)))


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
