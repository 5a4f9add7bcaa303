"""Multiple shooting on models that are stable, chaotic and unstable, against other solutions.

The data are SciPy's solutions of the physics, written down in another way than in the FMUs.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp
from support.cut_logs import cut
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.environment import RunEnvironment
from cluster_est.running.resources import one_blas_thread
from cluster_est.shooting.settings import Shooting
from cluster_est.shooting.shoot import shoot
from cluster_est.uncertainty import intervals

MODELS = ROOT / "configs" / "models"
NOISE = 0.01


def read(name: str, parameters: list[ce.Parameter], experiment: ce.Experiment) -> ce.Problem:
    model = ce.read_model(MODELS / f"{name}.fmu", [p.target for p in parameters])
    return ce.Problem(model, tuple(parameters), (experiment,))


def chaotic_pendulum() -> ce.Problem:
    """A pendulum that is driven over the top; its parameters start 50 % off."""
    times = np.arange(0.0, 30.0, 0.03)
    torque = 1.9 * np.sin(3.0 * times)

    def rate(t: float, state: np.ndarray) -> list[float]:
        lever = np.interp(t, times, torque) - 2.0 * np.sin(state[0]) - 0.04 * state[1]
        return [state[1], lever / 0.1]

    span = (times[0], times[-1])
    found = solve_ivp(rate, span, [0.3, 0.0], t_eval=times, rtol=1e-10, atol=1e-11, max_step=0.03)
    angle = found.y[0] + NOISE * np.random.default_rng(5).normal(size=len(times))
    output = ce.Output("y", times, angle, sigma=NOISE)
    experiment = ce.Experiment("swing", *span, (ce.Input("torque", times, torque),), (output,))
    parameters = [
        ce.Parameter("J", 0.15, 0.001, 10.0),
        ce.Parameter("G", 3.0, 0.1, 100.0),
        ce.Parameter("b", 0.02, 0.0, 10.0),
        ce.Parameter("angle0", 0.3, variable="angle"),
        ce.Parameter("speed0", 0.0, variable="speed"),
    ]
    return read("pendulum", parameters, experiment)


PENDULUM = {"J": 0.1, "G": 2.0, "b": 0.04}


def standing_rod(seconds: float = 8.0) -> ce.Problem:
    """A rod that a controller keeps upright, linear: cosh with what is fed back."""
    step, g = 0.01, 9.81
    cart, rod, length, friction = 1.0, 0.3, 0.5, 0.5
    generator = np.random.default_rng(2)
    state, path, forces = np.array([0.0, 0.05, 0.0, 0.0]), [], []
    times = np.arange(0.0, seconds + step / 2, step)

    def rate(z: np.ndarray, force: float) -> np.ndarray:
        q, v, w = z[1:]
        mass = np.array(
            [[cart + rod, rod * length * np.cos(q)], [rod * length * np.cos(q), rod * length**2]]
        )
        right = [
            force - friction * v + rod * length * w * w * np.sin(q),
            rod * g * length * np.sin(q),
        ]
        return np.concatenate([[v, w], np.linalg.solve(mass, right)])

    for t in times:
        wanted = 0.3 * np.sin(1.1 * t) + 0.2 * np.sin(2.9 * t + 1.0)
        force = float(np.array([3.2, 45.0, 6.0, 10.0]) @ (state - [wanted, 0.0, 0.0, 0.0]))
        path.append(state)
        forces.append(force)
        found = solve_ivp(
            lambda _, z, f=force: rate(z, f), (0.0, step), state, rtol=1e-10, atol=1e-12
        )
        state = found.y[:, -1]
    outputs = []
    for name, values in (("y1", np.array(path)[:, 0]), ("y2", np.array(path)[:, 1])):
        sigma = NOISE * float(np.std(values))
        noisy = values + sigma * generator.normal(size=len(values))
        outputs.append(ce.Output(name, times, noisy, sigma=sigma))
    force = ce.Input("F", times, np.array(forces), "hold")
    experiment = ce.Experiment("stand", 0.0, float(times[-1]), (force,), tuple(outputs), {"d": 0.0})
    parameters = [
        ce.Parameter("m_cart", 1.5, 0.05, 20.0),
        ce.Parameter("m_rod", 0.15, 0.01, 6.0),
        ce.Parameter("l", 0.75, 0.02, 10.0),
        ce.Parameter("b", 0.25, 0.0, 10.0),
        *(
            ce.Parameter(f"{name}0", 0.0, variable=name)
            for name in ("position", "angle", "velocity", "speed")
        ),
    ]
    return read("cart_pendulum", parameters, experiment)


ROD = {"m_cart": 1.0, "m_rod": 0.3, "l": 0.5, "b": 0.5}


def near(result: ce.Result, truth: dict[str, float]) -> bool:
    """Whether each value lies within four standard errors of the truth, none above 5 %."""
    known = {e.label: e for e in result.estimates}
    return all(
        abs(known[n].value - true) < 4.0 * known[n].std_error < 0.2 * true
        for n, true in truth.items()
    )


@pytest.mark.parametrize("interface", ["model_exchange", "co_simulation"])
def test_a_stable_model_is_fitted_as_without_segments(interface):
    solver = ce.Solver("fmu") if interface == "co_simulation" else None
    problem = spring_problem(2, 100, noise=0.01, interface=interface, solver=solver).problem
    plain, shot = ce.fit(problem), ce.fit(problem, shooting={"segments": 5})
    assert shot.shooting.joined
    assert shot.cost == pytest.approx(plain.cost, rel=1e-7)
    for label, value in plain.x.items():
        assert shot.x[label] == pytest.approx(value, rel=1e-4, abs=1e-5)
    assert any("multiple shooting found on 10 segments" in note for note in shot.notes)


def test_standard_errors_by_segments_are_those_of_whole_records():
    problem = spring_problem(2, 100, noise=0.01).problem
    train = make_space(problem, problem.indices("train"))
    with one_blas_thread():
        shot = shoot(RunEnvironment(), train, ce.LeastSquares(), Shooting(segments=5), 0)
    plain = {e.label: e.std_error for e in ce.fit(problem).estimates}
    for interval, unknown in zip(intervals(train, shot.solution), train.unknowns, strict=True):
        assert interval.std_error == pytest.approx(plain[unknown.label], rel=1e-2)
    assert shot.solution.cost == pytest.approx(shot.summary.cost, rel=1e-6)
    assert shot.summary.largest_jump < 1e-5


def test_a_chaotic_model_is_found_where_whole_records_lead_astray():
    problem = chaotic_pendulum()
    plain = ce.fit(problem)
    assert plain.cost > 100.0 * problem.experiments[0].size
    shot = ce.fit(problem, shooting={"length": 1.5})
    assert shot.success
    assert near(shot, PENDULUM)
    assert shot.cost == pytest.approx(problem.experiments[0].size, rel=0.15)


@pytest.fixture(scope="module")
def standing() -> ce.Result:
    return ce.fit(standing_rod(), shooting={"segments": 32})


def test_an_unstable_model_is_fitted_in_segments_and_says_so(standing):
    assert standing.success
    assert near(standing, ROD)
    assert not standing.shooting.joined
    assert [e.normalised_after for e in standing.errors] == pytest.approx([1.0, 1.0], abs=0.1)
    said = " ".join(standing.notes)
    assert "are those of 32 segments" in said
    assert "in one piece, from its start, the cost is" in said


def test_the_curves_of_segments_are_one(standing):
    (simulation,) = standing.simulations
    path = simulation.outcome.trajectory
    np.testing.assert_array_equal(path.times, standing.problem.experiments[0].outputs[0].times)
    assert path.variables == ("y1", "y2")
    assert np.isfinite(path.values).all()
    for output in standing.problem.experiments[0].outputs:
        left = (output.values - path.at(output.variable, output.times)) / output.sigma
        assert np.sqrt(np.mean(left**2)) == pytest.approx(1.0, abs=0.1)


def test_each_segment_has_its_states_in_a_table(standing):
    rows = standing.table("segments").to_pylist()
    assert len(rows) == 31 * 4
    assert {row["state"] for row in rows} == {"position", "angle", "velocity", "speed"}
    assert max(abs(row["relative_jump"]) for row in rows) == standing.shooting.largest_jump < 1e-5
    position = [row for row in rows if row["state"] == "position"]
    assert [row["segment"] for row in position] == list(range(2, 33))
    output = standing.problem.experiments[0].outputs[0]
    measured = [np.interp(row["time"], output.times, output.values) for row in position]
    np.testing.assert_allclose([row["guess"] for row in position], measured)


def test_workers_and_their_order_change_no_bit(standing):
    problem = standing.problem
    again = ce.fit(
        problem, resources=ce.Resources("processes", workers=2), shooting={"segments": 32}
    )
    assert again.x == standing.x
    assert again.cost == standing.cost


def test_segments_that_are_too_long_are_cut_in_halves_and_that_is_said():
    result = ce.fit(standing_rod(), shooting={"segments": 2})
    assert near(result, ROD)
    assert result.shooting.segments > result.shooting.asked == 2
    assert any("instead of 2, which were too long" in note for note in result.notes)


def test_segments_that_lead_nowhere_are_said():
    problem = standing_rod(seconds=3.0)
    parameters = tuple(
        replace(p, start=p.start * 0.1) if p.name in ROD else p for p in problem.parameters
    )
    short = ce.LeastSquares(max_iterations=1)
    result = ce.fit(replace(problem, parameters=parameters), short, shooting={"segments": 4})
    assert not result.success


CONFIG = """
[model]
fmu = "{fmu}"
[method]
shooting = {{ segments = 6 }}
[parameters]
m = {{ start = 2.0, bounds = [0.1, 10.0] }}
k = {{ start = 15.0, bounds = [1.0, 100.0] }}
c = {{ start = 0.3, bounds = [0.0, 10.0] }}
[experiment_defaults]
data = "data.csv"
time = "time"
inputs = {{ F = "F" }}
outputs = {{ y = "y" }}
values = {{ x = {x0} }}
[[experiments]]
id = "a"
"""


def written(folder: Path) -> Path:
    truth = spring_problem(1, 120, noise=0.01)
    run = truth.problem.experiments[0]
    columns = [run.inputs[0].times, run.inputs[0].values, run.outputs[0].values]
    np.savetxt(
        folder / "data.csv", np.column_stack(columns), delimiter=",", header="time,F,y", comments=""
    )
    config = folder / "fit.toml"
    fmu = MODELS / "mass_spring_damper.fmu"
    config.write_text(CONFIG.format(fmu=fmu, x0=truth.values["x0[e0]"]), encoding="utf-8")
    return config


def test_a_config_asks_for_it_and_a_run_that_was_cut_is_taken_up(tmp_path, capsys):
    config = str(written(tmp_path))
    out = tmp_path / "run"
    assert main(["fit", config, "--out", str(out), "--no-report"]) == 0
    assert "multiple shooting found on 6 segments" in " ".join(capsys.readouterr().out.split())
    whole = pq.read_table(out / "parameters.parquet").to_pylist()
    facts = json.loads((out / "run.json").read_text(encoding="utf-8"))
    cut(out / "evaluations", 60)
    facts |= {"status": "interrupted"}
    (out / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    assert main(["fit", config, "--out", str(out), "--no-report", "--resume"]) == 0
    assert repr(pq.read_table(out / "parameters.parquet").to_pylist()) == repr(whole)
    assert (out / "segments.parquet").exists()


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("method.shooting.segments=1", "method.shooting.segments"),
        ("method.shooting.length=2.0", "must have segments or length, but has both"),
        ("method.name=sqp", "needs method.name least_squares"),
        ("multistart.n=4", "multistart asks for 4 starts"),
    ],
)
def test_what_cannot_be_is_one_sentence(tmp_path, capsys, override, sentence):
    config = str(written(tmp_path))
    assert main(["fit", config, override, "--out", str(tmp_path / "run")]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert sentence in printed
    assert "Traceback" not in printed


def test_a_price_of_continuity_that_no_noise_explains_is_said(standing):
    assert standing.shooting.continuity_p > 0.01
    problem = standing.problem
    run = problem.experiments[0]
    wave = np.sin(2.0 * run.outputs[0].times)
    pushed = replace(run, outputs=tuple(
        replace(o, values=o.values + o.sigma * wave) for o in run.outputs))  # fmt: skip
    result = ce.fit(replace(problem, experiments=(pushed,)), shooting={"segments": 32})
    assert result.shooting.continuity_p < 1e-3
    assert any("more than noise explains" in note for note in result.notes)


def test_a_budget_that_runs_out_is_no_sign_of_chaos():
    problem = spring_problem(2, 100, noise=0.01).problem
    resources = ce.Resources(budget=ce.Budget(evaluations=40))
    result = ce.fit(problem, resources=resources, shooting={"segments": 5})
    assert not result.success
    said = " ".join(result.notes)
    assert "chaotic" not in said
    assert "budget is used up" in said or "was stopped before it reached a solution" in said


def test_a_length_in_a_wrong_unit_is_as_many_segments_as_samples():
    problem = spring_problem(1, 20, noise=0.01).problem
    result = ce.fit(problem, shooting={"length": 1e-9})
    assert result.shooting.segments == 19


def test_what_works_on_whole_records_is_said_to_be_left_out(standing):
    settings = ce.UncertaintySettings(profiles=("m_cart",))
    result = ce.fit(standing.problem, shooting={"segments": 32}, uncertainty=settings)
    assert "uncertainty.profiles was asked for and left out" in " ".join(result.notes)
