"""Fits to outputs that are known up to scale and offset, or down to a detection limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.costs.robust import HuberCost
from cluster_est.errors import ProblemError

SCALES, OFFSETS = (3.7, 0.5, 2.0), (0.4, -1.0, 0.0)


def observed(noise=0.0, **how):
    """Springs whose sensors have scales and offsets of their own; the mass is known."""
    truth = spring_problem(3, noise=noise)
    problem, runs = truth.problem, []
    for experiment, scale, offset in zip(problem.experiments, SCALES, OFFSETS, strict=True):
        (output,) = experiment.outputs
        made = replace(output, values=scale * output.values + offset, sigma=0.01, **how)
        start = {"x": truth.values[f"x0[{experiment.id}]"]}
        runs.append(replace(experiment, outputs=(made,), values=start))
    known = tuple(
        replace(p, start=TRUE["m"], fixed=True) if p.name == "m" else p for p in problem.parameters
    )
    return replace(problem, parameters=known, experiments=tuple(runs))


@pytest.fixture(scope="module")
def scaled():
    return ce.fit(observed(free_scale=True, free_offset=True))


def test_parameters_are_found_whatever_the_scale_of_each_sensor(scaled):
    assert scaled.success
    assert scaled.x["k"] == pytest.approx(TRUE["k"], rel=1e-4)
    assert scaled.x["c"] == pytest.approx(TRUE["c"], rel=1e-3)


def test_the_scales_are_a_table_and_a_note(scaled):
    rows = scaled.table("scales").to_pylist()
    assert [row["scale"] for row in rows] == pytest.approx(SCALES, rel=1e-3)
    assert [row["offset"] for row in rows] == pytest.approx(OFFSETS, abs=1e-3)
    assert any("y is compared up to scale or offset: scale 0.5 to 3.7" in n for n in scaled.notes)


def test_the_tables_show_what_was_compared(scaled):
    table = scaled.residuals.to_pydict()
    gaps = np.array(table["measured"]) - np.array(table["simulated"])
    assert np.abs(gaps).max() < 1e-3


@pytest.mark.parametrize("method", ["sensitivities", "central"])
def test_derivatives_are_those_of_what_is_left(method):
    found = ce.fit(
        observed(free_scale=True, free_offset=True), method=ce.LeastSquares(differences=method)
    )
    assert found.x["k"] == pytest.approx(TRUE["k"], rel=1e-4)


def test_standard_errors_are_those_of_a_fit_with_scales_as_unknowns():
    """Against the Jacobian of all unknowns together, scales and offsets among them."""
    result = ce.fit(observed(noise=0.003, free_scale=True, free_offset=True))
    plain = observed(noise=0.003)
    steps = {"k": 0.01, "c": 0.001}
    columns, start = [], {name: result.x[name] for name in steps}

    def simulated(values):
        return [
            s.outcome.trajectory.at("y", e.outputs[0].times)
            for s, e in zip(ce.simulate(plain, values=values), plain.experiments, strict=True)
        ]

    base = simulated(start)
    scales = result.table("scales").to_pylist()
    for name, step in steps.items():
        moved = simulated(start | {name: start[name] + step})
        parts = [
            row["scale"] * (new - old) / step
            for row, new, old in zip(scales, moved, base, strict=True)
        ]
        columns.append(np.concatenate(parts))
    for e, old in enumerate(base):
        for column in (old, np.ones(len(old))):
            parts = [column if i == e else np.zeros(len(o)) for i, o in enumerate(base)]
            columns.append(np.concatenate(parts))
    tall = np.column_stack(columns) / 0.01
    left = result.fun
    variance = left @ left / (len(left) - tall.shape[1])
    errors = np.sqrt(np.diag(variance * np.linalg.inv(tall.T @ tall)))
    white = [each.error_white for each in result.uncertainty.intervals[:2]]
    assert white == pytest.approx(list(errors[:2]), rel=0.02)


def test_values_below_a_detection_limit_pull_nothing_towards_it():
    """What is written as the limit where nothing was detected biases a fit that takes it for it."""
    problem = spring_problem(3, noise=0.01).problem
    limit = 0.02

    def hidden(experiment, **how):
        (output,) = experiment.outputs
        values = np.where(output.values > limit, output.values, limit)
        return replace(experiment, outputs=(replace(output, values=values, sigma=0.01, **how),))

    def fitted(**how):
        runs = tuple(hidden(e, **how) for e in problem.experiments)
        return ce.fit(replace(problem, experiments=runs))

    censored, naive = fitted(detection_limit=limit), fitted()
    off = {key: abs(r.x["c"] - TRUE["c"]) for key, r in (("it", censored), ("naive", naive))}
    assert off["it"] < 0.05
    assert off["naive"] > 3.0 * off["it"]
    assert any("at or below its detection limit" in note for note in censored.notes)


@pytest.mark.parametrize("how", [{"free_scale": True}, {"detection_limit": 0.0}])
def test_the_closed_loop_takes_outputs_as_they_are(how):
    with pytest.raises(ProblemError, match="output y must be compared as it is"):
        ce.close_loop(observed(**how))


def hidden_springs(seed, limit, **how):
    problem = spring_problem(3, noise=0.0).problem
    generator, runs = np.random.default_rng(seed), []
    for experiment in problem.experiments:
        (output,) = experiment.outputs
        values = output.values + 0.01 * generator.standard_normal(len(output.times))
        made = replace(output, values=np.where(values > limit, values, 0.0), sigma=0.01, **how)
        runs.append(replace(experiment, outputs=(made,)))
    return replace(problem, experiments=tuple(runs))


def test_standard_errors_are_those_that_the_estimates_scatter_by():
    """Two thirds of the values are hidden, and say nothing of how large the noise is."""
    found = []
    for seed in range(12):
        result = ce.fit(hidden_springs(seed, 0.02, detection_limit=0.02))
        own = {each.label: each for each in result.estimates}
        found.append([(own[n].value - TRUE[n]) / own[n].std_error for n in ("m", "k", "c")])
    scatter = np.sqrt(np.mean(np.square(found), axis=0))
    assert (scatter > 0.6).all()
    assert (scatter < 1.5).all()


def test_the_limit_and_0_say_the_same(tmp_path):
    one, other = (hidden_springs(1, limit, detection_limit=0.02) for limit in (0.02, 0.02))
    for a, b in zip(one.experiments, other.experiments, strict=True):
        assert a.key == b.key
    result = ce.fit(one)
    table = result.residuals.to_pydict()
    hidden = np.array(table["measured"]) <= 0.02
    assert np.array(table["simulated"])[hidden].min() < -0.02  # and not the limit
    assert not any("a constant would follow" in note for note in result.notes)


def test_a_limit_without_a_sigma_and_another_cost_are_refused():
    problem = hidden_springs(1, 0.02, detection_limit=0.02)
    bare = tuple(
        replace(e, outputs=tuple(replace(o, sigma=1.0) for o in e.outputs))
        for e in problem.experiments
    )
    with pytest.raises(ProblemError, match="must have a sigma where it has a detection_limit"):
        ce.fit(replace(problem, experiments=bare))
    with pytest.raises(ProblemError, match="must go with the cost sse"):
        ce.fit(replace(problem, cost=HuberCost()))
    with pytest.raises(ProblemError, match="must go with the cost sse"):
        ce.fit(replace(observed(free_scale=True), cost=HuberCost()))
