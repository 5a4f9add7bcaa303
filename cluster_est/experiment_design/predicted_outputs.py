"""Predictions of models for candidates: outputs and their derivatives, simulated on the queue."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np

from cluster_est.errors import ProblemError
from cluster_est.experiment_design.candidate_inputs import CandidateInput
from cluster_est.experiment_design.models import FittedCandidate, PredictedOutput
from cluster_est.methods.method import TOLERANCE, Evaluation, GivenPoints
from cluster_est.problem.compatibility import without_priors
from cluster_est.problem.costs import SumSquared
from cluster_est.problem.problem import Problem
from cluster_est.problem.search_space import SearchSpace, make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.statistics.projection import inverse, root_of_inverse
from workers.messages import Experiment, FloatArray

StepResult = TypeVar("StepResult")


class DesignQueue:
    """Opens workers for the experiments of each step, and counts simulations.

    Parameters
    ----------
    environment
        Workers, budget and callbacks.
    problem
        The problem whose model is simulated.
    """

    def __init__(self, environment: RunEnvironment, problem: Problem) -> None:
        self._environment, self._problem = environment, problem
        self._begin = time.monotonic()
        self.evaluations, self.simulations, self.failures = 0, 0, 0

    def use(
        self, experiments: Sequence[Experiment], phase: str, step: Callable[[Runner], StepResult]
    ) -> StepResult:
        """Perform a step with a runner whose executor has these experiments.

        Raises
        ------
        ClusterEstError
            If there are no workers, or the budget is used up.
        """
        problem = replace(self._problem, experiments=tuple(experiments))
        environment = self._environment.left(self.evaluations, time.monotonic() - self._begin)
        with environment.executor(problem) as executor:
            runner = environment.runner(executor, record=environment.record_of(problem), whole=True)
            runner.display.phase = phase
            try:
                return step(runner)
            finally:
                self.evaluations += runner.evaluations
                self.simulations += runner.simulations
                self.failures += runner.failures


FLAT = 1e-9
"""Singular value of the changes of all unknowns, in units of their sizes, that counts as 0."""
BROKEN = "the simulations for the derivatives failed"
LONGEST_DIFFERENCE = 0.1
"""Largest step of a difference, as a share of an unknown, or of a noticeable change if that is
larger."""


@dataclass(frozen=True)
class PredictedExperiment:
    """The prediction of one model for one candidate, in standard deviations of the noise.

    Attributes
    ----------
    outputs : (samples,)
        Output after output.
    jacobian : (samples, unknowns)
        Derivatives of the outputs by the unknowns, in search coordinates.
    information : (unknowns, unknowns)
        Information on the unknowns before the experiment.
    labels
        Labels of the unknowns.
    """

    outputs: FloatArray
    jacobian: FloatArray
    information: FloatArray
    labels: tuple[str, ...] = field(default=())

    @property
    def factor(self) -> FloatArray:
        """L with L L' the covariance of the outputs due to the unknowns, (samples, unknowns)."""
        return np.asarray(self.jacobian @ root_of_inverse(self.information))

    @property
    def posterior(self) -> FloatArray:
        """Covariance of the unknowns after the experiment, (unknowns, unknowns)."""
        return inverse(self.information + self.jacobian.T @ self.jacobian)


def keeping_limits(
    runner: Runner, fitted: Sequence[FittedCandidate], candidates: Sequence[CandidateInput]
) -> list[tuple[float, str]]:
    """Return the largest violation of limits by each candidate with any model, and the limit.

    Parameters
    ----------
    runner
        Its executor has the candidates' experiments, in their order.
    fitted, candidates
        Models and candidates; each candidate is simulated with each model.

    Returns
    -------
    list of tuple
        The largest violation, in the range of the limits, 0 if there is none and infinite if a
        simulation failed; and the violated limit, or the reason of the failure.
    """
    everything = range(len(candidates))
    spaces = [candidate_spaces(model, candidates, everything) for model in fitted]
    requests = [
        SearchRequest("candidates", GivenPoints(space.start[None], "candidate"), space)
        for own in spaces
        for space in own
    ]
    solutions = runner.run(requests)
    found: list[tuple[float, str]] = []
    for number in range(len(candidates)):
        worst = (0.0, "")
        for own in range(len(fitted)):
            (at,) = solutions[own * len(candidates) + number].evaluations
            if not at.ok:
                worst = (np.inf, at.reason)
            elif at.violation > worst[0]:
                name = spaces[own][number].constraint_names[int(np.argmax(at.constraints))]
                worst = (at.violation, limit_name(name))
        found.append(worst)
    return found


def limit_name(constraint: str) -> str:
    """Return the key of a limit: "signals.y.upper", of the constraint "signals.y upper [exp]"."""
    return constraint.partition(" [")[0].replace(" ", ".")


