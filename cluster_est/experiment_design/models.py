"""The models of a design: estimates, their covariance, and the noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.least_squares.levenberg_marquardt import LeastSquares
from cluster_est.methods.method import Solution
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.projection import inverse
from cluster_est.uncertainty import assess
from workers.messages import FloatArray

SETTLE = LeastSquares(trials=1, max_iterations=30, ftol=1e-8, xtol=1e-6, differences="central")
DEVIATION_OF_UNDETERMINED = 10.0
"""Standard deviation of an unknown about which nothing is known, in ranges between its bounds or
noticeable changes. It is so large that it does not influence the information of the data."""
DEVIATION_AT_BOUND = 1e-6
"""Standard deviation of an unknown that a fit holds at a bound, in ranges between its bounds or
noticeable changes."""
MOVED = 0.5
"""Largest change of an estimate by a refit without a message, as a share of its standard error."""


@dataclass(frozen=True)
class CandidateModel:
    """A model that may be true, before it is refitted.

    Attributes
    ----------
    name
        Labels of its effects, or its name in sentences.
    problem
        The problem with its effects, and the experiments to which it was fitted.
    values
        Estimates by label, from which a fit starts.
    weight
        Probability that it is the true model, according to the data.
    """

    name: str
    problem: Problem = field(repr=False)
    values: Mapping[str, float] = field(repr=False)
    weight: float = 1.0


@dataclass(frozen=True)
class PredictedOutput:
    """An output whose prediction should become accurate.

    Attributes
    ----------
    experiment, output, unit
        The output.
    jacobian : (samples, unknowns)
        Derivatives of the model's prediction by its unknowns, in search coordinates.
    """

    experiment: str
    output: str
    unit: str
    jacobian: FloatArray = field(repr=False)

    @cached_property
    def squares(self) -> FloatArray:
        """J' J over the number of samples: the mean variance is the sum of it times C."""
        return np.asarray(self.jacobian.T @ self.jacobian / len(self.jacobian))


