"""Linearised trajectories: signals of simulated experiments, and linear systems along them.

    d(dx)/dt = A dx + f,    dy = C dx

f is linear between the times of the grid. A is constant within each step: the mean of its values
at both ends. With Z = h A, dx' = phi_0(Z) dx + h (phi_1(Z) - phi_2(Z)) f + h phi_2(Z) f', where
phi_0 is the matrix exponential and phi_k(Z) = Z phi_(k + 1)(Z) + I / k!. A prime marks the value at
the end of the step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from math import factorial
from typing import final

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from workers.core.library import core
from workers.effects.site import split_variable
from workers.grid import build_grid, values_at
from workers.messages import Experiment, FloatArray, IntArray, Linearisation, Outcome

KINEMATIC = 1e-6
"""Relative difference between der(x) and another state below which they count as the same. Signal:
it is a little above the error of a solver."""


@dataclass(frozen=True)
class LinearisedTrajectory:
    """One experiment, simulated at the current fit, with n times and k residuals.

    Attributes
    ----------
    signals
        All signals that an effect may depend on, by FMU name, each (n,): states (only in model
        exchange), inputs as the FMU receives them, measured signals, and outputs.
    outputs, names : (n, y)
        Outputs before effects at outputs in model exchange, and after them in co-simulation.
    linear
        The linear time-varying system along it; None in co-simulation.
    rows, columns, sigmas : (k,)
        The row and column of each residual in `outputs`, and the sigma that divides it.
    driven
        The inputs as measured, at the same times. In `signals`, effects have changed them.
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
        """Convert (n, y, m) changes of the outputs to (k, m) changes of the residuals."""
        return np.asarray(-change[self.rows, self.columns] / self.sigmas[:, None])

    def has(self, name: str) -> bool:
        """Return whether a signal exists; for a difference, whether both its signals exist."""
        return bool(split_variable(name, self.signals))

    def signal(self, name: str) -> FloatArray:
        """A signal, or the difference of two ("a - b")."""
        parts = split_variable(name, self.signals) or (name,)
        first, *second = (self.signals[one] for one in parts)
        return first - second[0] if second else first


