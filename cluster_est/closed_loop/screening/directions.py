"""Directions of candidates: how the residuals change if a candidate is switched on slightly.

In model exchange, one linear time-varying system along each experiment serves all candidates:

    d(dx)/dt = A dx + B du + P dp + f,    dy = C dx + D du + Q dp

A candidate acts as f (at a state derivative), du (at an input) or dp (at a parameter). An effect at
an output is added to y and needs no system. In co-simulation the states are not accessible. With
process noise, a Kalman filter corrects the states, so that part of the change by a candidate is
lost at the next prediction. In both cases each candidate is simulated (`probe`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from cluster_est.closed_loop.candidates.array_forms import FormArguments, shape_of
from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import (
    FEW_VALUES,
    Forcing,
    LinearisedTrajectory,
    LinearSystem,
    linear_system,
    pooled,
)
from cluster_est.closed_loop.fitter import FittedModel, Fitter
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.problem.unknowns import Unknown
from workers.effects.site import EffectSite
from workers.messages import FloatArray, IntArray, Linearisation

PROBE_AMOUNT = 0.01
"""Strength of a candidate in a probe, as a share of the signal that it changes. Signal: large
compared with a solver's error, small compared with the signal."""


Told = Callable[[int, int], None]
"""Receives the number of candidates that are done, and their total number."""


@dataclass(frozen=True)
class CandidatePoint:
    """A candidate at one point of its grid."""

    candidate: EffectCandidate
    values: tuple[float, ...]

    @property
    def columns(self) -> int:
        """Number of its signals: one per strength, or one for a finite change."""
        return max(1, len(self.candidate.strengths))

    @property
    def width(self) -> int:
        """Number of columns of its direction; a strength may have one for each experiment."""
        return max(1, sum(self.candidate.counts(self.candidate.own_strengths)))


def directions(
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
    known: Sequence[FloatArray],
    rows: IntArray | None = None,
    told: Told = lambda *_: None,
) -> list[FloatArray]:
    """Compute the directions of trials, each (residuals, width), from linearised trajectories.

    Parameters
    ----------
    trials
        In model exchange, trials at any site; in co-simulation, only trials at outputs.
    known : (parameters,) for each trajectory
        Values of the model's parameters in each trajectory.
    rows
        Indices of the residuals that are kept, ascending; None for all residuals.
    """
    if not trials:
        return []
    stops = np.cumsum([0, *(len(trajectory.rows) for trajectory in trajectories)]).tolist()
    count, whole = len(trials), len(trials) * len(trajectories)
    parts = []
    for e, (trajectory, values) in enumerate(zip(trajectories, known, strict=True)):
        kept = _within(rows, stops[e], stops[e + 1])
        heard = partial(_hear, told, e * count, whole)
        parts.append(_of_trajectory(trajectory, trials, values, kept, heard))
    joined = np.concatenate(parts)
    ends = np.cumsum([0, *(trial.columns for trial in trials)])
    whose = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return [
        by_experiment(trial, joined[:, a:b], whose)
        for trial, (a, b) in zip(trials, pairwise(ends), strict=True)
    ]


def by_experiment(trial: CandidatePoint, columns: FloatArray, whose: IntArray) -> FloatArray:
    """(residuals, width): split columns of strengths that have one value per experiment.

    `whose` is the index of the experiment of each residual.
    """
    own = trial.candidate.own_strengths
    if not any(c.each for c in own):
        return columns
    apart = whose[:, None] == np.arange(len(trial.candidate.experiments))
    parts = zip(own, columns.T[:, :, None], strict=True)
    return np.hstack([np.where(apart, column, 0.0) if c.each else column for c, column in parts])


def _hear(told: Told, before: int, of: int, done: int) -> None:
    told(before + done, of)


def _within(rows: IntArray | None, start: int, stop: int) -> IntArray | slice:
    """The rows in this range, counted from its start."""
    if rows is None:
        return slice(None)
    first, last = np.searchsorted(rows, [start, stop]).tolist()
    return np.asarray(rows[first:last] - start)


