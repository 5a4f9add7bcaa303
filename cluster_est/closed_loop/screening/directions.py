"""Directions in which candidates would move the residuals, were they switched on a little.

In model exchange one linear time-varying system along each experiment answers for all candidates:

    d(dx)/dt = A dx + B du + P dp + f,    dy = C dx + D du + Q dp

with what a candidate adds as f (state derivative), du (input) or dp (parameter). An effect at an
output adds to y and needs nothing else. In co-simulation the states are hidden, and with process
noise a Kalman filter corrects them: what a candidate changes in one prediction is in part gone in
the next. There each candidate is simulated (`probe`).
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
"""Share of the signal that it changes by which a candidate is switched on in co-simulation. Signal:
large beside a solver's error, small beside the signal."""


Told = Callable[[int, int], None]
"""Hears how many candidates are done, and of how many."""


@dataclass(frozen=True)
class CandidatePoint:
    """A candidate at one point of its grid."""

    candidate: EffectCandidate
    values: tuple[float, ...]

    @property
    def columns(self) -> int:
        """Number of its signals: one for each strength, or one finite change."""
        return max(1, len(self.candidate.strengths))

    @property
    def width(self) -> int:
        """Number of columns of its direction: of some strengths one an experiment."""
        return max(1, sum(self.candidate.counts(self.candidate.own_strengths)))


def directions(
    trajectories: Sequence[LinearisedTrajectory],
    trials: Sequence[CandidatePoint],
    known: Sequence[FloatArray],
    rows: IntArray | None = None,
    told: Told = lambda *_: None,
) -> list[FloatArray]:
    """The directions of trials, each (residuals, width), from the linearised trajectories alone.

    Parameters
    ----------
    trials
        At any sites in model exchange, at outputs in co-simulation.
    known : (parameters,) for each trajectory
        Values of the model's parameters there.
    rows
        The residuals that are kept, ascending; None for all of them.
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
    """(residuals, width): give strengths that have a value an experiment a column for each.

    `whose` are the experiments of the residuals.
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
    """The rows between two, counted from the first of these."""
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
    """(k, m): how the residuals of an experiment change with what is added at a site, (n, m)."""
    changes = _Changes(trajectory, added.shape[1])
    if changes.sees(site):
        changes.add(site, np.arange(added.shape[1]), added)
    linear = None if site.kind == "output" else trajectory.linear
    return changes.of_residuals(None if linear is None else linear_system(linear))


class _Changes:
    """Columns of changes along one experiment: of its outputs at once, and of its states."""

    def __init__(self, trajectory: LinearisedTrajectory, count: int) -> None:
        self._trajectory = trajectory
        self._outputs = np.zeros((*trajectory.outputs.shape, count))
        self._columns: list[int] = []
        self._amounts: list[FloatArray] = []
        self._which: list[int] = []
        self._directions: dict[str, int | FloatArray] = {}

    def sees(self, site: EffectSite) -> bool:
        """Return whether the experiment measures what is changed, if that is an output."""
        return site.kind != "output" or site.target in self._trajectory.names

    def add(self, site: EffectSite, columns: IntArray, added: FloatArray) -> None:
        """Add at a site; at a pair each column acts on one of the states."""
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
        """Add to the derivative of a state."""
        self._along(state, self._linear(state).state_names.index(state), columns, amounts)

    def of_residuals(self, system: LinearSystem | None) -> FloatArray:
        """(k, columns): the changes of the residuals."""
        if system is not None and self._columns:
            which = np.array(self._which, int)
            forcing = Forcing(np.hstack(self._amounts), list(self._directions.values()), which)
            responses = system.respond(forcing)
            for i, column in enumerate(self._columns):  # one may act on two states
                self._outputs[:, :, column] += responses[:, :, i]
        return self._trajectory.residual_change(self._outputs)

    def _along(
        self, name: str, direction: int | FloatArray, columns: IntArray, amounts: FloatArray
    ) -> None:
        """Force along a direction; whatever has the same name is the same direction."""
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
    """(n, columns): what the effect adds at its site; relative at a parameter in co-simulation."""
    arguments, values = _arguments(trajectory, trial, known)
    return shape_of(trial.candidate.form).directions(arguments, values)


def _arguments(
    trajectory: LinearisedTrajectory, trial: CandidatePoint, known: FloatArray
) -> tuple[FormArguments, dict[str, float]]:
    """The signals and the coefficients that an effect is a function of."""
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
    """(n, x) and (n, y): how an input or a parameter acts on the states and on the outputs."""
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
    """The direction of each trial, (residuals, width), all in one queue.

    A strength is switched on by a little, and the change of the residuals divided by how much; an
    effect that can only be switched on by a finite amount is, by its whole amount.
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
    """Coefficients for each column, and what its change is to be divided by."""
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
    """The strength that changes its signal by as much as the signal itself."""
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
    """Values of the parameters, each over its own."""
    return np.ones(0 if trajectory.linear is None else len(trajectory.linear.parameter_names))


def _changed(trajectories: Sequence[LinearisedTrajectory], site: EffectSite) -> FloatArray:
    """The signal that an effect at a site changes, a derivative among them."""
    if not site.at_rates:
        return pooled(trajectories, site.target)
    linear = [trajectory.linear for trajectory in trajectories if trajectory.linear is not None]
    return np.concatenate(
        [each.derivatives[:, each.state_names.index(site.target)] for each in linear]
    )


def _point(
    fitted: FittedModel, unknowns: Sequence[Unknown], trial: CandidatePoint, row: FloatArray
) -> FloatArray:
    """The fit's point with the effect's coefficients behind it."""
    names = [c.name for c in trial.candidate.form.coefficients]
    own = [
        u.to_search(float(row[names.index(u.parameter.name.rpartition(".")[2])]))
        for u in unknowns[len(fitted.x) :]
    ]
    return np.concatenate([fitted.x, own])
