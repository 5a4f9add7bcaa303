"""One iteration of a least-squares search: from a local model to the next point."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.methods.base import Ending, Evaluation, Points, Progress
from cluster_est.methods.constrained_model import ConstrainedModel, Knowledge
from cluster_est.methods.constraint_planes import Plane
from cluster_est.methods.curved_steps import Trials, curved_steps
from cluster_est.methods.local_model import LocalModel, sizes
from cluster_est.space import Space
from workers.messages import FloatArray

DAMPING_RATIO = 10.0
LEAST_DAMPING, LARGEST_DAMPING = 1e-14, 1e14
import os
PROBE=int(os.environ.get('PROBE','3'))
PROMISED = 3.0
"""How many times the gain of the best trial the model must promise before steps are bent."""


@dataclass(frozen=True)
class State:
    """Where a search stands.

    Attributes
    ----------
    x, at, progress
        The point, its evaluation, and the line of the table.
    scale
        Largest column norms of the Jacobian so far.
    damping
        With which the next steps begin.
    knowledge
        Of constraints and what they need.
    probe
        Another point at which derivatives of the constraints are wanted, and its evaluation.
    probes
        How many there were since the last step.
    best_x, best
        The point of the best rank so far; with constraints it may be another than `x`.
    offset
        What a full step promised at the point before, over the sum of squares.
    full_step
        The point before and its full step, if that was taken.
    """

    x: FloatArray
    at: Evaluation
    progress: Progress
    scale: FloatArray
    damping: float
    best_x: FloatArray
    best: Evaluation
    knowledge: Knowledge = field(default_factory=Knowledge)
    probe: tuple[FloatArray, Evaluation] | None = None
    probes: int = 0
    offset: float = 1.0
    full_step: tuple[FloatArray, FloatArray] | None = None

    def seen(self, points: FloatArray, evaluations: list[Evaluation]) -> State:
        """Remember the best of some points."""
        if self.at.constraints.size:
            pairs = [(x, at.constraints) for x, at in zip(points, evaluations, strict=True) if at.ok]
            knowledge = replace(self.knowledge, cuts=self.knowledge.cuts.with_points(pairs))
            self = replace(self, knowledge=knowledge)
        first = min(range(len(evaluations)), key=lambda i: evaluations[i].rank)
        if evaluations[first].rank < self.best.rank:
            return replace(self, best_x=points[first], best=evaluations[first])
        return self

    def with_plane(self, plane: Plane) -> State:
        """Remember a linearisation of the constraints."""
        cuts = self.knowledge.cuts.with_plane(plane)
        return replace(self, knowledge=replace(self.knowledge, cuts=cuts), probe=None)

    def moved(self, space: Space, x: FloatArray, at: Evaluation, damping: float) -> State:
        """One iteration further."""
        progress = Progress(
            self.progress.iteration + 1,
            at.cost,
            step=float(np.linalg.norm((x - self.x) / space.typical)),
            damping=damping,
            violation=at.violation if space.constraint_names else np.nan,
        )
        return replace(self, x=x, at=at, progress=progress, full_step=None, probes=0)


Result = tuple[State, Ending | None]
"""The next state, and why to stop there if so."""
Steps = Generator[Points, list[Evaluation], Result]


@dataclass(frozen=True)
class Descent:
    """Tries steps from a point until one lowers the merit.

    Attributes
    ----------
    space
        What is searched.
    trials
        Steps tried at once, each with ten times the damping of the one before.
    ftol, xtol
        When a step is too small to go on.
    """

    space: Space
    trials: int
    ftol: float
    xtol: float

    def iterate(self, state: State, model: LocalModel) -> Steps:
        """Try steps, with ever more damping, until one lowers the merit or none ever will."""
        damping = state.damping
        bolder = min(1, self.trials - 1)
        before = model.merit(state.at)
        while True:
            dampings = damping * DAMPING_RATIO ** (np.arange(float(self.trials)) - bolder)
            steps = np.array([model.step(d) for d in dampings])
            if self._negligible(state, model, steps[0]):
                return state, Ending.CONVERGED
            steps, dampings = _distinct(steps, dampings, model)
            state, trials = yield from self._try(state, model, "trial", steps, dampings)
            if self._bends(model, trials, before):
                curved, softer = curved_steps(model, trials, before)
                if len(curved):
                    state, more = yield from self._try(state, model, "curved", curved, softer)
                    trials = trials if trials.least <= more.least else more
                if isinstance(model, ConstrainedModel) and self._bends(model, trials, before):
                    probe = self._probe(state, model, trials, before)
                    if probe is not None and PROBE:
                        x, at = probe
                        edges = model.edges(x - state.x, at)
                        if edges:
                            cuts = state.knowledge.cuts.with_edges(edges)
                            knowledge = replace(state.knowledge, cuts=cuts)
                            state = replace(state, probe=probe, probes=state.probes + 1, knowledge=knowledge)
                            return state, None
            if trials.least < before:
                return self._accept(state, model, trials)
            damping = dampings[-1] * DAMPING_RATIO ** (1 + bolder)
            if damping > LARGEST_DAMPING:
                return state, Ending.STALLED

    def _try(
        self, state: State, model: LocalModel, purpose: str, steps: FloatArray, dampings: FloatArray
    ) -> Generator[Points, list[Evaluation], tuple[State, Trials]]:
        points = np.clip(state.x + steps, self.space.lower, self.space.upper)
        evaluations = yield Points(points, purpose, state.progress)
        merits = np.array([model.merit(at) for at in evaluations])
        trials = Trials(points, points - state.x, evaluations, merits, dampings)
        return state.seen(points, evaluations), trials

    def _bends(self, model: LocalModel, trials: Trials, before: float) -> bool:
        """Whether the boldest trial promised much more than the best one gained."""
        usable = np.flatnonzero(np.isfinite(trials.merits))
        if not len(usable):
            return False
        promised = model.gain(trials.steps[usable[0]])
        gained = max(before - trials.least, 0.0)
        return promised > max(PROMISED * gained, self.ftol * model.squares)

    def _probe(self, state, model, trials, before):
        if state.probes >= PROBE:
            return None
        gained = max(before - trials.least, 0.0)
        for i in range(len(trials.steps)):
            if not np.isfinite(trials.merits[i]):
                continue
            lost = model.gain(trials.steps[i]) - (before - trials.merits[i])
            if model.surprised(trials.steps[i], trials.evaluations[i]) > 0.5 * lost > 0.5*gained:
                return trials.points[i], trials.evaluations[i]
        return None

    def _accept(self, state: State, model: LocalModel, trials: Trials) -> Result:
        best = trials.best
        x, step, damping = trials.points[best], trials.steps[best], float(trials.dampings[best])
        expected = model.gain(step)
        gained = model.merit(state.at) - trials.least
        trusted = gained > 0.25 * expected
        if self.trials == 1 and trusted:
            damping /= DAMPING_RATIO
        new = state.moved(self.space, x, trials.evaluations[best], damping)
        new = replace(new, damping=min(max(damping, LEAST_DAMPING), LARGEST_DAMPING))
        small = max(gained, expected) <= self.ftol * model.squares
        short = np.all(np.abs(step) <= self.xtol * sizes(self.space, x))
        return new, Ending.CONVERGED if small or (short and trusted) else None

    def _negligible(self, state: State, model: LocalModel, step: FloatArray) -> bool:
        """Whether even the boldest step would change or gain nothing."""
        bold = state.damping <= 1.0
        return bold and (
            bool(np.all(np.abs(step) <= self.xtol * sizes(self.space, state.x)))
            or model.gain(step) <= 1e-3 * self.ftol * model.squares
        )


def _distinct(
    steps: FloatArray, dampings: FloatArray, model: LocalModel
) -> tuple[FloatArray, FloatArray]:
    """Without steps that hardly differ from a bolder one."""
    kept = [0]
    for i in range(1, len(steps)):
        change = np.linalg.norm(model.scale * (steps[i] - steps[kept[-1]]))
        if change > model.alike * np.linalg.norm(model.scale * steps[i]) or not model.alike:
            kept.append(i)
    return steps[kept], dampings[kept]
