"""Costs, time bases, constraints and kinds of problems through an FMU whose answers are known.

The mass-spring-damper is linear: SciPy solves it exactly and minimises the same costs on its own.
"""

import numpy as np
import pytest
from scipy.optimize import brentq, least_squares, minimize
from scipy.signal import StateSpace, lsim
from support.problems.springs import FMU
from support.run_folders import rows

from cluster_est import LeastSquares, build_problem, fit, simulate
from cluster_est.cli import main
from cluster_est.config.reader import parse_config
from cluster_est.methods.nelder_mead import NelderMead
from cluster_est.methods.pattern_search.synchronous import PatternSearch
from cluster_est.methods.sqp.sqp import Sqp
from cluster_est.toml import to_toml

TRUE = {"m": 1.2, "k": 30.0, "c": 0.6}
TIMES = np.round(np.arange(301) * 0.01, 2)
FORCE = 3.0 * np.random.default_rng(1).normal(size=301)
NOISE = np.random.default_rng(2).normal(size=(2, 301))
PARAMETERS = {
    "m": {"start": 1.0, "bounds": [0.1, 10.0]},
    "k": {"start": 24.0, "bounds": [1.0, 200.0]},
    "c": {"start": 0.8, "bounds": [0.0, 10.0]},
}


def motion(m, k, c, x0=0.0, force=FORCE):
    """(2, times): position and speed, exactly, with the force linear between its samples."""
    system = StateSpace([[0.0, 1.0], [-k / m, -c / m]], [[0.0], [1.0 / m]], np.eye(2), [[0.0]] * 2)
    return lsim(system, force, TIMES, [x0, 0.0])[2].T


DATA = motion(**TRUE)
AT_START = motion(*(p["start"] for p in PARAMETERS.values()))


@pytest.fixture
def build(tmp_path):
    """Write measured positions and speeds, and make a problem of them and the keys."""

    def call(y=DATA[0], v=None, allow_code=False, **keys):
        tree = written(tmp_path, y, v, **keys)
        return build_problem(parse_config(tree, "c.toml"), tmp_path, allow_code=allow_code)

    return call


def written(folder, y, v=None, **keys):
    """A table and the config for it; `experiment` has more keys of the only experiment."""
    columns = [TIMES, FORCE, y, *([] if v is None else [v])]
    lines = [",".join("" if np.isnan(x) else repr(float(x)) for x in row)
            for row in np.transpose(columns)]  # fmt: skip
    header = "time,force,y" + ("" if v is None else ",v")
    (folder / "data.csv").write_text("\n".join([header, *lines]) + "\n")
    outputs = {"y": "y"} | ({} if v is None else {"v": "v"})
    experiment = {"id": "run", "data": "data.csv", "time": "time", "inputs": {"F": "force"}}
    experiment |= {"outputs": outputs, **keys.pop("experiment", {})}
    model = {"fmu": str(FMU), "rtol": 1e-10}
    return {"model": model, "parameters": PARAMETERS, "experiments": [experiment], **keys}


@pytest.fixture
def command(tmp_path):
    """The exit code of a fit of a config beside the functions of the user's."""

    def call(tree, out="out", *more):
        (tmp_path / "mine.py").write_text(SOURCE)
        (tmp_path / "c.toml").write_text(to_toml(tree))
        return main(["fit", str(tmp_path / "c.toml"), "--out", str(tmp_path / out), *more])

    return call


def scipy_fit(residuals, **options):
    """The minimum that SciPy finds from the truth, and twice its cost: the sum of rho."""
    found = least_squares(
        lambda x: residuals(*x), list(TRUE.values()), x_scale="jac", xtol=1e-14, ftol=1e-14,
        gtol=1e-14, **options,
    )  # fmt: skip
    return dict(zip(TRUE, found.x.tolist(), strict=True)), 2.0 * found.cost


def close(result, expected, rel):
    assert result.success, result.solution.ending
    for name, value in expected.items():
        assert result.x[name] == pytest.approx(value, rel=rel), name


# --- costs

SIGMA = 2e-3
OUTLIERS = np.where(np.random.default_rng(3).random(301) < 0.1, 0.3, 0.0)
SPOILED = DATA[0] + SIGMA * NOISE[0] + OUTLIERS
SIGMAS = {"experiment": {"sigma": {"y": SIGMA}}}


