"""The adjoint against the directions that it stands for: w'(D f) = (D'w)'f."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.screening.adjoint import adjoint_signals
from cluster_est.closed_loop.screening.directions import CandidatePoint, added_at, directions
from cluster_est.closed_loop.settings import LoopSettings

FORMS = ("constant", "product", "linear", "bias", "gain", "feed_through", "drift")


@pytest.mark.parametrize("name", ["mass_spring_damper", "cascaded_tanks", "two_mass_drive"])
def test_it_weighs_as_the_directions_do(name):
    with opened(missing_effect_problem(name)) as bench:
        fitted = unfitted(bench)
        trajectories = bench.trajectories(fitted)
        known = [_known(fitted, each) for each in trajectories]
        candidates = make_candidates(
            fitted.problem, bench.description, trajectories, [], LoopSettings(forms=FORMS)
        )
        trials = [CandidatePoint(c, c.grid[0]) for c in candidates]
        weights = np.random.default_rng(3).standard_normal((bench.size, 2))
        ends = np.cumsum([0, *(len(each.rows) for each in trajectories)])
        adjoints = [
            adjoint_signals(each, weights[a:b])
            for each, a, b in zip(trajectories, ends, ends[1:], strict=False)
        ]
        columns = directions(trajectories, trials, known)
    kinds = {"derivative", "input", "output", "parameter"}
    kinds |= {"pair"} if name != "mass_spring_damper" else set()  # it has but one state to act on
    assert {trial.candidate.site.kind for trial in trials} == kinds
    for trial, column in zip(trials, columns, strict=True):
        site = trial.candidate.site
        states = site.targets if site.kind == "pair" else ("",)
        for k, state in enumerate(states):
            weighed = sum(
                np.sum(added_at(each, trial, p)[:, k][:, None] * adjoint.at(site, state), axis=0)
                for each, p, adjoint in zip(trajectories, known, adjoints, strict=True)
            )
            expected = np.sum(weights * column[:, k][:, None], axis=0)
            size = np.linalg.norm(column[:, k]) * np.linalg.norm(weights, axis=0)
            np.testing.assert_allclose(weighed / size, expected / size, atol=1e-9)


def _known(fitted, trajectory):
    return np.array([fitted.estimates[name] for name in trajectory.linear.parameter_names])


def test_co_simulation_has_none():
    with opened(missing_effect_problem("battery", interface="co_simulation")) as bench:
        (first, *_) = bench.trajectories(unfitted(bench))
    with pytest.raises(ValueError, match="linearisation"):
        adjoint_signals(first, np.zeros((len(first.rows), 1)))
