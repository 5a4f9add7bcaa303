"""Directions in which candidates would move the residuals, were they switched on a little.

In model exchange one linear time-varying system along each experiment answers for all candidates:

    d(dx)/dt = A dx + B du + P dp + f,    dy = C dx + D du + Q dp

with what a candidate adds as f (state derivative), du (input) or dp (parameter). An effect at an
output adds to y and needs nothing else. The system is integrated exactly for forcing that is linear
between the times of the grid and A constant in between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.shapes import FormArguments, shape_of
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory
from cluster_est.closed_loop.screening.linear_kernel import run_linear
from workers.effects.site import EffectSite
from workers.messages import FloatArray, Linearisation

BLOCK_VALUES = 2_000_000
"""Forcing that is kept at once: 16 MB."""


@dataclass(frozen=True)
class CandidatePoint:
    """A candidate at one point of its grid."""

    candidate: EffectCandidate
    values: tuple[float, ...]

    @property
    def width(self) -> int:
        """Number of columns of its direction: one for each strength, or one finite change."""
        return max(1, len(self.candidate.strengths))


def directions(
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
    known: Sequence[FloatArray],
) -> list[FloatArray]:
    """The directions of trials, each (residuals, width), from the linearised trajectories alone.

    Parameters
    ----------
    trajectories
        Of the training experiments, in their order.
    trials
        At any sites in model exchange, at outputs in co-simulation.
    known : (parameters,) for each trajectory
        Values of the model's parameters there.
    """
    if not trials:
        return []
    parts = [
        _of_trajectory(trajectory, trials, values)
        for trajectory, values in zip(trajectories, known, strict=True)
    ]
    joined = np.concatenate(parts)
    ends = np.cumsum([0, *(trial.width for trial in trials)])
    return [joined[:, a:b] for a, b in pairwise(ends)]


def _of_trajectory(
    trajectory: LinearisedTrajectory, trials: Sequence[CandidatePoint], known: FloatArray
) -> FloatArray:
    """(residuals of one experiment, columns of all trials)."""
    steps = discretise(trajectory.linear) if trajectory.linear is not None else None
    width = len(trajectory.times) * max(trajectory.outputs.shape[1], _order(trajectory))
    most = max(1, BLOCK_VALUES // max(1, width))
    found: list[FloatArray] = []
    block: list[CandidatePoint] = []
    columns = 0
    for trial in trials:
        if block and columns + trial.width > most:
            found.append(_of_block(trajectory, steps, block, known))
            block, columns = [], 0
        block.append(trial)
        columns += trial.width
    if block:
        found.append(_of_block(trajectory, steps, block, known))
    return np.hstack(found)


def _order(trajectory: LinearisedTrajectory) -> int:
    return trajectory.linear.A.shape[1] if trajectory.linear is not None else 0


def _of_block(
    trajectory: LinearisedTrajectory,
    steps: DiscreteSystem | None,
    trials: Sequence[CandidatePoint],
    known: FloatArray,
) -> FloatArray:
    count = sum(trial.width for trial in trials)
    n, outputs = trajectory.outputs.shape
    forcing = np.zeros((n, _order(trajectory), count))
    change = np.zeros((n, outputs, count))
    first = 0
    for trial in trials:
        part = slice(first, first + trial.width)
        first = part.stop
        site = trial.candidate.site
        if site.kind == "output" and site.target not in trajectory.names:
            continue  # not measured in this experiment
        added = added_at(trajectory, trial, known)
        _place(trajectory, trial, added, forcing[:, :, part], change[:, :, part])
    if trajectory.linear is not None and steps is not None and forcing.any():
        change += np.matmul(trajectory.linear.C, propagate(steps, forcing))
    return trajectory.residual_change(change)


def added_at(
    trajectory: LinearisedTrajectory, trial: CandidatePoint, known: FloatArray
) -> FloatArray:
    """(n, width): what the effect adds at its site; relative at a parameter in co-simulation."""
    candidate = trial.candidate
    site, zero = candidate.site, np.zeros(len(trajectory.times))
    v, w = [*(trajectory.signal(name) for name in candidate.effect.variables), zero, zero][:2]
    s = zero
    if site.kind in ("input", "output"):
        s = trajectory.signal(site.target)
    elif site.kind == "parameter":
        names = trajectory.linear.parameter_names if trajectory.linear is not None else ()
        s = zero + (known[names.index(site.target)] if site.target in names else 1.0)
    values = {
        c.name: value for c, value in zip(candidate.form.coefficients, trial.values, strict=True)
    }
    return shape_of(candidate.form).directions(FormArguments(trajectory.times, s, v, w), values)


def _place(
    trajectory: LinearisedTrajectory,
    trial: CandidatePoint,
    added: FloatArray,
    forcing: FloatArray,
    change: FloatArray,
) -> None:
    """Let what is added act on the linear system: on its states, its outputs, or both."""
    site, linear = trial.candidate.site, trajectory.linear
    if site.kind == "output":
        change[:, trajectory.names.index(site.target)] += added
        return
    if linear is None:
        raise ValueError(f"{site} has no direction without a linearisation")
    if site.kind in ("derivative", "pair"):
        for i, target in enumerate(site.targets):
            which = slice(None) if site.kind == "derivative" else slice(i, i + 1)
            forcing[:, linear.state_names.index(target), which] += added[:, which]
        return
    into, through = coupling(linear, site)
    forcing += into[:, :, None] * added[:, None, :]
    change += through[:, :, None] * added[:, None, :]


def coupling(linear: Linearisation, site: EffectSite) -> tuple[FloatArray, FloatArray]:
    """(n, x) and (n, y): how an input or a parameter acts on the states and on the outputs."""
    if site.kind == "input":
        j = linear.input_names.index(site.target)
        return linear.B[:, :, j], linear.D[:, :, j]
    j = linear.parameter_names.index(site.target)
    return linear.P[:, :, j], linear.Q[:, :, j]


@dataclass(frozen=True)
class DiscreteSystem:
    """A linear time-varying system in discrete time, for forcing that is linear within each step.

    x' = keep x + from_first f + from_last f', each (n - 1, x, x).
    """

    keep: FloatArray
    from_first: FloatArray
    from_last: FloatArray


def discretise(linear: Linearisation) -> DiscreteSystem:
    """Step matrices, exact where A is constant within each step.

    C. F. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395-404, doi:10.1109/TAC.1978.1101743.
    """
    h = np.diff(linear.times)
    x = linear.A.shape[1]
    mean = 0.5 * (linear.A[1:] + linear.A[:-1])
    joined = np.zeros((len(h), 3 * x, 3 * x))
    eye: npt.NDArray[np.float64] = np.eye(x)
    joined[:, :x, :x] = mean * h[:, None, None]
    joined[:, :x, x : 2 * x] = eye * h[:, None, None]
    joined[:, x : 2 * x, 2 * x :] = eye
    powers = expm(joined)
    last = powers[:, :x, 2 * x :]
    parts = powers[:, :x, :x], powers[:, :x, x : 2 * x] - last, last
    return DiscreteSystem(*(np.ascontiguousarray(part) for part in parts))


def propagate(steps: DiscreteSystem, forcing: FloatArray) -> FloatArray:
    """Integrate d(dx)/dt = A dx + f from dx = 0.

    Parameters
    ----------
    steps
        The system.
    forcing : (n, x, m)
        m right-hand sides at every time of the grid, linear in between. The states take their
        place.

    Returns
    -------
    (n, x, m)
    """
    now, after = np.zeros_like(forcing[0]), np.zeros_like(forcing[0])
    run_linear(steps.keep, steps.from_first, steps.from_last, forcing, now, after)
    return forcing
