"""Directions in co-simulation, against simulations worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.truth.systems_with_missing_effects import (
    SYSTEMS,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.screening.directions import CandidatePoint
from cluster_est.closed_loop.screening.probe import probe
from cluster_est.closed_loop.settings import LoopSettings

FORMS = ("bias", "square", "saturation", "linear", "drift")


def voltage(current, times, change):
    """Of the cell with `change` of (t, current, R0) -> (current, R0), by SciPy."""
    q, r0, r1, c1 = SYSTEMS["battery"].parameters.values()

    def at(t):
        return change(t, np.interp(t, times, current), r0)

    def slope(t, x):
        i, _ = at(t)
        return [-i / q, (i - x[1] / r1) / c1]

    run = solve_ivp(slope, (0.0, times[-1]), [0.8, 0.0], t_eval=times, rtol=1e-9, atol=1e-12,
                    max_step=10.0)  # fmt: skip
    soc, v1 = run.y
    i, r = np.array([at(t) for t in times]).T
    return 3.45 + 0.45 * soc + 0.25 * soc**3 - 0.35 * np.exp(-18.0 * soc) - r * i - v1


CHANGES = {
    ("input current", "bias"): lambda k, at: lambda t, i, r: (i + k, r),
    ("input current", "square"): lambda k, at: lambda t, i, r: (i + k * i**2, r),
    ("input current", "saturation"): lambda k, at: lambda t, i, r: (np.clip(i, -at, at), r),
    ("parameter R0", "linear"): lambda k, at: lambda t, i, r: (i, r * (1 + k * (i - at))),
    ("parameter R0", "drift"): lambda k, at: lambda t, i, r: (i, r * (1 + k * (t - at))),
}


@pytest.fixture(scope="module")
def probed():
    problem = missing_effect_problem("battery", interface="co_simulation", signals=())
    settings = LoopSettings(forms=FORMS, sites=("input current", "parameter R0"))
    with opened(problem, settings) as bench:
        fitted = unfitted(bench)
        courses = bench.trajectories(fitted)
        candidates = make_candidates(problem, bench.description, courses, [], settings)
        trials = [CandidatePoint(c, c.grid[0]) for c in candidates]
        columns = probe(bench, fitted, courses, trials)
        assert probe(bench, fitted, courses, []) == []
    found = {(str(t.candidate.site), t.candidate.form.name): (t, column)
             for t, column in zip(trials, columns, strict=True)}  # fmt: skip
    return problem, found


@pytest.mark.parametrize("key", CHANGES)
def test_it_is_what_simulations_by_hand_say(probed, key):
    problem, found = probed
    trial, column = found[key]
    finite = not trial.candidate.strengths
    k = {"square": 1e-3, "drift": 1e-6}.get(key[1], 1e-2)
    truth = []
    for run in problem.experiments:
        times, current = run.inputs[0].times, run.inputs[0].values
        plain = voltage(current, times, lambda t, i, r: (i, r))
        bent = voltage(current, times, CHANGES[key](k, trial.values[-1]))
        truth.append(-(bent - plain) / run.outputs[0].sigma / (1.0 if finite else k))
    expected = np.concatenate(truth)
    assert column.shape == (len(expected), 1)
    cosine = column[:, 0] @ expected / np.linalg.norm(column) / np.linalg.norm(expected)
    assert cosine > 0.999
    # a limit is met between communication points, where the FMU sees a straight line
    bar = 0.03 if finite else 0.01
    assert np.linalg.norm(column) == pytest.approx(np.linalg.norm(expected), rel=bar)
