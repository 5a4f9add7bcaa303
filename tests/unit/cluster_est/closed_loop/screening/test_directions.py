"""Directions of candidates beside what contracts say of each form: adjoints, co-simulation."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.thinning import thinned
from support.truth.systems_with_missing_effects import (
    SYSTEMS,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est import LoopSettings
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.screening.directions import CandidatePoint, added_at, directions
from cluster_est.closed_loop.screening.places import adjoint_signals
from cluster_est.closed_loop.screening.screen import rank


class Screened:
    """A system where it starts, with candidates at the first points of their grids."""

    def __init__(self, problem, **settings):
        with opened(problem) as bench:
            fitted = unfitted(bench)
            self.runs = bench.fitter.trajectories(fitted)
            found = make_candidates(
                problem, bench.fitter.description, self.runs, [], LoopSettings(**settings)
            )
            self.size = bench.fitter.size
        self.trials = [CandidatePoint(c, c.grid[0]) for c in found]
        self.known = [
            np.array([fitted.estimates[name] for name in run.linear.parameter_names])
            for run in self.runs
        ]

    def directions(self, trials=None):
        return directions(self.runs, self.trials if trials is None else trials, self.known)


@pytest.mark.parametrize("name", ["mass_spring_damper", "cascaded_tanks", "two_mass_drive"])
def test_the_adjoint_weighs_as_the_directions_do(name):
    """w'(D f) = (D'w)'f for what each candidate adds, f."""
    forms = ("constant", "product", "linear", "bias", "gain", "feed_through", "drift")
    seen = Screened(missing_effect_problem(name), forms=forms)
    weights = np.random.default_rng(3).standard_normal((seen.size, 2))
    ends = np.cumsum([0, *(len(run.rows) for run in seen.runs)])
    adjoints = [
        adjoint_signals(run, weights[a:b])
        for run, a, b in zip(seen.runs, ends, ends[1:], strict=False)
    ]
    kinds = {"derivative", "input", "output", "parameter"}
    kinds |= {"pair"} if name != "mass_spring_damper" else set()  # it has but one state to act on
    assert {trial.candidate.site.kind for trial in seen.trials} == kinds
    for trial, column in zip(seen.trials, seen.directions(), strict=True):
        site = trial.candidate.site
        states = site.targets if site.kind == "pair" else ("",)
        for k, state in enumerate(states):
            weighed = sum(
                np.sum(added_at(run, trial, p)[:, k][:, None] * adjoint.at(site, state), axis=0)
                for run, p, adjoint in zip(seen.runs, seen.known, adjoints, strict=True)
            )
            expected = np.sum(weights * column[:, k][:, None], axis=0)
            size = np.linalg.norm(column[:, k]) * np.linalg.norm(weights, axis=0)
            np.testing.assert_allclose(weighed / size, expected / size, atol=1e-9)


def test_blocks_of_many_candidates_make_no_difference():
    """So many at once that the states' responses do not fit into one block."""
    seen = Screened(missing_effect_problem("two_mass_drive"), sites=("der(w_load)",))
    whole, times = seen.directions(), 1 + 1200 // len(seen.trials)
    for number, column in enumerate(seen.directions(seen.trials * times)):
        one = whole[number % len(whole)]
        np.testing.assert_allclose(column, one, rtol=1e-9, atol=1e-12 * np.abs(one).max())
    assert seen.directions([]) == []


