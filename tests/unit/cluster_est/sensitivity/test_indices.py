import itertools
from dataclasses import replace

import numpy as np
import pytest
from support.problems.functions import FunctionExecutor, FunctionProblem

from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS
from cluster_est.running.runner import Runner
from cluster_est.sensitivity.analysis import analyse_on, check_bounds
from cluster_est.sensitivity.designs import DESIGNS
from cluster_est.sensitivity.settings import SensitivitySettings

A, B = 7.0, 0.1


def ishigami(x):
    return np.sin(x[0]) + A * np.sin(x[1]) ** 2 + B * x[2] ** 4 * np.sin(x[0])


def ishigami_indices():
    """T. Ishigami, T. Homma, Proc. ISUMA (1990) 398-403, doi:10.1109/ISUMA.1990.151285."""
    v1 = 0.5 * (1.0 + B * np.pi**4 / 5.0) ** 2
    v2 = A**2 / 8.0
    v13 = 8.0 * B**2 * np.pi**8 / 225.0
    total = v1 + v2 + v13
    return np.array([v1, v2, 0.0]) / total, np.array([v1 + v13, v2, v13]) / total


def analysed(function, low, high, workers=1, seed=3, cost="sse", **settings):
    """The residuals are the function's values; `low` and `high` are the bounds of each unknown."""
    low, high = np.array(low), np.array(high)
    one = FunctionProblem(
        "given", lambda x: np.atleast_1d(function(x)), tuple(0.3 * low + 0.7 * high), 0.0,
        tuple(low), tuple(high), cost=COSTS[cost](),
    )  # fmt: skip
    with FunctionExecutor(one.residuals, workers=workers) as executor:
        space = check_bounds(one.problem())
        runner = Runner(executor, whole=True)
        return analyse_on(runner, space, SensitivitySettings(**settings), seed)


def between(function, size, low=0.0, high=1.0, **how):
    """With the same bounds for all."""
    return analysed(function, [low] * size, [high] * size, **how)


def of_output(result, index):
    return np.array([r.value for r in result.indices if r.index == index and r.output == "y"])


WEIGHTS = np.array([0.0, 1.0, 4.5, 9.0])


def sobol_g(x):
    return np.prod((np.abs(4.0 * x - 2.0) + WEIGHTS) / (1.0 + WEIGHTS))


def sobol_g_indices():
    """I. M. Sobol, Reliab. Eng. Syst. Saf. 79 (2003) 187-193, doi:10.1016/S0951-8320(02)00229-6."""
    alone = 1.0 / (3.0 * (1.0 + WEIGHTS) ** 2)
    every = np.prod(1.0 + alone)
    return alone / (every - 1.0), alone * every / (1.0 + alone) / (every - 1.0)


@pytest.mark.parametrize(
    ("function", "indices", "bounds"),
    [(ishigami, ishigami_indices(), (-np.pi, np.pi)), (sobol_g, sobol_g_indices(), (0.0, 1.0))],
)
def test_sobol_indices_are_the_analytic_ones(function, indices, bounds):
    found = between(function, len(indices[0]), *bounds, method="sobol", groups=4096)
    np.testing.assert_allclose(of_output(found, "first order"), indices[0], atol=0.02)
    np.testing.assert_allclose(of_output(found, "total"), indices[1], atol=0.02)


@pytest.mark.parametrize(
    ("function", "size", "bounds"), [(ishigami, 3, (-np.pi, np.pi)), (sobol_g, 4, (0.0, 1.0))]
)
def test_elementary_effects_are_those_of_all_trajectories(function, size, bounds):
    """Of every step of two thirds on a grid of four levels, with the other unknowns anywhere."""
    found = between(function, size, *bounds, groups=4000)
    levels = np.linspace(*bounds, 4)
    step = levels[2] - levels[0]
    for i in range(size):
        below = np.array(
            list(itertools.product(*(levels[: 2 if j == i else 4] for j in range(size))))
        )
        above = below + step * (np.arange(size) == i)
        effects = (
            np.array([function(b) - function(a) for a, b in zip(below, above, strict=True)]) * 1.5
        )
        assert of_output(found, "mu*")[i] == pytest.approx(np.abs(effects).mean(), rel=0.03)
        assert of_output(found, "sigma")[i] == pytest.approx(effects.std(), rel=0.03)


