"""Linearised trajectories: signals of simulated experiments, and kinematic equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from workers.effects.site import split_variable
from workers.grid import build_grid, values_at
from workers.messages import Experiment, FloatArray, IntArray, Linearisation, Outcome

KINEMATIC = 1e-6
"""Relative gap of der(x) and another state below which they are the same: a little above the error
of a solver. Signal."""


@dataclass(frozen=True)
class LinearisedTrajectory:
    """One experiment along the current fit.

    Attributes
    ----------
    times : (n,)
    signals
        Everything that an effect may be a function of, by its FMU name, each (n,): states (model
        exchange), inputs as they reach the FMU, measured signals, outputs.
    outputs : (n, y)
        In model exchange before effects at outputs, in co-simulation behind them.
    names
        Of the outputs.
    linear
        The linear time-varying system along it; None in co-simulation.
    rows, columns : (k,)
        Place of each residual in `outputs`.
    sigmas : (k,)
        Divisor of each residual.
    driven
        The inputs as they were measured, at the same times; in `signals` they are as effects have
        changed them.
    """

    times: FloatArray = field(repr=False)
    signals: Mapping[str, FloatArray] = field(repr=False)
    outputs: FloatArray = field(repr=False)
    names: tuple[str, ...]
    linear: Linearisation | None = field(repr=False)
    rows: IntArray = field(repr=False)
    columns: IntArray = field(repr=False)
    sigmas: FloatArray = field(repr=False)
    driven: Mapping[str, FloatArray] = field(default_factory=dict, repr=False)

    def residual_change(self, change: FloatArray) -> FloatArray:
        """(n, y, m) changes of the outputs to (k, m) changes of the residuals."""
        return np.asarray(-change[self.rows, self.columns] / self.sigmas[:, None])

    def has(self, name: str) -> bool:
        """Return whether there is such a signal, or both of a difference."""
        return bool(split_variable(name, self.signals))

    def signal(self, name: str) -> FloatArray:
        """A signal, or the difference of two ("a - b")."""
        parts = split_variable(name, self.signals) or (name,)
        first, *second = (self.signals[one] for one in parts)
        return first - second[0] if second else first


def make_trajectory(
    experiment: Experiment, outcome: Outcome, states: Sequence[str]
) -> LinearisedTrajectory:
    """From the answer to "linearisation", or to "trajectory" in co-simulation.

    `states` are the FMU's: those that effects bring along are nothing to depend on.
    """
    linear, trajectory = outcome.linearisation, outcome.trajectory
    if linear is not None:
        times, names = linear.times, linear.output_names
        plain, shown = linear.plain_outputs, linear.outputs
        signals = dict(zip(linear.state_names, linear.states.T, strict=True))
        signals = {name: signals[name] for name in states}
        signals |= dict(zip(linear.input_names, linear.effective_inputs.T, strict=True))
    elif trajectory is not None:
        times, names = trajectory.times, trajectory.variables
        plain = shown = trajectory.values
        signals = {}
    else:
        raise ValueError("the outcome must carry a linearisation or a trajectory")
    driven = {given.variable: values_at(given, times) for given in experiment.inputs}
    measured = {given.variable: values_at(given, times) for given in experiment.signals}
    for name, values in (*driven.items(), *measured.items()):
        signals.setdefault(name, values)
    own = {n: shown[:, i] for i, n in enumerate(names) if n not in signals}
    grid = build_grid(experiment)
    width = len(experiment.outputs)
    at = np.searchsorted(times, grid.times[grid.gather // width])
    return LinearisedTrajectory(
        times=times,
        signals=signals | own,
        outputs=plain,
        names=tuple(names),
        linear=linear,
        rows=np.minimum(at, len(times) - 1),
        columns=grid.gather % width,
        sigmas=grid.sigmas,
        driven=driven,
    )


def pooled(trajectories: Sequence[LinearisedTrajectory], name: str) -> FloatArray:
    """A signal of all experiments that have it, one behind the other."""
    return np.concatenate(
        [trajectory.signal(name) for trajectory in trajectories if trajectory.has(name)]
    )


CONSTANT_FACTOR = 1e-4
"""Share of its factor by which a kinematic equation may change along a trajectory."""


def integrated_states(
    trajectories: Sequence[LinearisedTrajectory],
    tolerance: float = KINEMATIC,
) -> dict[str, tuple[str, float]]:
    """Find the states x with dx/dt = c v, where v is another state and c a constant.

    Parameters
    ----------
    trajectories
        The first one with a linear system is looked at: the equations are those of all.
    tolerance
        Largest share of the derivative that the equation may leave.

    Returns
    -------
    dict
        v and c by x: its speed and 1 for an angle, that of a wheel and its radius for a way.
    """
    found: dict[str, tuple[str, float]] = {}
    linear = next((each.linear for each in trajectories if each.linear is not None), None)
    if linear is None:
        return found
    names = linear.state_names
    for i, name in enumerate(names):
        own = linear.A.row(i)
        j = int(np.argmax(np.abs(own[0])))
        factor = float(own[0, j])
        size = np.abs(linear.derivatives[:, i]).max()
        gap = np.abs(linear.derivatives[:, i] - factor * linear.states[:, j]).max()
        if i == j or gap > tolerance * size:
            continue
        row = np.abs(own - factor * np.eye(len(names))[j]).max()
        driven = np.abs(linear.B[:, i]).max(initial=0.0)
        if max(row, driven) < CONSTANT_FACTOR * abs(factor):
            found[name] = names[j], factor
    return found