@pytest.mark.parametrize(
    ("name", "scale", "method"),
    [
        ("huber", 1.345, LeastSquares()),
        ("huber", 0.5, Sqp()),
        ("soft_l1", 1.0, Sqp()),
        ("cauchy", 2.385, LeastSquares()),
    ],
)
def test_robust_costs_have_the_minimum_that_scipy_finds(build, name, scale, method):
    expected, cost = scipy_fit(
        lambda m, k, c: (SPOILED - motion(m, k, c)[0]) / SIGMA, loss=name, f_scale=scale
    )
    result = fit(build(SPOILED, cost={"name": name, "options": {"scale": scale}}, **SIGMAS), method)
    close(result, expected, 1e-4)
    assert result.cost == pytest.approx(cost, rel=1e-6)


def test_the_sum_of_absolute_values(build):
    def cost(x):
        return float(np.abs(SPOILED - motion(*x)[0]).sum() / SIGMA)

    start = np.array(list(TRUE.values()))
    options = {"xatol": 1e-8, "fatol": 1e-8, "maxiter": 2000}
    expected = minimize(cost, start, method="Nelder-Mead", options=options)
    result = fit(build(SPOILED, cost={"name": "sae"}, **SIGMAS), NelderMead(bounds="enforce"))
    close(result, dict(zip(TRUE, expected.x, strict=True)), 1e-2)
    assert result.cost == pytest.approx(cost(list(result.x.values())), rel=1e-6)
    assert result.cost == pytest.approx(expected.fun, rel=1e-4)


def test_the_likelihood_of_two_outputs_whose_noise_nobody_knows(build):
    y, v = DATA + np.array([[2e-3], [5e-2]]) * NOISE

    def cost(x):
        return sum(301 * np.log(np.mean(e**2)) for e in np.array([y, v]) - motion(*x))

    def scaled(x):
        return cost(x * np.array(list(TRUE.values())))

    expected = minimize(scaled, np.ones(3), method="BFGS", options={"gtol": 1e-3})
    values = dict(zip(TRUE, expected.x * np.array(list(TRUE.values())), strict=True))
    result = fit(build(y, v, cost={"name": "likelihood"}))
    close(result, values, 1e-4)
    assert result.cost == pytest.approx(expected.fun, abs=1e-5)
    # neither the size that noise is given nor the weight of an output matters to it
    other = fit(build(y, v, cost={"name": "likelihood", "weights": {"v": 7.0}},
                      experiment={"sigma": {"y": 30.0}}))  # fmt: skip
    close(other, result.x, 1e-6)


def test_residuals_are_those_of_the_time_base_the_windows_and_the_weights(build):
    """Positions every 0.02 s from 0, speeds every 0.05 s from 0.1 to 2.5 s, one of them held."""
    y_at, v_at = np.arange(0, 301, 2), np.arange(10, 251, 5)
    y, v = np.full((2, 301), np.nan)
    y[y_at], v[v_at] = DATA[0, y_at] + 0.1, DATA[1, v_at] - 0.2
    outputs = {"y": {"column": "y", "weight": 4.0}, "v": {"column": "v", "interpolation": "hold"}}
    run = {"outputs": outputs, "weight": 9.0, "sigma": {"y": 0.1}, "windows": [[0.0, 2.0]]}
    cost = {"time_base": "both", "step": 0.03, "weights": {"v": 0.25}}
    problem = build(y, v, cost=cost, experiment={**run, "warm_up": 0.5})
    places = np.union1d(np.union1d(y_at, v_at), np.arange(0, 301, 3))
    places = places[(places >= 50) & (places <= 200)]
    held = v[v_at][np.searchsorted(v_at, places, side="right") - 1]
    expected = [
        (np.interp(TIMES[places], TIMES[y_at], y[y_at]) - AT_START[0][places]) / (0.1 / 6.0),
        (held - AT_START[1][places]) / (1.0 / 1.5),
    ]
    (found,) = simulate(problem).values()
    np.testing.assert_allclose(found.outcome.residuals, np.concatenate(expected), atol=1e-5)


# --- constraints on parameters