def predictions(
    runner: Runner,
    fitted: Sequence[FittedCandidate],
    candidates: Sequence[CandidateInput],
    chosen: Sequence[int],
) -> list[tuple[PredictedExperiment, ...] | str]:
    """Return the prediction of each model for each chosen candidate, or why it is missing.

    Derivatives are differences over a standard deviation of the estimates to either side, as in an
    unscented transform (S. J. Julier, J. K. Uhlmann, Proc. IEEE 92 (2004) 401-422,
    doi:10.1109/JPROC.2003.823141). If a mass sticks or a valve closes, a small change does not show
    the influence of a probable change. A candidate that violates its limits at these points is
    rejected.

    Parameters
    ----------
    runner
        Its executor has the candidates' experiments, in their order.
    fitted, candidates
        Models, and all candidates.
    chosen
        Numbers of the candidates to predict.
    """
    each = [candidate_spaces(model, candidates, chosen) for model in fitted]
    pairs = [
        (model, space) for own in zip(*each, strict=True)
        for model, space in zip(fitted, own, strict=True)
    ]  # fmt: skip
    points = [sigma_points(space, model.prior_information(space)) for model, space in pairs]
    requests = [
        SearchRequest("candidates", GivenPoints(x, "candidate"), space)
        for x, (_, space) in zip(points, pairs, strict=True)
    ]
    solutions = runner.run(requests)
    found = [
        predicted_experiment(model, space, x, solution.evaluations)
        for (model, space), x, solution in zip(pairs, points, solutions, strict=True)
    ]
    whole: list[tuple[PredictedExperiment, ...] | str] = []
    for first in range(0, len(found), len(fitted)):
        own = found[first : first + len(fitted)]
        reasons = [one for one in own if isinstance(one, str)]
        known = tuple(one for one in own if not isinstance(one, str))
        whole.append(reasons[0] if reasons else known)
    return whole


def sigma_points(space: SearchSpace, information: FloatArray) -> FloatArray:
    """Return the estimates, and points a standard deviation to either side along each axis.

    The axes are those of a root of the covariance. If little is known, steps are limited by
    noticeable changes.

    Parameters
    ----------
    space
        Its start values are the estimates.
    information : (unknowns, unknowns)
        Information on the unknowns.

    Returns
    -------
    (1 + 2 unknowns, unknowns)
        Points within the bounds.
    """
    steps = root_of_inverse(information).T
    most = LONGEST_DIFFERENCE * np.maximum(space.typical, np.abs(space.start))
    longest = np.max(np.abs(steps) / most, axis=1, initial=0.0)
    steps = steps / np.maximum(longest, 1.0)[:, None]
    points = np.vstack([space.start, space.start + steps, space.start - steps])
    return np.asarray(np.clip(points, space.lower, space.upper))


def _derivatives(moves: FloatArray, changes: FloatArray) -> FloatArray | None:
    """Return J with moves J' = changes, (samples, unknowns); None for rank deficient moves."""
    sizes = np.abs(moves).max(axis=0)
    scaled = moves / np.where(sizes > 0.0, sizes, 1.0)
    lengths = np.linalg.norm(scaled, axis=1)
    if not ((sizes > 0.0).all() and (lengths > 0.0).all()):
        return None
    scaled /= lengths[:, None]
    if np.linalg.matrix_rank(scaled, tol=FLAT) < len(scaled):
        return None
    return np.asarray((np.linalg.solve(scaled, changes / lengths[:, None]) / sizes[:, None]).T)


def predicted_experiment(
    model: FittedCandidate,
    space: SearchSpace,
    points: FloatArray,
    evaluations: Sequence[Evaluation],
) -> PredictedExperiment | str:
    """Return the prediction from sigma points, or the reason why it is missing.

    Derivatives are one-sided if one of two points could not be simulated.

    Parameters
    ----------
    model, space
        The model, and its unknowns in the experiment.
    points, evaluations
        See `sigma_points`; the first point was simulated.
    """
    count = space.size
    leaving = [at for at in evaluations if at.ok and at.violation > TOLERANCE]
    if leaving:
        name = space.constraint_names[int(np.argmax(leaving[0].constraints))]
        return f"{limit_name(name)} with parameters one standard deviation away"
    changes, moves = [], []
    for i in range(1, 1 + count):
        ends = [k for k in (i, i + count) if evaluations[k].ok]
        if not ends:
            return BROKEN
        first, last = ends[0], ends[1] if len(ends) > 1 else 0
        changes.append(evaluations[first].residuals - evaluations[last].residuals)
        moves.append(points[first] - points[last])
    jacobian = np.zeros((len(evaluations[0].residuals), count))
    if count:
        found = _derivatives(np.array(moves), np.array(changes))
        if found is None:
            return BROKEN
        jacobian = found
    labels = tuple(unknown.label for unknown in space.unknowns)
    outputs = -evaluations[0].residuals
    return PredictedExperiment(outputs, -jacobian, model.prior_information(space), labels)


def candidate_spaces(
    fitted: FittedCandidate, candidates: Sequence[CandidateInput], chosen: Sequence[int]
) -> list[SearchSpace]:
    """Return the unknowns of a model in each chosen candidate, at its estimates.

    Unknowns of a new experiment alone start from the mean of those of the earlier experiments.
    """
    problem = replace(
        without_priors(fitted.model.problem),
        experiments=tuple(candidate.experiment for candidate in candidates),
        constraints=(),
        cost=SumSquared(),
    )
    values = fitted.space.estimates(fitted.x)
    for number in chosen:
        values |= own_starts(fitted, candidates[number].name)
    return [make_space(problem, (number,), starts=values) for number in chosen]


