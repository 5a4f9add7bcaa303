"""The models that a design reckons with: estimates, their covariance, and the noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.methods.base import Solution
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.problem import Problem
from cluster_est.problem.space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import FloatArray

SETTLE = LeastSquares(trials=1, max_iterations=15, ftol=1e-8, xtol=1e-6, differences="central")
WIDE = 10.0
"""Noticeable changes of an unknown that are its standard deviation where nothing is known of it."""


@dataclass(frozen=True)
class CandidateModel:
    """A model that may be the true one, before its estimates are known in detail.

    Attributes
    ----------
    name
        Labels of its effects, or what a sentence calls it.
    problem
        With its effects, and the experiments that it was fitted to.
    values
        Estimates by label, from which a fit starts.
    weight
        Probability that it is the true one, as far as the data say.
    """

    name: str
    problem: Problem = field(repr=False)
    values: Mapping[str, float] = field(repr=False)
    weight: float = 1.0


@dataclass(frozen=True)
class FittedCandidate:
    """A model, fitted to the training experiments.

    Attributes
    ----------
    model
        Which.
    space, x
        Its unknowns on the training experiments, and the estimates in search coordinates.
    information : (unknowns, unknowns)
        Inverse of the covariance of the estimates, with what is known of them without data.
    squares
        Sum of the squared residuals, over the variance of the noise.
    """

    model: CandidateModel
    space: SearchSpace = field(repr=False)
    x: FloatArray = field(repr=False)
    information: FloatArray = field(repr=False)
    squares: float = 0.0

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(unknown.label for unknown in self.space.unknowns)

    @property
    def covariance(self) -> FloatArray:
        """Of the estimates, (unknowns, unknowns)."""
        return np.asarray(np.linalg.inv(self.information))

    def prior_information(self, space: SearchSpace) -> FloatArray:
        """What the data so far say of the unknowns of a new experiment, (unknowns, unknowns).

        What it shares with earlier ones is known from those, the rest marginalised. What is its own
        is known as little as before any experiment.
        """
        places = {label: i for i, label in enumerate(self.labels)}
        shared = [i for i, u in enumerate(space.unknowns) if u.label in places]
        found = np.diag(1.0 / widths(space) ** 2)
        if shared:
            there = [places[space.unknowns[i].label] for i in shared]
            block = self.covariance[np.ix_(there, there)]
            found[np.ix_(shared, shared)] = np.linalg.inv(block)
        return np.asarray(found)


def fit_candidates(
    runner: Runner, models: Sequence[CandidateModel], seed: int
) -> tuple[list[FittedCandidate], dict[str, float]]:
    """Fit models to the training experiments from their estimates, all in one queue.

    Parameters
    ----------
    runner
        Its executor has the models' experiments.
    models
        What to fit.
    seed
        Of the fits.

    Returns
    -------
    list of FittedCandidate
        In the order of the models.
    dict
        Standard deviation of each output's noise over its sigma, from what the first model leaves.

    Raises
    ------
    ProblemError
        If one cannot be simulated.
    """
    spaces = [make_space(m.problem, m.problem.indices("train"), starts=m.values) for m in models]
    requests = [
        SearchRequest(f"fit {model.name}", SETTLE, space, seed)
        for model, space in zip(models, spaces, strict=True)
    ]
    solutions = runner.run(requests)
    for model, solution in zip(models, solutions, strict=True):
        if solution.jacobian is None or solution.at is None or not solution.at.ok:
            why = solution.message or str(solution.ending)
            raise ProblemError(
                f"{model.name}: must be simulated with the estimates of the run to plan an "
                f"experiment but was not ({why})"
            )
    noise = _noise(spaces[0], solutions[0])
    fitted = [
        _fitted(model, space, solution, noise)
        for model, space, solution in zip(models, spaces, solutions, strict=True)
    ]
    return fitted, noise


def _noise(space: SearchSpace, solution: Solution) -> dict[str, float]:
    """Root mean square of each output's residuals, which are in units of its sigma."""
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
    """The rows of each output of each experiment; those of priors stand behind them."""
    for e, rows in zip(space.experiments, space.rows, strict=True):
        first = rows.start
        for output in space.problem.experiments[e].outputs:
            yield output.variable, slice(first, first + len(output.times))
            first += len(output.times)


def widths(space: SearchSpace) -> FloatArray:
    """Standard deviation of each unknown before any data: of its range, else a wide one."""
    span = space.upper - space.lower
    bounded = np.isfinite(span) & (span > 0.0)
    wide = WIDE * np.maximum(space.typical, np.abs(space.start))
    return np.where(bounded, np.where(bounded, span, 0.0) / np.sqrt(12.0), wide)


def _fitted(
    model: CandidateModel, space: SearchSpace, solution: Solution, noise: Mapping[str, float]
) -> FittedCandidate:
    assert solution.jacobian is not None
    assert solution.at is not None
    sizes = np.ones(len(solution.jacobian))
    for name, rows in _rows(space):
        sizes[rows] = max(noise[name], 1e-12)
    tall = solution.jacobian / sizes[:, None]
    information = tall.T @ tall + np.diag(1.0 / widths(space) ** 2)
    squares = float(np.add.reduce((solution.at.residuals / sizes) ** 2))
    return FittedCandidate(model, space, solution.x, np.asarray(information), squares)