def _of_trajectory(
    trajectory: LinearisedTrajectory,
    trials: Sequence[CandidatePoint],
    known: FloatArray,
    kept: IntArray | slice,
    told: Callable[[int], None],
) -> FloatArray:
    """(kept residuals of one experiment, columns of all trials)."""
    system = linear_system(trajectory.linear) if trajectory.linear is not None else None
    most = system.block if system else max(1, FEW_VALUES // max(1, trajectory.outputs.size))
    found: list[FloatArray] = []
    block: list[CandidatePoint] = []
    columns = 0
    for done, trial in enumerate(trials):
        if block and columns + trial.columns > most:
            found.append(_of_block(trajectory, system, block, known)[kept])
            told(done)
            block, columns = [], 0
        block.append(trial)
        columns += trial.columns
    if block:
        found.append(_of_block(trajectory, system, block, known)[kept])
    return np.hstack(found)


def _of_block(
    trajectory: LinearisedTrajectory,
    system: LinearSystem | None,
    trials: Sequence[CandidatePoint],
    known: FloatArray,
) -> FloatArray:
    changes = _Changes(trajectory, sum(trial.columns for trial in trials))
    first = 0
    for trial in trials:
        columns = np.arange(first, first + trial.columns)
        first += trial.columns
        site, shape = trial.candidate.site, shape_of(trial.candidate.form)
        if not changes.sees(site):
            continue
        added = added_at(trajectory, trial, known)
        if shape.mirrored:
            back = shape.reactions(*_arguments(trajectory, trial, np.zeros(0)))
            for target, amounts in zip(site.targets, (added, back), strict=True):
                changes.force(target, columns, amounts)
        else:
            changes.add(site, columns, added)
    return changes.of_residuals(system)


def residual_change(
    trajectory: LinearisedTrajectory, site: EffectSite, added: FloatArray
) -> FloatArray:
    """(k, m): change of the residuals of an experiment by (n, m) terms that are added at a site."""
    changes = _Changes(trajectory, added.shape[1])
    if changes.sees(site):
        changes.add(site, np.arange(added.shape[1]), added)
    linear = None if site.kind == "output" else trajectory.linear
    return changes.of_residuals(None if linear is None else linear_system(linear))


class _Changes:
    """Changes along one experiment, one column each: of outputs directly, and through states."""

    def __init__(self, trajectory: LinearisedTrajectory, count: int) -> None:
        self._trajectory = trajectory
        self._outputs = np.zeros((*trajectory.outputs.shape, count))
        self._columns: list[int] = []
        self._amounts: list[FloatArray] = []
        self._which: list[int] = []
        self._directions: dict[str, int | FloatArray] = {}

    def sees(self, site: EffectSite) -> bool:
        """Return whether the experiment measures the site, if the site is an output."""
        return site.kind != "output" or site.target in self._trajectory.names

    def add(self, site: EffectSite, columns: IntArray, added: FloatArray) -> None:
        """Add terms at a site; at a pair, each column acts on one of the two states."""
        if site.kind == "output":
            self._outputs[:, self._trajectory.names.index(site.target), columns] += added
        elif site.kind == "derivative":
            self.force(site.target, columns, added)
        elif site.kind == "pair":
            for i, target in enumerate(site.targets):
                self.force(target, columns[i : i + 1], added[:, i : i + 1])
        else:
            into, through = coupling(self._linear(site), site)
            self._along(str(site), into, columns, added)
            self._outputs[:, :, columns] += through[:, :, None] * added[:, None, :]

    def force(self, state: str, columns: IntArray, amounts: FloatArray) -> None:
        """Add terms to the derivative of a state."""
        self._along(state, self._linear(state).state_names.index(state), columns, amounts)

    def of_residuals(self, system: LinearSystem | None) -> FloatArray:
        """(k, columns): the changes of the residuals."""
        if system is not None and self._columns:
            which = np.array(self._which, int)
            forcing = Forcing(np.hstack(self._amounts), list(self._directions.values()), which)
            responses = system.respond(forcing)
            for i, column in enumerate(self._columns):  # a column may act on two states
                self._outputs[:, :, column] += responses[:, :, i]
        return self._trajectory.residual_change(self._outputs)

    def _along(
        self, name: str, direction: int | FloatArray, columns: IntArray, amounts: FloatArray
    ) -> None:
        """Add a forcing along a direction; directions with the same name are the same."""
        self._directions.setdefault(name, direction)
        self._which += [list(self._directions).index(name)] * len(columns)
        self._columns += columns.tolist()
        self._amounts.append(amounts)

    def _linear(self, where: object) -> Linearisation:
        if self._trajectory.linear is None:
            raise ValueError(f"{where} has no direction without a linearisation")
        return self._trajectory.linear


def added_at(
    trajectory: LinearisedTrajectory, trial: CandidatePoint, known: FloatArray
) -> FloatArray:
    """(n, columns): what an effect adds; at a parameter in co-simulation, relative to its value."""
    arguments, values = _arguments(trajectory, trial, known)
    return shape_of(trial.candidate.form).directions(arguments, values)


def _arguments(
    trajectory: LinearisedTrajectory, trial: CandidatePoint, known: FloatArray
) -> tuple[FormArguments, dict[str, float]]:
    """The signals and the coefficients on which an effect depends."""
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
    return FormArguments(trajectory.times, s, v, w), values


def coupling(linear: Linearisation, site: EffectSite) -> tuple[FloatArray, FloatArray]:
    """(n, x) and (n, y): the columns of B and D of an input, or of P and Q of a parameter."""
    if site.kind == "input":
        j = linear.input_names.index(site.target)
        return linear.B[:, :, j], linear.D[:, :, j]
    j = linear.parameter_names.index(site.target)
    return linear.P[:, :, j], linear.Q[:, :, j]


def probe(
    fitter: Fitter,
    fitted: FittedModel,
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
) -> list[FloatArray]:
    """Simulate the direction of each trial, (residuals, width), all in one queue.

    A strength is set to a small value, and the change of the residuals is divided by this value. An
    effect that can only be switched on by a finite amount is set to its full amount, undivided.
    """
    asked, amounts = [], []
    for trial in trials:
        rows, steps = _switched(trial, trajectories)
        start = fitted.start.plus(trial.candidate, trial.values)
        space = fitter.space(start)
        points = np.array([_point(fitted, space.unknowns, trial, row) for row in rows])
        asked.append((space, points))
        amounts.append(steps)
    found = []
    sizes = [own.stop - own.start for own in fitted.space.rows]
    whose = np.repeat(np.arange(len(sizes)), sizes)
    answers = fitter.evaluate(LoopStage.PROBE, asked)
    for trial, steps, seen in zip(trials, amounts, answers, strict=True):
        columns = [
            (at.residuals - fitted.residuals) / step if at.ok else np.zeros(fitter.size)
            for at, step in zip(seen, steps, strict=True)
        ]
        moved = np.column_stack(columns).reshape(fitter.size, trial.columns)
        found.append(by_experiment(trial, moved, whose))
    return found


def _switched(
    trial: CandidatePoint, trajectories: Sequence[LinearisedTrajectory]
) -> tuple[list[FloatArray], list[float]]:
    """Coefficients for each column, and the number by which the change of residuals is divided."""
    names = [c.name for c in trial.candidate.form.coefficients]
    strengths = [i for i, name in enumerate(names) if name in trial.candidate.strengths]
    if not strengths:
        return [np.array(trial.values)], [1.0]
    step = PROBE_AMOUNT * _size(trial, trajectories)
    rows = [np.array(trial.values) for _ in strengths]
    for row, i in zip(rows, strengths, strict=True):
        row[i] = step
    return rows, [step] * len(rows)


def _size(trial: CandidatePoint, trajectories: Sequence[LinearisedTrajectory]) -> float:
    """The strength at which the effect changes its signal by the rms of the signal itself."""
    candidate = trial.candidate
    added = np.concatenate(
        [added_at(trajectory, trial, _ones(trajectory)) for trajectory in trajectories]
    )
    swing = float(np.sqrt(np.mean(added**2))) or 1.0
    if candidate.site.kind == "parameter":
        return 1.0 / swing
    signal = _changed(trajectories, candidate.site)
    return float(np.sqrt(np.mean(signal**2)) or 1.0) / swing


def _ones(trajectory: LinearisedTrajectory) -> FloatArray:
    """Relative values of the parameters, all 1."""
    return np.ones(0 if trajectory.linear is None else len(trajectory.linear.parameter_names))


def _changed(trajectories: Sequence[LinearisedTrajectory], site: EffectSite) -> FloatArray:
    """The signal that an effect at a site changes; it may be a state derivative."""
    if not site.at_rates:
        return pooled(trajectories, site.target)
    linear = [trajectory.linear for trajectory in trajectories if trajectory.linear is not None]
    return np.concatenate(
        [each.derivatives[:, each.state_names.index(site.target)] for each in linear]
    )


def _point(
    fitted: FittedModel, unknowns: Sequence[Unknown], trial: CandidatePoint, row: FloatArray
) -> FloatArray:
    """The point of the fit, followed by the coefficients of the effect."""
    names = [c.name for c in trial.candidate.form.coefficients]
    own = [
        u.to_search(float(row[names.index(u.parameter.name.rpartition(".")[2])]))
        for u in unknowns[len(fitted.x) :]
    ]
    return np.concatenate([fitted.x, own])