@pytest.mark.parametrize(
    ("name", "groups", "kept", "figures"),
    [
        ("morris", 20, 20, {
            "mu*": [8.953813332259728, 7.874999999999998, 5.623916492999804],
            "sigma": [6.281598407997584, 7.916338866713041, 8.383639718753187],
        }),
        ("sobol", 64, 60, {
            "first order": [0.336809254666169, 0.383962995055921, 0.124964765861024],
            "total": [0.406903308430485, 0.420543063431847, 0.294844330506285],
        }),
    ],
)  # fmt: skip
def test_indices_are_those_of_salib(name, groups, kept, figures):
    """SALib 1.6.0 has these figures for the same points, the last groups of which are left out."""
    design = DESIGNS[name]
    points = design.sample(3, groups, np.random.default_rng(7))[: kept * design.group(3)]
    values = np.array([ishigami(np.pi * (2.0 * x - 1.0)) for x in points])
    for index in design.indices(points, values, np.random.default_rng(1)):
        np.testing.assert_allclose(index.values, figures[index.name], rtol=1e-9)


@pytest.mark.parametrize("name", DESIGNS)
def test_intervals_hold_what_many_samples_say(name):
    """Nineteen of twenty times; the mean of the samples stands for the truth."""
    design = DESIGNS[name]
    found = []
    for seed in range(60):
        generator = np.random.default_rng(seed)
        points = design.sample(3, 64, generator)
        values = np.array([ishigami(np.pi * (2.0 * x - 1.0)) for x in points])
        found += [i for i in design.indices(points, values, generator) if i.name == design.ranks]
    values, half = (np.array([getattr(i, key) for i in found]) for key in ("values", "half_widths"))
    inside = np.abs(values - values.mean(axis=0)) < half + 1e-9
    assert (inside.mean(axis=0) > 0.85).all()


def test_the_unknowns_that_matter_are_ranked_first():
    weights = np.zeros(60)
    weights[[3, 17, 40, 55]] = [2.0, 5.0, 3.0, 4.0]
    found = between(lambda x: 10.0 + weights @ x + 0.5 * x[17] * x[40], 60)
    assert [u.label for u in found.ranking[:4]] == ["x17", "x55", "x40", "x3"]
    assert found.ranking[4].value == 0.0
    effects = dict(zip([f"x{i}" for i in range(60)], of_output(found, "mu*"), strict=True))
    assert effects["x55"] == pytest.approx(4.0)
    # and the start, twice, with central differences
    assert found.evaluations == 20 * 61 + 2 + 2 * 60


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_the_number_of_workers_changes_nothing(method):
    one, three = (
        between(ishigami, 3, -1.0, 2.0, workers=w, method=method, groups=32) for w in (1, 3)
    )
    for name in one.tables:
        rows = [repr(result.table(name).to_pylist()) for result in (one, three)]
        assert rows[0] == rows[1]  # as text: NaN is not equal to itself


@pytest.mark.parametrize("method", ["morris", "sobol"])
def test_a_failure_takes_its_group_away_and_no_more(method):
    def fails_at_times(x):
        return np.nan if x[0] > 0.9 and x[1] > 0.9 else 1.0 + x[0] + 2.0 * x[1] + 0.1 * x[2]

    found = between(fails_at_times, 3, method=method, groups=64)
    assert 0 < found.lost < found.groups == 64
    assert found.failures > 0
    assert any(f"{found.lost} of 64 groups" in note for note in found.notes)
    assert [u.label for u in found.ranking] == ["x1", "x0", "x2"]


def test_too_many_failures_are_refused():
    with pytest.raises(ProblemError, match=r"at least 4 groups of points must be simulated"):
        between(lambda x: np.nan, 3)