def make_trajectory(
    experiment: Experiment, outcome: Outcome, states: Sequence[str]
) -> LinearisedTrajectory:
    """Make a trajectory from the result of a linearisation, or of a simulation in co-simulation.

    `states` are the states of the FMU. No effect may depend on states that other effects add.
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
    """A signal in all experiments that have it, concatenated."""
    return np.concatenate(
        [trajectory.signal(name) for trajectory in trajectories if trajectory.has(name)]
    )


def knots_over(values: FloatArray, count: int) -> FloatArray:
    """Knots half way between equally spaced values and quantiles of an argument."""
    shares = np.linspace(0.0, 1.0, count)
    even = values.min() + shares * np.ptp(values)
    between = 0.5 * (even + np.quantile(values, shares))
    return np.unique(np.clip(between, values.min(), values.max()))


def hats(knots: FloatArray, values: FloatArray) -> FloatArray:
    """(n, knots): piecewise linear basis functions, each 1 at its own knot and 0 at the others."""
    inside = np.clip(values, knots[0], knots[-1])
    return np.column_stack([np.interp(inside, knots, height) for height in np.eye(len(knots))])


CONSTANT_FACTOR = 1e-4
"""Largest change of the factor of a kinematic equation along a trajectory, as a share of it."""


def integrated_states(
    trajectories: Sequence[LinearisedTrajectory],
) -> dict[str, tuple[str, float]]:
    """Find the states x with dx/dt = c v, where v is another state and c a constant.

    Returns
    -------
    dict
        For each x, the state v and the factor c: for an angle its speed and 1; for the distance of
        a wheel its angular speed and its radius.
    """
    found: dict[str, tuple[str, float]] = {}
    # the equations must hold in all experiments
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
        if i == j or gap > KINEMATIC * size:
            continue
        row = np.abs(own - factor * np.eye(len(names))[j]).max()
        driven = np.abs(linear.B[:, i]).max(initial=0.0)
        if max(row, driven) < CONSTANT_FACTOR * abs(factor):
            found[name] = names[j], factor
    return found


TERMS = 12
"""Terms of the Taylor series of phi_2: at a norm of 1/2, the next term is below rounding error."""


@dataclass(frozen=True)
class StepMatrices:
    """A system in discrete time: (x, x) matrices of one step, or (n - 1, x, x) of all steps.

    dx' = keep dx + from_first f + from_last f'
    """

    keep: FloatArray
    from_first: FloatArray
    from_last: FloatArray


def step_matrices(a: FloatArray, h: float | FloatArray) -> StepMatrices:
    """Compute the matrices of one step, or of many at once, by scaling and squaring of phi_2.

    B. Skaflestad, W. M. Wright, Appl. Numer. Math. 59 (2009) 783-799,
    doi:10.1016/j.apnum.2008.03.035, with the Taylor series instead of their rational function:
    phi_1(2 Z) = (phi_0 phi_1 + phi_1) / 2 and phi_2(2 Z) = (phi_0 phi_2 + phi_1 + phi_2) / 4.

    Parameters
    ----------
    a, h : one matrix (x, x), or one for each step (n, x, x); the step length, or lengths (n,)
    """
    h = np.asarray(h)[..., None, None]
    eye: npt.NDArray[np.float64] = np.eye(a.shape[-1])
    size = float(np.abs(h * a).sum(axis=-1).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300)))) + 1)
    z = h * a / 2.0**halvings
    phi_2 = eye / factorial(TERMS + 2)
    for k in range(TERMS + 1, 1, -1):
        phi_2 = z @ phi_2 + eye / factorial(k)
    phi_1 = z @ phi_2 + eye
    phi_0 = z @ phi_1 + eye
    for _ in range(halvings):
        phi_2 = 0.25 * (phi_0 @ phi_2 + phi_1 + phi_2)
        phi_1 = 0.5 * (phi_0 @ phi_1 + phi_1)
        phi_0 = phi_0 @ phi_0
    return StepMatrices(phi_0, h * (phi_1 - phi_2), h * phi_2)


def propagate(steps: StepMatrices, forcing: FloatArray) -> FloatArray:
    """Integrate d(dx)/dt = A dx + f from dx = 0, for m right-hand sides at all times: (n, x, m)."""
    return run_recursion("core_run_linear", steps, forcing)


def run_recursion(name: str, steps: StepMatrices, values: FloatArray) -> FloatArray:
    """Run a recursion of the core over (n, x, m) values; the results overwrite the values."""
    values = np.ascontiguousarray(values)
    matrices = [np.ascontiguousarray(m) for m in (steps.keep, steps.from_first, steps.from_last)]
    n, x, m = values.shape
    scratch = np.empty((2, x, m))
    getattr(core(), name)(*(a.ctypes.data for a in (*matrices, values, scratch)), n, x, m)
    return values


HELD = 1e-3
"""Largest change of an entry of A, over the largest entry of its row, for which the matrices of the
last step are used again. It is a fifth of the limit that tells a direction from the parameters."""


def discretise(linear: Linearisation) -> StepMatrices:
    """Compute the matrices of all steps at once, exact where A is constant within each step.

    C. F. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395-404, doi:10.1109/TAC.1978.1101743.
    `step_matrices` agrees to 1e-11. On measured records, smaller differences can already change the
    order of nearly equal candidates. The figures of the benchmark and the league used this method.
    """
    a = np.asarray(linear.A)
    h = np.diff(linear.times)
    x = a.shape[1]
    joined = np.zeros((len(h), 3 * x, 3 * x))
    eye: npt.NDArray[np.float64] = np.eye(x)
    joined[:, :x, :x] = (0.5 * (a[1:] + a[:-1])) * h[:, None, None]
    joined[:, :x, x : 2 * x] = eye * h[:, None, None]
    joined[:, x : 2 * x, 2 * x :] = eye
    powers = expm(joined)
    last = powers[:, :x, 2 * x :]
    parts = powers[:, :x, :x], powers[:, :x, x : 2 * x] - last, last
    return StepMatrices(*(np.ascontiguousarray(part) for part in parts))


def streamed_steps(linear: Linearisation, *, backwards: bool = False) -> Iterator[StepMatrices]:
    """Give the matrices of each step in turn, in the forward or backward direction of time.

    The matrices are computed again where A has changed by more than `HELD`, or the step length by
    more than rounding error. This happens at the same steps in both directions, so the backward
    recursion is the adjoint of the forward one.
    """
    h = np.diff(linear.times)
    values = 0.5 * (linear.A.values[1:] + linear.A.values[:-1])
    made = _made_at(linear, h, values)
    first = -1
    step: StepMatrices | None = None
    for k in range(len(h) - 1, -1, -1) if backwards else range(len(h)):
        if step is None or made[k] != first:
            first = made[k]
            a = np.zeros(linear.A.shape[1:])
            a[linear.A.rows, linear.A.columns] = values[first]
            step = step_matrices(a, float(h[first]))
        yield step


def _made_at(linear: Linearisation, h: FloatArray, values: FloatArray) -> list[int]:
    """For each step, the step whose matrices it uses: its own, or the last that were computed."""
    largest = linear.A.largest().max(axis=1)[linear.A.rows]
    most = HELD * np.maximum(largest, np.finfo(float).tiny)
    found = [0]
    for k in range(1, len(h)):
        last = found[-1]
        same = abs(h[k] - h[last]) <= 1e-9 * h[last]
        same = same and bool((np.abs(values[k] - values[last]) <= most).all())
        found.append(last if same else k)
    return found


LARGE = 24
"""Number of states from which the matrices of all steps need too much memory, and from which matrix
products of a library are faster than the loops of the core."""

FEW_VALUES, MANY_VALUES = 2_000_000, 12_000_000
"""Values in memory at once: 16 MB, or 96 MB where fewer blocks save computing the steps again."""


@dataclass(frozen=True)
class Forcing:
    """m forcings of a linear system; each acts with some amount along a direction of the states.

    Attributes
    ----------
    amounts : (n, m)
    directions
        The index of a state, or a direction that varies with time, (n, x).
    which : (m,)
        The index of the direction of each forcing.
    """

    amounts: FloatArray = field(repr=False)
    directions: Sequence[int | FloatArray] = field(repr=False)
    which: IntArray


class LinearSystem(ABC):
    """A linear time-varying system along one experiment."""

    block: int
    """Largest number of forcings in one call of `respond`."""

    @abstractmethod
    def respond(self, forcing: Forcing) -> FloatArray:
        """(n, y, m): the response of the outputs to each forcing, starting from rest."""

    @abstractmethod
    def weigh(self, source: FloatArray) -> FloatArray:
        """(n, x, m): how much a forcing at any state contributes to m weighted sums of the states.

        The adjoint system is integrated backwards. `source`, (n, x, m), may be overwritten.
        """


def linear_system(linear: Linearisation) -> LinearSystem:
    """Prepare a linear system for integration, with the method that suits its size."""
    if linear.A.shape[1] < LARGE:
        return SmallSystem(linear)
    return LargeSystem(linear)


@final
class SmallSystem(LinearSystem):
    """A system with few states: it stores the matrices of all steps, and the core runs the loop."""

    def __init__(self, linear: Linearisation) -> None:
        n, outputs, states = linear.C.shape
        self._linear = linear
        self._steps = discretise(linear)
        self.block = max(1, FEW_VALUES // max(1, n * max(outputs, states)))

    def respond(self, forcing: Forcing) -> FloatArray:
        n, m = forcing.amounts.shape
        forced = np.zeros((n, self._linear.A.shape[1], m))
        for k, direction in enumerate(forcing.directions):
            own = forcing.which == k
            amounts = forcing.amounts[:, own]
            if isinstance(direction, np.ndarray):
                forced[:, :, own] += direction[:, :, None] * amounts[:, None, :]
            else:
                forced[:, direction, own] += amounts
        return np.asarray(np.matmul(self._linear.C, propagate(self._steps, forced)))

    def weigh(self, source: FloatArray) -> FloatArray:
        return run_recursion("core_run_adjoint", self._steps, source)


@final
class LargeSystem(LinearSystem):
    """A system with many states: it stores the matrices of only one step at a time.

    A forcing along a state needs only one column of the matrices. So the only product with a full
    matrix is the product with the states.
    """

    def __init__(self, linear: Linearisation) -> None:
        n, outputs, _ = linear.C.shape
        self._linear = linear
        self.block = max(1, MANY_VALUES // max(1, n * outputs))

    def respond(self, forcing: Forcing) -> FloatArray:
        n, m = forcing.amounts.shape
        shown = self._linear.C
        found = np.zeros((n, shown.shape[1], m))
        dx = np.zeros((shown.shape[2], m))
        first, last = np.zeros((2, len(forcing.directions), m))
        places = forcing.which, np.arange(m)
        last[places] = forcing.amounts[0]
        for k, step in enumerate(streamed_steps(self._linear)):
            first, last = last, first
            last[places] = forcing.amounts[k + 1]
            dx = step.keep @ dx
            dx += _along(step.from_first, forcing.directions, k) @ first
            dx += _along(step.from_last, forcing.directions, k + 1) @ last
            found[k + 1] = shown[k + 1] @ dx
        return found

    def weigh(self, source: FloatArray) -> FloatArray:
        found = np.zeros_like(source)
        now = source[-1]
        last = len(source) - 1
        for k, step in zip(
            range(last - 1, -1, -1), streamed_steps(self._linear, backwards=True), strict=True
        ):
            found[k] += step.from_first.T @ now
            found[k + 1] += step.from_last.T @ now
            now = step.keep.T @ now + source[k]
        return found


def _along(matrix: FloatArray, directions: Sequence[int | FloatArray], time: int) -> FloatArray:
    """(x, directions): a matrix times each direction at one of the times."""
    columns = [
        matrix @ direction[time] if isinstance(direction, np.ndarray) else matrix[:, direction]
        for direction in directions
    ]
    return np.column_stack(columns)
