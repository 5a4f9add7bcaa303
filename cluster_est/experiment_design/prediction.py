"""What models predict of candidates: outputs and their derivatives, simulated on the queue."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cluster_est.costs.sum_squared import SumSquared
from cluster_est.experiment_design.candidates import CandidateInput
from cluster_est.experiment_design.models import FittedCandidate
from cluster_est.methods.given_points import GivenPoints
from cluster_est.problem.prior_weights import without_priors
from cluster_est.problem.space import SearchSpace, make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from cluster_est.uncertainty.covariance.derivatives import StartJacobian
from workers.messages import FloatArray


@dataclass(frozen=True)
class PredictedExperiment:
    """What one model predicts of one candidate, in standard deviations of the noise.

    Attributes
    ----------
    outputs : (samples,)
        Output after output.
    jacobian : (samples, unknowns)
        Their derivatives by the unknowns, in search coordinates.
    information : (unknowns, unknowns)
        What is known of the unknowns before the experiment.
    labels
        Of the unknowns.
    """

    outputs: FloatArray
    jacobian: FloatArray
    information: FloatArray
    labels: tuple[str, ...] = field(default=())

    @property
    def factor(self) -> FloatArray:
        """L with L L' the covariance that the unknowns give the outputs, (samples, unknowns)."""
        root = np.linalg.cholesky(np.linalg.inv(self.information))
        return np.asarray(self.jacobian @ root)

    @property
    def posterior(self) -> FloatArray:
        """Covariance of the unknowns after the experiment, (unknowns, unknowns)."""
        return np.asarray(np.linalg.inv(self.information + self.jacobian.T @ self.jacobian))


def keeping_limits(
    runner: Runner, fitted: Sequence[FittedCandidate], candidates: Sequence[CandidateInput]
) -> list[tuple[float, str]]:
    """Return by how much each candidate leaves its limits with any model, and which.

    Parameters
    ----------
    runner
        Its executor has the candidates' experiments, in their order.
    fitted, candidates
        Models and candidates, each simulated with each.

    Returns
    -------
    list of tuple
        The largest violation, in the range of the limits, 0 for what keeps them and infinite where
        a simulation failed; and what is violated, or why it failed.
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
                worst = (at.violation, name.partition(" [")[0].replace(" ", "."))
        found.append(worst)
    return found


def predictions(
    runner: Runner,
    fitted: Sequence[FittedCandidate],
    candidates: Sequence[CandidateInput],
    chosen: Sequence[int],
) -> list[tuple[PredictedExperiment, ...] | None]:
    """Return what each model predicts of each chosen candidate; None where one cannot say.

    Parameters
    ----------
    runner
        Its executor has the candidates' experiments, in their order.
    fitted, candidates
        Models, and all candidates.
    chosen
        Numbers of those that are predicted.
    """
    each = [candidate_spaces(model, candidates, chosen) for model in fitted]
    spaces = list(zip(*each, strict=True))
    method = StartJacobian(derivatives=True, scheme="forward")
    requests = [SearchRequest("candidates", method, space) for own in spaces for space in own]
    solutions = iter(runner.run(requests))
    found: list[tuple[PredictedExperiment, ...] | None] = []
    for own in spaces:
        parts = []
        for model, space in zip(fitted, own, strict=True):
            solution = next(solutions)
            if solution.at is None or not solution.at.ok or solution.jacobian is None:
                continue
            if solution.frozen is not None and solution.frozen.any():
                continue
            labels = tuple(unknown.label for unknown in space.unknowns)
            parts.append(
                PredictedExperiment(
                    -solution.at.residuals,
                    -solution.jacobian,
                    model.prior_information(space),
                    labels,
                )
            )
        found.append(tuple(parts) if len(parts) == len(fitted) else None)
    return found


def candidate_spaces(
    fitted: FittedCandidate, candidates: Sequence[CandidateInput], chosen: Sequence[int]
) -> list[SearchSpace]:
    """Return the unknowns of a model in each of some candidates, at its estimates.

    What a new experiment has of its own starts from the mean of what the earlier ones had.
    """
    problem = replace(
        without_priors(fitted.model.problem),
        experiments=tuple(candidate.experiment for candidate in candidates),
        constraints=(),
        cost=SumSquared(),
    )
    values = fitted.space.estimates(fitted.x)
    own: dict[str, list[float]] = {}
    for unknown in fitted.space.unknowns:
        if unknown.scope:
            own.setdefault(unknown.parameter.name, []).append(values[unknown.label])
    for number in chosen:
        name = candidates[number].name
        values |= {f"{each}[{name}]": float(np.mean(known)) for each, known in own.items()}
    return [make_space(problem, (number,), starts=values) for number in chosen]