def test_an_output_that_one_experiment_did_not_measure_moves_only_in_the_others():
    problem = missing_effect_problem("two_mass_drive")
    first, second = problem.experiments
    second = replace(second, outputs=second.outputs[:1])
    problem = replace(problem, experiments=(first, second))
    (moved,) = Screened(problem, forms=("bias",), sites=("output load_speed",)).directions()
    n = len(first.outputs[0].times)
    expected = np.repeat([0.0, -1.0 / first.outputs[1].sigma, 0.0], n)
    np.testing.assert_allclose(moved[:, 0], expected)


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
    """A cell in co-simulation, and the directions of its candidates."""
    problem = missing_effect_problem("battery", interface="co_simulation", signals=())
    sites, forms = zip(*CHANGES, strict=True)
    with opened(problem, LoopSettings(forms=forms, sites=tuple(dict.fromkeys(sites)))) as bench:
        ranking = rank(bench.fitter, bench.settings, unfitted(bench))
    found = {}
    for trial, column in zip(ranking.trials, ranking.columns, strict=True):
        key = str(trial.candidate.site), trial.candidate.form.name
        found.setdefault(key, (trial, column))
    return problem, found


@pytest.mark.parametrize("key", thinned([(key,) for key in CHANGES], lambda key: key[0][:5]))
def test_in_co_simulation_a_direction_is_what_simulations_by_hand_say(probed, key):
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


def test_what_differs_from_experiment_to_experiment_has_a_column_for_each():
    """Beside a store's exchange, which all share, what its start adds is that of a decay alone."""
    problem = missing_effect_problem("cascaded_tanks", experiments=3)
    seen = Screened(problem, forms=("store_from_elsewhere", "emptying"), sites=("der(h1)",))
    (store,) = (t for t in seen.trials if t.candidate.effect.variables == ("h1",))
    (decay,) = (t for t in seen.trials if t.candidate.form.name == "emptying")
    training = problem.indices("train")
    assert store.candidate.experiments == tuple(problem.experiments[e].id for e in training)
    assert (store.width, decay.width) == (1 + len(training), len(training))
    both, alone = seen.directions([store, decay])
    np.testing.assert_allclose(both[:, 1:], alone, atol=1e-9 * np.abs(alone).max())
    ends = np.cumsum([0, *(len(run.rows) for run in seen.runs)])
    for e, (first, last) in enumerate(pairwise(ends)):
        assert np.abs(alone[first:last, e]).max() > 0.0
        assert not alone[:first, e].any()
        assert not alone[last:, e].any()
    assert all(both[first:last, 0].any() for first, last in pairwise(ends))


def test_values_of_single_experiments_are_unknowns_of_their_own():
    problem = missing_effect_problem("cascaded_tanks", experiments=3)
    with opened(problem) as bench:
        fitted = unfitted(bench)
        runs = bench.fitter.trajectories(fitted)
        settings = LoopSettings(forms=("store_from_elsewhere",), sites=("der(h1)",))
        given = (bench.fitter.description, runs, [], settings)
        found = make_candidates(problem, *given)
        (store,) = (c for c in found if c.effect.variables == ("h1",))
        values = [0.01, *(0.1 * n for n, _ in enumerate(store.experiments, 1)), 30.0]
        start = fitted.start.plus(store, values)
        grown = unfitted(bench, start)
    assert grown.coefficients(store) == pytest.approx(values)
    labels = [f"{store.effect.name}.a[{name}]" for name in store.experiments]
    assert set(labels) <= set(grown.estimates)
    assert store.sizes(values) == values[:-1]
    assert store.point(values) == pytest.approx((0.01, float(np.mean(values[1:-1])), 30.0))


def test_of_two_time_constants_the_slow_one_is_called_so():
    problem = missing_effect_problem("cascaded_tanks")
    with opened(problem) as bench:
        fitted = unfitted(bench)
        runs = bench.fitter.trajectories(fitted)
        settings = LoopSettings(forms=("two_stores",), sites=("der(h1)",))
        (stores,) = make_candidates(problem, bench.fitter.description, runs, [], settings)
        start = fitted.start.plus(stores, (0.01, 0.02, 200.0, 30.0))
        crossed = replace(unfitted(bench, start), added=(stores,))
        again = unfitted(bench, crossed.start)
    assert again.coefficients(stores) == pytest.approx([0.02, 0.01, 30.0, 200.0])
    np.testing.assert_allclose(again.residuals, crossed.residuals, rtol=1e-6, atol=1e-6)