def own_starts(fitted: FittedCandidate, experiment: str) -> dict[str, float]:
    """Return the estimates by label, with starts for the unknowns of a new experiment alone.

    These are the means of the estimates for the earlier experiments.
    """
    values = fitted.space.estimates(fitted.x)
    own: dict[str, list[float]] = {}
    for unknown in fitted.space.unknowns:
        if unknown.scope:
            own.setdefault(unknown.parameter.name, []).append(values[unknown.label])
    return values | {f"{name}[{experiment}]": float(np.mean(known)) for name, known in own.items()}


def with_predictions(
    queue: DesignQueue,
    fitted: FittedCandidate,
    experiments: Sequence[Experiment],
    units: Mapping[str, str],
) -> FittedCandidate:
    """Return a model with its predictions for some experiments.

    As for candidates, derivatives are differences over a standard deviation of the estimates to
    either side. Unknowns of such an experiment alone, such as its initial state, are held.

    Parameters
    ----------
    queue
        Queue of the simulations.
    fitted
        The model, at its estimates.
    experiments
        Experiments with the outputs to predict, see `target_experiments`.
    units
        Units of the outputs, by name.

    Raises
    ------
    ProblemError
        If an experiment cannot be simulated, or no prediction depends on an unknown.
    BudgetError
        If the budget is used up.
    """
    spaces = [_space(fitted, experiments, number) for number in range(len(experiments))]
    points = [sigma_points(space, fitted.prior_information(space)) for space in spaces]
    requests = [
        SearchRequest("predictions", GivenPoints(x, "prediction"), space)
        for x, space in zip(points, spaces, strict=True)
    ]
    solutions = queue.use(
        experiments, "predicting with the estimates", lambda runner: runner.run(requests)
    )
    found: list[PredictedOutput] = []
    for experiment, space, x, solution in zip(experiments, spaces, points, solutions, strict=True):
        at = solution.evaluations[0]
        predicted = (
            predicted_experiment(fitted, space, x, solution.evaluations) if at.ok else at.reason
        )
        if isinstance(predicted, str):
            raise ProblemError(
                f"predictions: experiment {experiment.id!r} must be simulated with the estimates "
                "and with values one standard deviation away, but a simulation failed "
                f"({predicted}); name other experiments"
            )
        found += _outputs(fitted, experiment, predicted, units)
    moved = tuple(each for each in found if each.jacobian.any())
    if not moved:
        raise ProblemError(
            "predictions: must depend on estimates of the run, but none does; name other outputs"
        )
    return replace(fitted, targets=moved, notes=(*fitted.notes, *_notes(fitted, experiments)))


def _space(fitted: FittedCandidate, experiments: Sequence[Experiment], number: int) -> SearchSpace:
    """Return the estimated unknowns of an experiment, at their estimates; others are held."""
    problem = replace(
        without_priors(fitted.model.problem),
        experiments=tuple(experiments),
        constraints=(),
        cost=SumSquared(),
    )
    estimated = set(fitted.labels)
    values = {
        **own_starts(fitted, experiments[number].record_id),
        **fitted.model.values,  # including those of test experiments
        **fitted.space.estimates(fitted.x),
    }
    every = make_space(problem, (number,), starts=values)
    held = {u.label: u.start for u in every.unknowns if u.label not in estimated}
    return make_space(problem, (number,), known=held, starts=values)


def _notes(fitted: FittedCandidate, experiments: Sequence[Experiment]) -> list[str]:
    """Return sentences on the unknowns that count as known."""
    own: list[str] = []
    for number in range(len(experiments)):
        problem = replace(fitted.model.problem, experiments=tuple(experiments), constraints=())
        unknowns = make_space(problem, (number,)).unknowns
        own += [u.label for u in unknowns if u.label not in fitted.labels]
    if not own:
        return []
    names = list(dict.fromkeys(own))
    return [
        f"{', '.join(names[:3])}{' and others' if len(names) > 3 else ''}: only the predictions "
        f"depend on {'it' if len(names) == 1 else 'them'}, so "
        f"{'its value is' if len(names) == 1 else 'their values are'} taken as known"
    ]


def _outputs(
    fitted: FittedCandidate,
    experiment: Experiment,
    predicted: PredictedExperiment,
    units: Mapping[str, str],
) -> list[PredictedOutput]:
    """Return the predictions of an experiment, with derivatives by all unknowns of the model."""
    places = [fitted.labels.index(label) for label in predicted.labels]
    jacobian = np.zeros((len(predicted.outputs), len(fitted.labels)))
    jacobian[:, places] = predicted.jacobian
    found, first = [], 0
    for output in experiment.outputs:
        rows = slice(first, first + len(output.times))
        first = rows.stop
        unit = units.get(output.variable, "")
        found.append(PredictedOutput(experiment.id, output.variable, unit, jacobian[rows]))
    return found