@pytest.mark.parametrize(
    ("scale", "bounds", "must"),
    [("linear", (-np.inf, np.inf), "finite bounds"), ("log", (0.0, 9.0), "bounds above 0")],
)
def test_bounds_that_cannot_be_sampled_are_refused(scale, bounds, must):
    one = FunctionProblem("free", lambda x: x, (1.0,), 0.0, *((b,) for b in bounds)).problem()
    (parameter,) = one.parameters
    with pytest.raises(ProblemError, match=rf"parameters\.x0\.bounds: must be {must}"):
        check_bounds(replace(one, parameters=(replace(parameter, scale=scale),)))


@pytest.mark.parametrize(("cost", "ranked"), [("sse", "log(cost)"), ("likelihood", "cost")])
def test_the_logarithm_of_a_cost_is_taken_once(cost, ranked):
    """A log likelihood is one already; of exp(x)^2 both are 2 x and a constant."""
    found = between(lambda x: np.exp(x[0]), 1, cost=cost)
    assert found.ranks == f"mu* of {ranked}"
    assert found.ranking[0].value == pytest.approx(2.0)
    assert found.ranking[0].together


@pytest.mark.parametrize(
    "changed", [{"method": "oat"}, {"groups": -1}, {"groups": 3}, {"collinearity": 0.5}]
)
def test_bad_settings_are_refused(changed):
    with pytest.raises(ProblemError, match=r"sensitivity\."):
        SensitivitySettings(**changed)


BASIS = np.linalg.qr(np.random.default_rng(2).normal(size=(40, 5)))[0]


def ordered(*columns, high=None):
    """In the order of estimation: of residuals that are linear in the unknowns."""
    matrix = np.column_stack(columns)
    high = np.ones(matrix.shape[1]) if high is None else np.array(high)
    found = analysed(lambda x: matrix @ x, 0.0 * high, high, groups=4)
    return sorted(found.ranking, key=lambda unknown: unknown.position)


def test_independent_columns_are_ordered_by_size():
    found = ordered(BASIS[:, 0], 5.0 * BASIS[:, 1], 2.0 * BASIS[:, 2])
    assert [each.label for each in found] == ["x1", "x2", "x0"]
    assert [each.collinearity for each in found] == pytest.approx([1.0, 1.0, 1.0])
    assert all(each.together for each in found)
    assert [each.size / found[2].size for each in found] == pytest.approx([5.0, 2.0, 1.0])


@pytest.mark.parametrize("angle", [0.05, 0.1])
def test_the_collinearity_of_two_columns_is_that_of_their_angle(angle):
    """Eigenvalues of N'N are 1 +- cos."""
    second = np.cos(angle) * BASIS[:, 0] + np.sin(angle) * BASIS[:, 1]
    found = ordered(2.0 * BASIS[:, 0], second)
    assert found[1].collinearity == pytest.approx(1.0 / np.sqrt(1.0 - np.cos(angle)))
    assert found[1].together == (found[1].collinearity < SensitivitySettings().collinearity)


def test_what_others_make_up_for_is_left_out_and_spoils_nothing_after_it():
    a, b, c = BASIS[:, 0], BASIS[:, 1], BASIS[:, 2]
    found = ordered(3.0 * a, 2.0 * b, a + b, 0.5 * c)
    assert [each.label for each in found] == ["x0", "x1", "x3", "x2"]
    assert [each.together for each in found] == [True, True, True, False]
    assert found[3].collinearity > 1e6


def test_what_the_data_do_not_see_is_last():
    found = ordered(np.zeros(40), BASIS[:, 0])
    assert [each.label for each in found] == ["x1", "x0"]
    assert found[1].collinearity == np.inf
    assert not found[1].together


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_units_of_an_unknown_do_not_matter(unit):
    plain = ordered(BASIS[:, 0], 0.5 * BASIS[:, 1])
    other = ordered(BASIS[:, 0] / unit, 0.5 * BASIS[:, 1], high=[unit, 1.0])
    assert [e.label for e in plain] == [e.label for e in other]
    assert [e.size for e in plain] == pytest.approx([e.size for e in other])
