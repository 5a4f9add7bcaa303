"""Fits models to the experiments of a search, and to synthetic experiments made from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.candidates.trajectory import LinearisedTrajectory, make_trajectory
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError
from cluster_est.methods.method import Ending, Evaluation, GivenPoints, Method
from cluster_est.problem.problem import Problem
from cluster_est.problem.process_noise import noise_names, without_noise
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.multistart import with_best_sensors
from cluster_est.running.resources import Record, TaskOrigin
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.records import StackedRecords
from cluster_est.statistics.whitening import deviance
from workers.fmu.description import ModelDescription
from workers.messages import Experiment, FloatArray, Outcome, Output, Want

SAMPLES_KEPT = 12
"""Smallest number of samples of each output that a shortened copy keeps."""


STEPS_OF_CANDIDATE = 100
"""Limit of the solver steps of a simulation with added effects, relative to those of the declared
model or to the number of samples, whichever is larger. A fast effect needs about one step for each
of its time constants. If this is a hundredth of the sampling interval, the data cannot show it."""


@dataclass(frozen=True)
class ShortenedCopy:
    """The first part of an experiment, as a share of its record."""

    share: float

    def of(self, experiment: Experiment) -> Experiment:
        stop = experiment.start + self.share * (experiment.stop - experiment.start)
        for output in experiment.outputs:
            if len(output.times):
                stop = max(stop, float(output.times[min(SAMPLES_KEPT, len(output.times)) - 1]))
        outputs = [output.only(output.times <= stop) for output in experiment.outputs]
        name = f"{experiment.id} (first {self.share:.0%})"
        return replace(experiment, id=name, stop=stop, outputs=tuple(outputs))


@dataclass(frozen=True)
class EnlargedCopy:
    """An experiment with inputs enlarged about their means, by a factor."""

    factor: float

    def of(self, experiment: Experiment) -> Experiment:
        means = [given.values.mean() for given in experiment.inputs]
        inputs = tuple(
            replace(given, values=np.asarray(mean + self.factor * (given.values - mean)))
            for given, mean in zip(experiment.inputs, means, strict=True)
        )
        name = f"{experiment.id} (inputs x {self.factor:g})"
        return replace(experiment, id=name, inputs=inputs)


SyntheticKind = ShortenedCopy | EnlargedCopy

SHORTENED = (ShortenedCopy(0.15), ShortenedCopy(0.4))
"""Copies to which other starts are fitted first, the shortest first. Benchmark."""

ENLARGED = EnlargedCopy(1.25)
"""Copies in which the outputs of a model must stay bounded. Benchmark."""


def with_outputs(problem: Problem, change: Callable[[int, Output], Output]) -> Problem:
    """Return the problem with each output replaced by `change(index of experiment, output)`."""
    experiments = [
        replace(experiment, outputs=tuple(change(e, output) for output in experiment.outputs))
        for e, experiment in enumerate(problem.experiments)
    ]
    return replace(problem, experiments=tuple(experiments))


class SimulationMeter:
    """Counts simulations in units of a whole experiment, and passes each one to a record.

    A shortened experiment counts by its share. The record receives the id and the key of the
    experiment, because synthetic experiments are not part of the problem.
    """

    def __init__(self, experiments: Sequence[Experiment], record: Record | None) -> None:
        longest = max(e.stop - e.start for e in experiments)
        self._parts = [(e.stop - e.start) / longest for e in experiments]
        self._names = [(e.id, e.key) for e in experiments]
        self._record = record
        self.full = 0.0

    def __call__(self, origin: TaskOrigin, outcome: Outcome) -> None:
        self.full += self._parts[origin.task.experiment]
        if self._record is not None:
            self._record(replace(origin, installed=self._names[origin.task.experiment]), outcome)


@dataclass(frozen=True)
class FittedModel:
    """A model with effects, fitted to the training experiments.

    Attributes
    ----------
    space, x
        The unknowns, and their values in search coordinates.
    residuals, jacobian : (N,), (N, unknowns)
    added
        The effects that the search has added, in order.
    converged
        Whether the fit has ended by its tolerances.
    steps_of_runs
        Number of solver steps in the simulation of each experiment of the space; 0 if they are not
        counted.
    """

    space: SearchSpace = field(repr=False)
    x: FloatArray
    residuals: FloatArray = field(repr=False)
    jacobian: FloatArray = field(repr=False)
    added: tuple[EffectCandidate, ...] = ()
    converged: bool = False
    steps_of_runs: tuple[int, ...] = ()

    @property
    def steps(self) -> int:
        """Number of solver steps in one simulation of every experiment of the space."""
        return sum(self.steps_of_runs)

    @property
    def problem(self) -> Problem:
        return self.space.problem

    @property
    def structure(self) -> frozenset[str]:
        """Names of the added effects, independent of their order."""
        return frozenset(candidate.effect.name for candidate in self.added)

    @property
    def start(self) -> FitStart:
        """The start of another fit of the same model from its current values."""
        known = self.estimates
        for candidate in self.added:
            known |= candidate.in_order(known)
        return FitStart(self.problem, known, self.added)

    def moved(self, position: int) -> FittedModel:
        """The same model, with its last effect moved to another position."""
        kept, last = self.added[:-1], self.added[-1]
        return replace(self, added=(*kept[:position], last, *kept[position:]))

    @property
    def sse(self) -> float:
        return float(np.add.reduce(self.residuals**2))

    @property
    def estimates(self) -> dict[str, float]:
        """Physical values by label."""
        return self.space.estimates(self.x)

    def coefficients(self, added: EffectCandidate) -> list[float]:
        """Values of the coefficients of an effect, estimated or held; some have one per experiment.

        For an experiment of the search that the fit does not contain, this is the start value.
        """
        known = {p.name: p.start for p in self.problem.parameters} | self.estimates
        found: list[float] = []
        for coefficient in added.form.coefficients:
            label = f"{added.effect.name}.{coefficient.name}"
            ends = [f"[{name}]" for name in added.experiments] if coefficient.each else [""]
            found += [float(known.get(f"{label}{end}", known[label])) for end in ends]
        return found

    def likelihood(self, records: StackedRecords) -> float:
        """-2 log likelihood, with the noise variance of each output estimated."""
        return deviance(self.residuals, records)

    def criterion(self, records: StackedRecords) -> float:
        """Bayesian information criterion (G. Schwarz, Ann. Stat. 6 (1978) 461-464)."""
        return float(self.likelihood(records) + self.space.size * np.log(len(self.residuals)))


@dataclass(frozen=True)
class FitStart:
    """A model to fit, with the start values of its unknowns."""

    problem: Problem
    values: Mapping[str, float]
    added: tuple[EffectCandidate, ...] = ()

    def plus(self, candidate: EffectCandidate, values: Sequence[float]) -> FitStart:
        """Return the start with one more effect, whose coefficients start from these values."""
        problem = replace(
            self.problem,
            effects=(*self.problem.effects, candidate.effect),
            parameters=(*self.problem.parameters, *candidate.parameters(values)),
        )
        known = {**self.values, **candidate.starts(values)}
        return FitStart(problem, known, (*self.added, candidate))

    def minus(self, position: int) -> FitStart:
        """Return the start without one of the added effects."""
        gone = self.added[position].effect.name
        problem = replace(
            self.problem,
            effects=tuple(e for e in self.problem.effects if e.name != gone),
            parameters=tuple(
                p for p in self.problem.parameters if not p.name.startswith(f"{gone}.")
            ),
        )
        kept = tuple(c for i, c in enumerate(self.added) if i != position)
        return FitStart(problem, self.values, kept)


@dataclass(frozen=True)
class Fitter:
    """Fits models to the training experiments, with one queue of simulations.

    The residuals are those of free simulations. With process noise, they are the innovations of a
    Kalman filter divided by their standard deviations (`predicts`).

    Attributes
    ----------
    runner
        Its executor has the experiments of the problem, followed by the synthetic ones.
    problem, description
        The declared model, and the description of its FMU.
    train, records
        Indices of the training experiments, and the stacked records of their residuals.
    synthetic
        For each kind of copy, the index of the copy of each training experiment.
    everything
        The problem with all experiments that the executor has.
    noise_of_samples
        By output, if records are thinned: the noise of the samples before thinning, in its unit.
    sigma_declared
        Whether the sigmas of the training experiments are declared; see `declares_sigma`.
    step_limits
        Step limit of simulations with added effects, by experiment; see `limited_by`.
    """

    runner: Runner
    problem: Problem
    description: ModelDescription
    seed: int
    train: tuple[int, ...]
    records: StackedRecords
    synthetic: Mapping[SyntheticKind, tuple[int, ...]]
    everything: Problem
    meter: SimulationMeter
    noise_of_samples: Mapping[str, float]
    sigma_declared: bool
    step_limits: Mapping[int, int] = field(default_factory=dict)

    def limited_by(self, declared: FittedModel) -> Fitter:
        """Return a fitter with step limits for simulations with effects that the search adds.

        For example, a fitted exponent may make the slope of a term infinite at 0. Then one
        simulation may need millions of steps. Beyond the limit it counts as failed. The declared
        model has no limit, and neither has a model whose steps are not counted.
        """
        limits: dict[int, int] = {}
        counted = zip(self.train, self.runs, declared.steps_of_runs, strict=False)
        for place, (index, run, steps) in enumerate(counted):
            samples = len(np.unique(np.concatenate([o.times for o in run.outputs])))
            limit = STEPS_OF_CANDIDATE * max(steps, samples) if steps else 0
            limits |= {copies[place]: limit for copies in self.synthetic.values()}
            limits[index] = limit
        return replace(self, step_limits=limits)

    @cached_property
    def predicts(self) -> bool:
        """Whether residuals are one-step prediction errors, because there is process noise."""
        return bool(noise_names(self.problem))

    @property
    def by_linear_systems(self) -> bool:
        """Whether linear systems give the directions of candidates; else each is simulated.

        In co-simulation the states are not accessible, and with process noise a filter corrects
        them.
        """
        return self.exchange and not self.predicts

    @property
    def size(self) -> int:
        return self.records.size

    @property
    def runs(self) -> tuple[Experiment, ...]:
        """The training experiments."""
        return tuple(self.problem.experiments[e] for e in self.train)

    @property
    def exchange(self) -> bool:
        return self.problem.model.interface == "model_exchange"

    def enter(self, phase: str) -> None:
        """Set the phase that the progress display shows."""
        self.runner.display.phase = phase

    def compared(self, done: int, of: int) -> None:
        """Show in the progress display how many candidates were compared with the residual."""
        self.runner.display.step(LoopStage.TRAJECTORIES.value, done, of)

    def noise_floor(self, noise: FloatArray) -> float:
        """The sum of squares that noise alone would leave; always positive."""
        sizes = list(map(len, self.records.by_output(self.sigmas)))
        return max(float(np.nansum(noise**2 * np.array(sizes))), 1e-300)

    def noise_in_units(self, noise: FloatArray) -> dict[str, float]:
        """The noise of each output in its own unit, from the noise in units of its residuals.

        If sigmas differ between samples, their root mean square over all samples is used.
        """
        found, sigmas = {}, self.records.by_output(self.sigmas)
        for name, level, own in zip(self.records.outputs, noise, sigmas, strict=True):
            equal = not len(own) or bool(np.all(own == own[0]))
            sigma = (own[0] if len(own) else 1.0) if equal else np.sqrt(np.mean(own**2))
            found[name] = float(level * sigma)
        return found

    @property
    def sigmas(self) -> FloatArray:
        """The sigma of each residual, (N,)."""
        return np.concatenate([o.sigmas for run in self.runs for o in run.outputs])

    def generator(self, stream: int) -> np.random.Generator:
        """Return a separate generator for each use, so that uses do not change each other."""
        return np.random.default_rng([self.seed, stream])

    def space(self, start: FitStart, kind: SyntheticKind | None = None) -> SearchSpace:
        """Make the search space of a model for the training experiments, or for their copies."""
        if kind is None:
            return make_space(start.problem, self.train, starts=start.values)
        experiments = self.synthetic[kind]
        problem = replace(start.problem, experiments=self.everything.experiments)
        if isinstance(kind, EnlargedCopy):
            problem = without_noise(problem)  # no measurements that a filter could follow
        values = dict(start.values)
        names = {p.name for p in problem.parameters}
        for own, copy in zip(self.train, experiments, strict=True):
            ids = [self.everything.experiments[i].id for i in (own, copy)]
            for label, value in start.values.items():
                if label not in names and label.endswith(f"[{ids[0]}]"):
                    values[f"{label.removesuffix(f'[{ids[0]}]')}[{ids[1]}]"] = value
        return make_space(problem, experiments, starts=values)

    def measured_estimates(self, fitted: FittedModel, kind: SyntheticKind) -> dict[str, float]:
        """Return estimates from copies with the labels of the measured experiments; see `space`."""
        experiments = self.everything.experiments
        names = {
            experiments[copy].id: experiments[own].id
            for own, copy in zip(self.train, self.synthetic[kind], strict=True)
        }
        values = {}
        for unknown in fitted.space.unknowns:
            name, scope = unknown.parameter.name, unknown.scope
            label = f"{name}[{names.get(scope, scope)}]" if scope else name
            values[label] = fitted.estimates[unknown.label]
        return values

    def fit(
        self,
        stage: LoopStage,
        starts: Sequence[FitStart],
        method: Method,
        kind: SyntheticKind | None = None,
    ) -> list[FittedModel | None]:
        """Fit several models in one queue; None for a model that cannot be simulated."""
        spaces = [self._begun(self.space(start, kind)) for start in starts]
        requests = [self.request(stage, method, space) for space in spaces]
        fitted: list[FittedModel | None] = []
        for start, space, found in zip(starts, spaces, self.runner.run(requests), strict=True):
            if found.at is None or found.jacobian is None or not found.at.ok:
                fitted.append(None)
                continue
            fitted.append(
                FittedModel(
                    space,
                    found.x,
                    found.at.residuals,
                    found.jacobian,
                    start.added,
                    found.ending is Ending.CONVERGED,
                    tuple(outcome.steps for outcome in found.at.outcomes),
                )
            )
        return fitted

    def request(self, stage: LoopStage, method: Method, space: SearchSpace) -> SearchRequest:
        """Make the request of a parameter search, with step limits if it has added effects."""
        added = space.problem.effects != self.problem.effects
        limits = self.step_limits if added else {}
        return SearchRequest(stage.value, method, space, self.seed, limits)

    def _begun(self, space: SearchSpace) -> SearchSpace:
        """Return the space with the best start values of unknown scales and offsets of sensors."""
        return space.starting_at(with_best_sensors(self.runner, space, space.start[None])[0])

    def evaluate(
        self, stage: LoopStage, points: Sequence[tuple[SearchSpace, FloatArray]]
    ) -> list[tuple[Evaluation, ...]]:
        """Evaluate points of several spaces, all in one queue."""
        requests = [self.request(stage, GivenPoints(x, stage.value), space) for space, x in points]
        return [solution.evaluations for solution in self.runner.run(requests)]

    def simulate(
        self,
        problem: Problem,
        experiments: tuple[int, ...],
        known: Mapping[str, float],
        want: Want,
        stage: str,
    ) -> Sequence[Outcome]:
        """Simulate experiments of a problem; parameters without a known value keep their start."""
        space = make_space(problem, experiments, known)
        values = space.physical(space.start)
        return self.runner.simulate(values, experiments, want, stage, problem.effects)

    def trajectories(self, fitted: FittedModel) -> list[LinearisedTrajectory]:
        """Simulate and linearise the training experiments at a fit."""
        want: Want = "linearisation" if self.exchange else "trajectory"
        outcomes = self.runner.simulate(
            fitted.space.physical(fitted.x),
            self.train,
            want,
            LoopStage.TRAJECTORIES.value,
            fitted.problem.effects,
        )
        for outcome in outcomes:
            if not outcome.ok:
                raise ProblemError(
                    f"close-loop: the fitted model could not be simulated again "
                    f"({outcome.status}: {outcome.message}); run cluster-est check to "
                    "see whether simulations are repeatable"
                )
        return [
            make_trajectory(run, outcome, self.description.states)
            for run, outcome in zip(self.runs, outcomes, strict=True)
        ]
