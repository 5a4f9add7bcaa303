"""What the first model predicts of the targets, and what it depends on: simulated on the queue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.errors import ProblemError
from cluster_est.experiment_design.models import FittedCandidate, PredictedOutput
from cluster_est.experiment_design.prediction import (
    PredictedExperiment,
    own_starts,
    predicted_experiment,
    sigma_points,
)
from cluster_est.experiment_design.queue import DesignQueue
from cluster_est.methods.given_points import GivenPoints
from cluster_est.problem.prior_weights import without_priors
from cluster_est.problem.search_space.space import SearchSpace, make_space
from cluster_est.running.search_state import SearchRequest
from workers.messages import Experiment


def with_predictions(
    queue: DesignQueue,
    fitted: FittedCandidate,
    experiments: Sequence[Experiment],
    units: Mapping[str, str],
) -> FittedCandidate:
    """Return a model that knows what it predicts of some experiments.

    Derivatives are differences over a standard deviation of the estimates to either side, as those
    of candidates. What only such an experiment has of its own, such as its initial state, is held.

    Parameters
    ----------
    queue
        Where they are simulated.
    fitted
        The model, at its estimates.
    experiments
        Whose outputs are predicted, see `target_experiments`.
    units
        Of the outputs, by name.

    Raises
    ------
    ProblemError
        If one cannot be simulated, or nothing that is predicted depends on an unknown.
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
                f"predictions: experiment {experiment.id!r} must be simulated with the estimates, "
                f"and with some a standard deviation off, but could not be ({predicted}); name "
                "others"
            )
        found += _outputs(fitted, experiment, predicted, units)
    moved = tuple(each for each in found if each.jacobian.any())
    if not moved:
        raise ProblemError(
            "predictions: must depend on what the run has estimated but none of them does; name "
            "other outputs"
        )
    return replace(fitted, targets=moved, notes=(*fitted.notes, *_notes(fitted, experiments)))


def _space(fitted: FittedCandidate, experiments: Sequence[Experiment], number: int) -> SearchSpace:
    """The unknowns of an experiment that were estimated, at their estimates; the rest is held."""
    problem = replace(
        without_priors(fitted.model.problem),
        experiments=tuple(experiments),
        constraints=(),
        cost=SumSquared(),
    )
    estimated = set(fitted.labels)
    values = {
        **own_starts(fitted, experiments[number].record_id),
        **fitted.model.values,  # of test experiments too
        **fitted.space.estimates(fitted.x),
    }
    every = make_space(problem, (number,), starts=values)
    held = {u.label: u.start for u in every.unknowns if u.label not in estimated}
    return make_space(problem, (number,), known=held, starts=values)


def _notes(fitted: FittedCandidate, experiments: Sequence[Experiment]) -> list[str]:
    """Say what is taken for known."""
    own: list[str] = []
    for number in range(len(experiments)):
        problem = replace(fitted.model.problem, experiments=tuple(experiments), constraints=())
        unknowns = make_space(problem, (number,)).unknowns
        own += [u.label for u in unknowns if u.label not in fitted.labels]
    if not own:
        return []
    names = list(dict.fromkeys(own))
    return [
        f"{', '.join(names[:3])}{' and others' if len(names) > 3 else ''}, which only what is "
        f"predicted has, {'is' if len(names) == 1 else 'are'} taken for known"
    ]


def _outputs(
    fitted: FittedCandidate,
    experiment: Experiment,
    predicted: PredictedExperiment,
    units: Mapping[str, str],
) -> list[PredictedOutput]:
    """The predictions of an experiment, output after output, by all unknowns of the model."""
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