@dataclass(frozen=True)
class FittedCandidate:
    """A model, fitted to the training experiments.

    Attributes
    ----------
    model
        The model.
    space, x
        Its unknowns on the training experiments, and the estimates in search coordinates.
    information : (unknowns, unknowns)
        Inverse of the covariance of the estimates.
    squares
        Sum of the squared residuals, over the variance of the noise.
    held
        Labels of the unknowns that are at a bound.
    notes
        Sentences on differences between this fit and the run's estimates.
    targets
        Outputs to predict.
    """

    model: CandidateModel
    space: SearchSpace = field(repr=False)
    x: FloatArray = field(repr=False)
    information: FloatArray = field(repr=False)
    squares: float = 0.0
    held: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    targets: tuple[PredictedOutput, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(unknown.label for unknown in self.space.unknowns)

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the estimates, (unknowns, unknowns)."""
        return inverse(self.information)

    def prior_information(self, space: SearchSpace) -> FloatArray:
        """Return the information of the data on the unknowns of a new experiment.

        The result is (unknowns, unknowns). Unknowns shared with earlier experiments have the
        marginal information of these. Other unknowns have the information that they have before any
        experiment.
        """
        places = {label: i for i, label in enumerate(self.labels)}
        shared = [i for i, u in enumerate(space.unknowns) if u.label in places]
        found = np.diag(1.0 / widths(space) ** 2)
        if shared:
            there = [places[space.unknowns[i].label] for i in shared]
            found[np.ix_(shared, shared)] = inverse(self.covariance[np.ix_(there, there)])
        return np.asarray(found)


@dataclass(frozen=True)
class NoiseOfOutputs:
    """The noise of a new experiment.

    Attributes
    ----------
    sizes
        Standard deviation of the first model's residuals by output, over its sigma.
    inflation
        Factor by which standard errors are larger than for white noise, as in the fit's own
        intervals; 1 for white noise. All noise is multiplied by it.
    """

    sizes: Mapping[str, float]
    inflation: float

    def over_sigma(self, output: str) -> float:
        """Return the assumed standard deviation of an output's noise, over its sigma."""
        return max(self.sizes.get(output, 1.0) * self.inflation, 1e-12)


def fit_candidates(
    runner: Runner, models: Sequence[CandidateModel], seed: int
) -> tuple[list[FittedCandidate], NoiseOfOutputs]:
    """Fit models to the training experiments from their estimates, all in one queue.

    Parameters
    ----------
    runner
        Its executor has the models' experiments.
    models
        The models to fit.
    seed
        Seed of the fits.

    Returns
    -------
    list of FittedCandidate
        In the order of the models.
    NoiseOfOutputs
        Noise estimated from the residuals of the first model.

    Raises
    ------
    ProblemError
        If a model cannot be simulated.
    """
    spaces = [make_space(m.problem, m.problem.indices("train"), starts=m.values) for m in models]
    requests = [SearchRequest("models", SETTLE, space, seed) for space in spaces]
    solutions = runner.run(requests)
    for model, solution in zip(models, solutions, strict=True):
        if solution.jacobian is None or solution.at is None or not solution.at.ok:
            why = solution.message or str(solution.ending)
            raise ProblemError(
                f"{model.name}: a design needs a simulation with the estimates of the run, but "
                f"this simulation failed ({why})"
            )
    found = assess(spaces[0], solutions[0]).intervals
    ratios = np.array([each.std_error / each.error_white for each in found])
    known = ratios[np.isfinite(ratios)]
    inflation = max(float(np.median(known)), 1.0) if len(known) else 1.0
    noise = NoiseOfOutputs(_sizes(spaces[0], solutions[0]), inflation)
    fitted = [
        _fitted(model, space, solution, noise)
        for model, space, solution in zip(models, spaces, solutions, strict=True)
    ]
    return fitted, noise


def _sizes(space: SearchSpace, solution: Solution) -> dict[str, float]:
    """Return the root mean square of each output's residuals, which are in units of its sigma."""
    assert solution.at is not None
    residuals = solution.at.residuals
    freedom = len(residuals) / max(len(residuals) - space.size, 1)
    found: dict[str, list[FloatArray]] = {}
    for name, rows in _rows(space):
        found.setdefault(name, []).append(residuals[rows])
    own = {name: np.concatenate(parts) for name, parts in found.items()}
    return {
        name: float(np.sqrt(freedom * np.mean(each**2))) if len(each) else 1.0
        for name, each in own.items()
    }


def _rows(space: SearchSpace) -> Iterator[tuple[str, slice]]:
    """Yield the rows of each output of each experiment; rows of priors follow them."""
    for e, rows in zip(space.experiments, space.rows, strict=True):
        first = rows.start
        for output in space.problem.experiments[e].outputs:
            yield output.variable, slice(first, first + len(output.times))
            first += len(output.times)


def widths(space: SearchSpace) -> FloatArray:
    """Return the prior standard deviation of each unknown: many ranges, or noticeable changes."""
    span = space.upper - space.lower
    bounded = np.isfinite(span) & (span > 0.0)
    size = np.maximum(space.typical, np.abs(space.start))
    return DEVIATION_OF_UNDETERMINED * np.where(bounded, np.where(bounded, span, 0.0), size)


def _fitted(
    model: CandidateModel, space: SearchSpace, solution: Solution, noise: NoiseOfOutputs
) -> FittedCandidate:
    assert solution.jacobian is not None
    assert solution.at is not None
    sizes, plain = np.ones(len(solution.jacobian)), np.ones(len(solution.jacobian))
    for name, rows in _rows(space):
        sizes[rows] = noise.over_sigma(name)
        plain[rows] = max(noise.sizes[name], 1e-12)
    tall = solution.jacobian / sizes[:, None]
    own = widths(space)
    bounds = [each.at_bound for each in assess(space, solution).intervals]
    held = [u.label for u, bound in zip(space.unknowns, bounds, strict=True) if bound]
    own[[bool(bound) for bound in bounds]] *= DEVIATION_AT_BOUND
    information = tall.T @ tall + np.diag(1.0 / own**2)
    squares = float(np.add.reduce((solution.at.residuals / plain) ** 2))
    found = FittedCandidate(model, space, solution.x, np.asarray(information), squares, tuple(held))
    return FittedCandidate(
        model, space, solution.x, found.information, squares, found.held,
        tuple(_notes(found, solution)),
    )  # fmt: skip


def _notes(found: FittedCandidate, solution: Solution) -> Iterator[str]:
    """Yield differences between this fit and that of the run."""
    name = found.model.name
    if not solution.ending.success:
        yield f"the fit of {name} for the design did not converge ({solution.ending})"
    moved = np.abs(found.x - found.space.start)
    errors = np.sqrt(np.diag(found.covariance))
    far = [
        label
        for label, step, error in zip(found.labels, moved, errors, strict=True)
        if label not in found.held and step > MOVED * error
    ]
    if far:
        yield (
            f"the new fit of {name} for the design differs from the run by more than half a "
            f"standard error in {', '.join(far[:3])}{' and others' if len(far) > 3 else ''}; the "
            "run may not have converged, or may have had constraints on signals"
        )
    if found.held:
        yield (
            f"{', '.join(found.held[:3])} of {name} {'was' if len(found.held) == 1 else 'were'} at "
            f"a bound and {'is' if len(found.held) == 1 else 'are'} kept there"
        )
