"""Fit a structure from given starts: only for scoring, where the truth may be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from cluster_est import LeastSquares, Problem, Resources
from cluster_est.methods.method import Solution
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest

METHOD = LeastSquares(differences="forward", max_iterations=40, ftol=1e-8, xtol=1e-8)


@dataclass(frozen=True)
class Refit:
    """A structure fitted to the training runs.

    Attributes
    ----------
    sse
        Sum of squares over all training runs, in standard deviations of the noise.
    train, test
        The same as root mean squares, on training and on held-out runs.
    values
        Estimates by label.
    """

    sse: float
    train: float
    test: float
    values: dict[str, float]


def refit(problem: Problem, starts: Mapping[str, float], held_out: bool = True) -> Refit:
    """Fit a problem to its training runs.

    Parameters
    ----------
    problem
        With the effects of the structure.
    starts
        Where to start, by label; the parameter's own start where a label is missing.
    held_out
        Whether to follow the held-out runs too. What belongs to those alone, an unknown initial
        state, is fitted to them.

    Returns
    -------
    Refit
        NaN where a simulation failed.
    """
    training, others = problem.indices("train"), problem.indices("test")
    with open_executor(problem, Resources()) as executor:
        runner = Runner(executor)
        space = _from(make_space(problem, training), starts)
        solution = _search(runner, space)
        values, test = space.estimates(solution.x), np.nan
        if held_out and others:
            there = _from(make_space(problem, others, values), starts)
            test = _rms(problem, others, _follow(runner, there))
    sse = solution.cost
    return Refit(sse, _rms(problem, training, sse), test, values)


def _from(space: SearchSpace, starts: Mapping[str, float]) -> SearchSpace:
    """Move the start of every unknown that has one given, into its bounds."""
    unknowns = []
    for unknown in space.unknowns:
        low, high = unknown.parameter.lower, unknown.parameter.upper
        start = float(np.clip(starts.get(unknown.label, unknown.start), low, high))
        unknowns.append(replace(unknown, start=start))
    return replace(space, unknowns=tuple(unknowns))


def _search(runner: Runner, space: SearchSpace) -> Solution:
    (solution,) = runner.run([SearchRequest("refit", METHOD, space)])
    return solution


def _follow(runner: Runner, space: SearchSpace) -> float:
    """Return the sum of squares on runs whose shared values are known."""
    if space.size:
        return _search(runner, space).cost
    values, effects = space.physical(space.start), space.problem.effects
    outcomes = runner.simulate(values, space.experiments, "residuals", "refit", effects)
    residuals = [o.residuals for o in outcomes if o.residuals is not None]
    if len(residuals) < len(outcomes):
        return np.nan
    return space.problem.cost.value(np.concatenate(residuals), space.outputs)


def _rms(problem: Problem, runs: tuple[int, ...], sse: float) -> float:
    return float(np.sqrt(sse / sum(problem.experiments[run].size for run in runs)))
