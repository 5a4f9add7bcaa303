from dataclasses import replace

import numpy as np
import pytest
from support.problems.seen_springs import seen_springs, with_outputs
from support.problems.springs import TRUE, spring_problem

import cluster_est as ce
from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS

SCALES, OFFSETS = (3.7, 0.5, 2.0), (0.4, -1.0, 0.0)


def observed(noise=0.0, **how):
    """Springs whose sensors have scales and offsets of their own."""
    generator = np.random.default_rng(1)

    def see(output, number):
        seen = output.values + noise * generator.normal(size=len(output.times))
        values = SCALES[number] * seen + OFFSETS[number]
        return replace(output, values=values, sigma=0.01, **how)

    return seen_springs(see)


@pytest.mark.parametrize("differences", ["auto", "sensitivities", "central"])
def test_parameters_and_scales_are_found_and_stand_in_tables_and_a_note(differences):
    method = ce.LeastSquares(differences=differences)
    scaled = ce.fit(observed(free_scale=True, free_offset=True), method)
    assert scaled.success
    assert scaled.x["k"] == pytest.approx(TRUE["k"], rel=1e-4)
    assert scaled.x["c"] == pytest.approx(TRUE["c"], rel=1e-3)
    rows = scaled.table("scales").to_pylist()
    assert [row["scale"] for row in rows] == pytest.approx(SCALES, rel=1e-3)
    assert [row["offset"] for row in rows] == pytest.approx(OFFSETS, abs=1e-3)
    assert any("the fitted scale is 0.5 to 3.7" in n for n in scaled.notes)
    table = scaled.table("residuals").to_pydict()
    gaps = np.array(table["measured"]) - np.array(table["simulated"])
    assert np.abs(gaps).max() < 1e-3


def test_standard_errors_are_those_of_a_fit_with_scales_as_unknowns():
    """Against the Jacobian of all unknowns together, scales and offsets among them."""
    result = ce.fit(observed(noise=0.003, free_scale=True, free_offset=True))
    plain = observed(noise=0.003)
    steps = {"k": 0.01, "c": 0.001}
    columns, start = [], {name: result.x[name] for name in steps}

    def simulated(values):
        return [
            s.outcome.trajectory.at("y", e.outputs[0].times)
            for s, e in zip(
                ce.simulate(plain, values=values).values(), plain.experiments, strict=True
            )
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


LIMIT = 0.02


def hidden_springs(seed=1, written=LIMIT, **how):
    """Where nothing is detected, something else is written down."""
    generator = np.random.default_rng(seed)

    def hide(output):
        values = output.values + 0.01 * generator.standard_normal(len(output.times))
        seen = np.where(values > LIMIT, values, written)
        return replace(output, values=seen, sigma=0.01, **how)

    return with_outputs(spring_problem(3).problem, hide)


def test_values_below_a_detection_limit_pull_nothing_towards_it():
    """What is written as the limit where nothing was detected biases a fit that takes it for it."""
    censored, naive = ce.fit(hidden_springs(detection_limit=LIMIT)), ce.fit(hidden_springs())
    assert abs(censored.x["c"] - TRUE["c"]) < 0.05
    assert abs(naive.x["c"] - TRUE["c"]) > 3.0 * abs(censored.x["c"] - TRUE["c"])
    assert any("at or below its detection limit" in note for note in censored.notes)
    table = censored.table("residuals").to_pydict()
    hidden = np.array(table["measured"]) <= LIMIT
    assert np.array(table["simulated"])[hidden].min() < -LIMIT  # and not the limit
    assert not any("a constant would fit" in note for note in censored.notes)
    zeros = ce.fit(hidden_springs(written=0.0, detection_limit=LIMIT))
    assert zeros.x == pytest.approx(censored.x, rel=1e-9)


@pytest.mark.slow
def test_standard_errors_are_those_that_the_estimates_scatter_by():
    """Two thirds of the values are hidden, and say nothing of how large the noise is."""
    found = []
    for seed in range(12):
        result = ce.fit(hidden_springs(seed, 0.0, detection_limit=LIMIT))
        own = {each.label: each for each in result.estimates}
        found.append([(own[n].value - TRUE[n]) / own[n].std_error for n in ("m", "k", "c")])
    scatter = np.sqrt(np.mean(np.square(found), axis=0))
    assert (scatter > 0.6).all()
    assert (scatter < 1.5).all()


@pytest.mark.parametrize("how", [{"free_scale": True}, {"detection_limit": 0.0}, {"ordinal": True}])
def test_the_closed_loop_takes_outputs_as_they_are(how):
    with pytest.raises(ProblemError, match="output y must be compared directly"):
        ce.close_loop(observed(**how))


HUBER = COSTS["huber"]()


@pytest.mark.parametrize(
    ("problem", "said"),
    [
        (
            with_outputs(hidden_springs(detection_limit=LIMIT), lambda o: replace(o, sigma=1.0)),
            "must have a known sigma if it has a detection_limit",
        ),
        (
            replace(hidden_springs(detection_limit=LIMIT), cost=HUBER),
            "so cost.name must be",
        ),
        (replace(observed(free_scale=True), cost=HUBER), "so cost.name must be"),
    ],
)
def test_a_limit_without_a_sigma_and_another_cost_are_refused(problem, said):
    with pytest.raises(ProblemError, match=said):
        ce.fit(problem)