@pytest.mark.parametrize(
    ("text", "whole", "method"),
    [
        ("k <= 20 * m", lambda a, b: (a, 20.0 * a, b), LeastSquares()),
        ("m + c = 1.5", lambda a, b: (a, 20.0 * b + 20.0, 1.5 - a), Sqp()),
        ("20 <= k / m <= 23", lambda a, b: (a, 23.0 * a, b), PatternSearch()),
    ],
)
def test_a_constraint_on_parameters_that_the_data_contradict(build, text, whole, method):
    """SciPy minimises over what is left when the constraint is put into the model."""
    measured = DATA[0] + SIGMA * NOISE[0]
    found = least_squares(
        lambda x: measured - motion(*whole(*x))[0], [1.0, 0.5], xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    expected = dict(zip(TRUE, whole(*found.x), strict=True))
    result = fit(build(measured, constraints=[{"expression": text}]), method)
    close(result, expected, 2e-3)
    assert result.cost == pytest.approx(2.0 * found.cost, rel=1e-4)
    assert all(row.satisfied for row in result.constraints)


# --- constraints on signals: a spring that is let go at 1 m, a step from 1 to 0

LET_GO = motion(**TRUE, x0=1.0, force=0.0 * FORCE)
ONLY_C = {"c": PARAMETERS["c"]}
KNOWN = {"m": TRUE["m"], "k": TRUE["k"], "x": 1.0}
ZETA = -np.log(0.1) / np.hypot(np.pi, np.log(0.1))
"""Damping ratio at which a step overshoots by a tenth."""
CRITICAL = 2.0 * np.sqrt(TRUE["k"] * TRUE["m"])
STEP = {"initial": 1.0, "final": 0.0, "rise_time": 0.6, "settling_time": 2.0, "settling": 5.0}


def free(c):
    return motion(TRUE["m"], TRUE["k"], c, 1.0, 0.0 * FORCE)[0]


LAST = LET_GO[0, -1]


def ends_at(value):
    """The damping with which the record ends at a value that is nearer to 0 than the data's."""
    return float(brentq(lambda c: free(c)[-1] - value, TRUE["c"], 5.0 * TRUE["c"]))


@pytest.mark.parametrize(
    ("constraint", "expected", "rel", "method"),
    [
        ({"lower": -0.1, "samples": 3001}, ZETA * CRITICAL, 1e-3, LeastSquares()),
        ({"step_response": STEP, "samples": 3001}, ZETA * CRITICAL, 1e-3, LeastSquares()),
        (
            {"lower": -0.1, "upper": 1.0, "between": [0.1, 3.0], "samples": 3001},
            *(ZETA * CRITICAL, 1e-3, PatternSearch()),
        ),
        ({"final": 0.5 * LAST}, ends_at(0.5 * LAST), 1e-4, Sqp()),
    ],
)
def test_a_fit_stops_where_a_limit_of_a_signal_is_met(build, constraint, expected, rel, method):
    """The data overshoot by 73 % and end farther off, so the damping is the least allowed."""
    keys = {"parameters": ONLY_C, "values": KNOWN, "constraints": [{"signal": "y"} | constraint]}
    result = fit(build(LET_GO[0], experiment={"inputs": {}}, **keys), method)
    close(result, {"c": expected}, rel)
    assert all(row.satisfied for row in result.constraints)
    if "final" not in constraint:
        assert max(row.after for row in result.constraints) == pytest.approx(0.0, abs=2e-6)
    else:
        assert [row.kind for row in result.constraints] == ["= 0"]


def test_constraints_that_contradict_each_other_are_said_to(build):
    problem = build(constraints=[{"expression": "m <= 1"}, {"expression": "m >= 2"}])
    result = fit(problem)
    assert not result.success
    assert [row.satisfied for row in result.constraints] != [True, True]


# --- kinds of problems


def feasible(constraint, parameters):
    """A config with a constraint and no data."""
    return {
        "model": {"fmu": str(FMU)},
        "experiments": [{"id": "run", "start": 0.0, "stop": 3.0}],
        "constraints": [{"signal": "y", **constraint}],
        "parameters": parameters,
        "values": KNOWN,
    }


@pytest.mark.parametrize(
    ("c", "method"), [(0.0, LeastSquares()), (0.8, PatternSearch()), (10.0, Sqp())]
)
def test_pure_feasibility_needs_no_data(tmp_path, method, c):
    """Whatever it starts from, it ends where SciPy's step response keeps within the envelope."""
    envelope = {"step_response": STEP, "samples": 601}
    tree = feasible(envelope, {"c": {"start": c, "bounds": [0.0, 30.0]}})
    result = fit(build_problem(parse_config(tree, "c.toml"), tmp_path), method)
    assert result.success, result.solution.ending
    assert all(row.satisfied for row in result.constraints)
    y = free(result.x["c"])
    assert y.min() >= -0.1 - 1e-5
    assert (np.abs(y[TIMES >= 2.0]) <= 0.05 + 1e-5).all()
    assert (y[TIMES >= 0.6] <= 0.2 + 1e-5).all()


def test_pure_feasibility_by_the_command_line(tmp_path, command, capsys):
    assert command(feasible({"lower": -0.1}, ONLY_C), "out", "--no-report") == 0
    assert "y lower [run]" in capsys.readouterr().out
    (row,) = rows(tmp_path / "out", "constraints")
    assert row["before"] > 0.0
    assert row["satisfied"]


# --- functions of the user's

SOURCE = """
import numpy as np

def residuals(run):
    return run.residuals("y")

def total(run):
    return float(np.sum(run.residuals("y") ** 2))

def overshoot(run):
    return -run.simulated["y"].min() - 0.1
"""


def test_a_cost_function_by_the_command_line(tmp_path, command, capsys):
    tree = written(tmp_path, DATA[0] + SIGMA * NOISE[0])
    assert command(tree, "plain") == 0
    assert command(tree, "own", "cost.function=mine:residuals", "--allow-code") == 0
    capsys.readouterr()
    assert command(tree, "refused", "cost.function=mine:residuals") == 2
    assert "--allow-code" in capsys.readouterr().err
    assert not (tmp_path / "refused").exists()
    plain, own = tmp_path / "plain", tmp_path / "own"
    assert [r["value"] for r in rows(own, "parameters")] == [
        r["value"] for r in rows(plain, "parameters")
    ]


def test_a_cost_function_that_returns_one_number(tmp_path, build):
    (tmp_path / "mine.py").write_text(SOURCE)
    measured = DATA[0] + SIGMA * NOISE[0]
    expected, cost = scipy_fit(lambda m, k, c: measured - motion(m, k, c)[0])
    own = {"name": "total", "function": "mine:total"}
    result = fit(build(measured, cost=own, allow_code=True), Sqp())
    close(result, expected, 5e-3)
    assert result.cost == pytest.approx(cost, rel=1e-4)


def test_a_constraint_function_by_the_command_line(tmp_path, command):
    keys = {"constraints": [{"name": "overshoot", "function": "mine:overshoot"}]}
    keys |= {"parameters": ONLY_C, "values": KNOWN, "experiment": {"inputs": {}}}
    tree, out = written(tmp_path, LET_GO[0], **keys), tmp_path / "out"
    assert command(tree, "refused") == 2
    assert command(tree, "out", "--allow-code") == 0
    assert rows(out, "parameters")[0]["value"] == pytest.approx(ZETA * CRITICAL, rel=2e-3)
    (row,) = rows(out, "constraints")
    assert (row["constraint"], row["satisfied"]) == ("overshoot [run]", True)


# --- many starts


def test_many_starts_by_the_command_line(tmp_path, command, capsys):
    """A third of the bounds has negative masses, which cannot be simulated."""
    measured = DATA[0] + SIGMA * NOISE[0]
    expected, _ = scipy_fit(lambda m, k, c: measured - motion(m, k, c)[0])
    parameters = PARAMETERS | {"m": {"start": 1.0, "bounds": [-2.5, 5.0]}}
    tree, out = written(tmp_path, measured, parameters=parameters), tmp_path / "out"
    assert command(tree, "out", "multistart.n=12") == 0
    assert "starts of 12" in capsys.readouterr().out
    starts, minima = rows(out, "starts"), rows(out, "minima")
    assert [row["start"] for row in starts] == list(range(12))
    failed = [row for row in starts if row["minimum"] < 0]
    assert failed
    assert {row["ending"] for row in failed} == {"start_failed"}
    best = {row["label"]: row["value"] for row in minima if row["point"] == 0}
    assert best == pytest.approx(expected, rel=1e-4)
    assert best == {row["label"]: row["value"] for row in rows(out, "parameters")}
    costs = {row["point"]: row["cost"] for row in minima}
    assert list(costs.values()) == sorted(costs.values())
    for row in starts:
        if row["minimum"] >= 0:
            assert row["cost"] == pytest.approx(costs[row["minimum"]], rel=1e-3)
    assert main(["show", str(out), "--search", "start 3"]) == 0
    assert "iteration" in capsys.readouterr().out
