"""Multiple shooting on models that are stable, chaotic and unstable, against other solutions.

The data are SciPy's solutions of the physics, written down in another way than in the FMUs.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.cut_logs import cut
from support.problems.seen_springs import values_of, with_outputs
from support.problems.springs import ROOT, spring_problem
from support.run_folders import SPRING, change_facts

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS

MODELS = ROOT / "configs" / "models"
NOISE = 0.01


def read(name: str, parameters: list[ce.Parameter], experiment: ce.Experiment) -> ce.Problem:
    model = ce.read_model(MODELS / f"{name}.fmu")
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
        ce.Parameter("J", 0.15, (0.001, 10.0)),
        ce.Parameter("G", 3.0, (0.1, 100.0)),
        ce.Parameter("b", 0.02, (0.0, 10.0)),
        ce.Parameter("angle0", 0.3, variable="angle"),
        ce.Parameter("speed0", 0.0, variable="speed"),
    ]
    return read("pendulum", parameters, experiment)


PENDULUM = {"J": 0.1, "G": 2.0, "b": 0.04}


@cache
def balanced() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, states and forces of a rod that a controller keeps upright for 8 s."""
    step, g = 0.01, 9.81
    cart, rod, length, friction = 1.0, 0.3, 0.5, 0.5
    state, path, forces = np.array([0.0, 0.05, 0.0, 0.0]), [], []
    times = np.arange(0.0, 8.0 + step / 2, step)

    def rate(_: float, z: np.ndarray, force: float) -> list[float]:
        q, v, w = z[1:]
        side = rod * length * np.cos(q)
        push = force - friction * v + rod * length * w * w * np.sin(q)
        fall = rod * g * length * np.sin(q)
        whole = (cart + rod) * rod * length**2 - side**2
        return [
            v,
            w,
            (rod * length**2 * push - side * fall) / whole,
            ((cart + rod) * fall - side * push) / whole,
        ]

    for t in times:
        wanted = 0.3 * np.sin(1.1 * t) + 0.2 * np.sin(2.9 * t + 1.0)
        force = float(np.array([3.2, 45.0, 6.0, 10.0]) @ (state - [wanted, 0.0, 0.0, 0.0]))
        path.append(state)
        forces.append(force)
        found = solve_ivp(rate, (0.0, step), state, args=(force,), rtol=1e-10, atol=1e-12)
        state = found.y[:, -1]
    return times, np.array(path), np.array(forces)


def standing_rod(samples: int = 801) -> ce.Problem:
    """A rod that a controller keeps upright, linear: cosh with what is fed back."""
    times, path, forces = (part[:samples] for part in balanced())
    generator, outputs = np.random.default_rng(2), []
    for name, values in zip(("y1", "y2"), path.T, strict=False):
        sigma = NOISE * float(np.std(values))
        noisy = values + sigma * generator.normal(size=len(values))
        outputs.append(ce.Output(name, times, noisy, sigma=sigma))
    force = ce.Input("F", times, forces, "hold")
    experiment = ce.Experiment("stand", 0.0, float(times[-1]), (force,), tuple(outputs), {"d": 0.0})
    states = ("position", "angle", "velocity", "speed")
    parameters = [
        ce.Parameter("m_cart", 1.5, (0.05, 20.0)),
        ce.Parameter("m_rod", 0.15, (0.01, 6.0)),
        ce.Parameter("l", 0.75, (0.02, 10.0)),
        ce.Parameter("b", 0.25, (0.0, 10.0)),
        *(ce.Parameter(f"{name}0", 0.0, variable=name) for name in states),
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


def springs(records: int = 2, samples: int = 100, **how) -> ce.Problem:
    return spring_problem(records, samples, noise=0.01, **how).problem


@pytest.mark.parametrize(
    "problem",
    [
        springs(),
        springs(interface="co_simulation", solver=ce.Solver("fmu")),
        with_outputs(springs(), lambda o: replace(o, variable="x", sigma=0.1)),
    ],
    ids=["model exchange", "co-simulation", "a state that is measured"],
)
def test_a_stable_model_is_fitted_as_without_segments(problem):
    plain, shot = ce.fit(problem), ce.fit(problem, shooting={"segments": 5})
    assert shot.shooting.joined
    assert shot.shooting.cost == pytest.approx(shot.cost, rel=1e-6)
    assert shot.cost == pytest.approx(plain.cost, rel=1e-7)
    for label, value in plain.x.items():
        assert shot.x[label] == pytest.approx(value, rel=1e-4, abs=1e-5)
    assert any("result of multiple shooting with 10 segments" in note for note in shot.notes)


@pytest.mark.parametrize(
    ("records", "samples", "shooting", "segments"),
    [
        (2, 41, {"length": 0.2}, 8),
        (2, 41, {"length": 0.3}, 6),
        (2, 41, {"length": 5.0}, 2),
        (1, 9, {"segments": 1000}, 8),
        (1, 9, {"length": 1e-9}, 8),
    ],
)
def test_records_are_cut_into_so_many_segments(records, samples, shooting, segments):
    """A length is the longest that one may be, and each has a sample at least."""
    found = ce.fit(springs(records, samples), shooting=shooting)
    assert found.shooting.asked == segments


@pytest.mark.slow
def test_standard_errors_by_segments_are_those_of_whole_records():
    """Whole records are not tried where they explain less than half of what was measured."""
    problem = spring_problem(2, 100, noise=0.3).problem
    plain, shot = ce.fit(problem), ce.fit(problem, shooting={"segments": 5})
    assert not shot.shooting.joined
    assert shot.shooting.largest_jump < 1e-5
    assert shot.cost == pytest.approx(plain.cost, rel=1e-5)
    for one, other in zip(plain.estimates, shot.estimates, strict=True):
        assert other.value == pytest.approx(one.value, abs=0.01 * one.std_error)
        assert other.std_error == pytest.approx(one.std_error, rel=1e-2)


@pytest.mark.slow
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
    assert "come from 32 segments" in said
    assert "in one piece from their start, the cost is" in said


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


@pytest.mark.slow
def test_workers_change_no_bit_and_what_needs_whole_records_is_left_out(standing):
    again = ce.fit(
        standing.problem,
        resources=ce.Resources("processes", workers=2),
        shooting={"segments": 32},
        uncertainty=ce.UncertaintySettings(profiles=("m_cart",)),
    )
    assert again.x == standing.x
    assert again.cost == standing.cost
    assert "uncertainty.profiles was requested but is not computed" in " ".join(again.notes)


@pytest.mark.slow
def test_segments_that_are_too_long_are_cut_in_halves_and_that_is_said():
    result = ce.fit(standing_rod(), shooting={"segments": 2})
    assert near(result, ROD)
    assert result.shooting.segments > result.shooting.asked == 2
    assert any("instead of 2, because 2 segments were too long" in note for note in result.notes)


def test_a_config_asks_for_it_and_a_run_that_was_cut_is_taken_up(tmp_path, capsys):
    given = ["fit", SPRING, "--out", str(tmp_path), "--no-report", "method.shooting.segments=6"]
    assert main(given) == 0
    assert "result of multiple shooting with 24 segments" in " ".join(
        capsys.readouterr().out.split()
    )
    whole = values_of(tmp_path)
    cut(tmp_path / "evaluations", 60)
    change_facts(tmp_path, status="running", verdict=None)
    assert main([*given, "--resume"]) == 0
    assert values_of(tmp_path) == whole
    assert (tmp_path / "segments.parquet").exists()


@pytest.mark.parametrize(
    ("override", "sentence"),
    [
        ("method.shooting={segments=1}", "method.shooting.segments"),
        ("multistart.n=4", "multistart asks for 4 starts"),
    ],
)
def test_what_a_config_cannot_ask_for_is_one_sentence(tmp_path, capsys, override, sentence):
    given = ["fit", SPRING, "--out", str(tmp_path / "run"), "method.shooting.segments=6"]
    assert main([*given, override]) == 2
    printed = " ".join(capsys.readouterr().err.split())
    assert sentence in printed
    assert "Traceback" not in printed


def remembering(form: str, site: str) -> ce.Problem:
    problem = springs()
    tau = ce.Parameter("late.tau", 0.1, (0.01, 1.0))
    effect = ce.Effect("late", site, form)
    return replace(problem, effects=(effect,), parameters=(*problem.parameters, tau))


def stateless() -> ce.Problem:
    model = ce.read_model(ROOT / "configs" / "league" / "models" / "ur5e.fmu")
    times = np.arange(5.0)
    run = ce.Experiment("a", 0.0, 4.0, (), (ce.Output("i", times, times),))
    return ce.Problem(model, (ce.Parameter("J", 1.0),), (run,))


THREE = {"segments": 3}
FREE = with_outputs(springs(), lambda o: replace(o, free_offset=True))


@pytest.mark.parametrize(
    ("problem", "shooting", "how", "said"),
    [
        (springs(), {}, {}, "shooting: must have either segments or length.* neither"),
        (springs(), {"segments": 3, "length": 1.0}, {}, "shooting: must have .* both"),
        (springs(), {"segments": 1}, {}, r"shooting\.segments: must be .*2"),
        (springs(), {"length": 0.0}, {}, r"shooting\.length: must be .*0"),
        (springs(), {"parts": 3}, {}, "unknown key method.shooting.parts"),
        (FREE, THREE, {}, "'e0'.*a free scale or offset"),
        (remembering("lag", "output y"), THREE, {}, "'late', which has an internal state"),
        (remembering("delay", "input F"), THREE, {}, "'late', which depends on the past"),
        (stateless(), THREE, {}, "needs a model with states"),
        (replace(springs(), cost=COSTS["huber"]()), THREE, {}, 'needs cost.name = "sse"'),
        (springs(), THREE, {"method": "pattern_search"}, "needs .*least_squares.* pattern_search"),
        (springs(), THREE, {"multistart": ce.Multistart(n=3)}, "multistart asks for 3 starts"),
    ],
)
def test_what_segments_cannot_help_is_refused(problem, shooting, how, said):
    with pytest.raises(ProblemError, match=said):
        ce.fit(problem, shooting=shooting, **how)


@pytest.mark.slow
def test_a_price_of_continuity_that_no_noise_explains_is_said(standing):
    assert standing.shooting.continuity_p > 0.01
    pushed = with_outputs(
        springs(1), lambda o: replace(o, values=o.values + 0.05 * np.sin(9.0 * o.times), sigma=0.01)
    )
    result = ce.fit(pushed, shooting={"segments": 5})
    assert result.shooting.continuity_p < 1e-3
    assert any("noise does not explain the difference" in note for note in result.notes)


def test_a_budget_that_runs_out_is_no_sign_of_chaos():
    resources = ce.Resources(budget=ce.Budget(evaluations=40))
    result = ce.fit(springs(), resources=resources, shooting={"segments": 5})
    assert not result.success
    said = " ".join(result.notes)
    assert "chaotic" not in said
    assert "budget is used up" in said or "was stopped before it reached a solution" in said
