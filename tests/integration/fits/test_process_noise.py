"""Fits by prediction errors, against Kalman filters written down here and exact linear systems."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from support.problems.seen_springs import with_outputs
from support.problems.springs import ROOT, TRUE
from support.run_folders import SPRING
from support.thinning import thinned
from support.truth.kalman_filter import Filter, discrete, pushed, runge_kutta

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import ProblemError
from cluster_est.problem.costs import COSTS
from cluster_est.problem.search_space import make_space
from cluster_est.running.environment import RunEnvironment
from workers.effects.forms import PROCESS_NOISE
from workers.messages import Effect

MODELS = ROOT / "configs" / "models"
STEP, SIGMA = 0.02, 0.02


SYSTEM = np.array([[0.0, 1.0], [-TRUE["k"] / TRUE["m"], -TRUE["c"] / TRUE["m"]]])
BY_FORCE = pushed(SYSTEM, np.array([0.0, 1.0 / TRUE["m"]]), STEP)


def shaken(seed: int, q: float = 0.5, samples: int = 250, outputs: int = 1) -> ce.Experiment:
    """A spring whose mass is driven by a held force and by white noise."""
    generator = np.random.default_rng(seed)
    transition, noise = discrete(SYSTEM, np.diag([0.0, q * q]), STEP)
    root = np.linalg.cholesky(noise + 1e-20 * np.eye(2))
    times = STEP * np.arange(samples)
    force = 3.0 * np.sign(np.sin(4.0 * times))
    state, path = np.array([0.1, 0.0]), []
    for each in force:
        path.append(state)
        state = transition @ state + BY_FORCE * each + root @ generator.normal(size=2)
    noisy = np.array(path) + SIGMA * np.array([1.0, 5.0]) * generator.normal(size=(samples, 2))
    seen = [ce.Output("y", times, noisy[:, 0], sigma=SIGMA)]
    if outputs == 2:  # less often
        seen.append(ce.Output("v", times[::3], noisy[::3, 1], sigma=5.0 * SIGMA))
    given = (ce.Input("F", times, force, "hold"),)
    return ce.Experiment(f"e{seed}", 0.0, times[-1], given, tuple(seen), {"x": 0.1})


DIFFUSION = ce.Effect("noise", "der(v)", "diffusion")
COLOURED = ce.Effect("noise", "input F", "coloured_noise")


def spring(experiments, q: float = 0.5, effect: ce.Effect = DIFFUSION, **model) -> ce.Problem:
    read = ce.read_model(MODELS / "mass_spring_damper.fmu", **model)
    parameters = [
        ce.Parameter("m", 1.0, (0.1, 10.0)),
        ce.Parameter("k", 25.0, (1.0, 200.0)),
        ce.Parameter("c", 0.4, (0.0, 10.0)),
        ce.Parameter("noise.q", q, (0.0, 100.0)),
    ]
    if effect is COLOURED:
        parameters.append(ce.Parameter("noise.tau", 0.05, (1e-3, 10.0), "log"))
    return ce.Problem(read, tuple(parameters), tuple(experiments), effects=(effect,))


def residuals_at(problem: ce.Problem, values: dict[str, float]) -> np.ndarray:
    with ce.residuals(problem) as function:
        return function(np.array([values[name] for name in function.names]))


def kalman(run: ce.Experiment, q: float) -> np.ndarray:
    """What the residuals must be, from the exact discretisation of the spring."""
    return filtered_run(run, q).standardised(range(len(run.outputs)))


def filtered_run(run: ce.Experiment, q: float) -> Filter:
    transition, noise = discrete(SYSTEM, np.diag([0.0, q * q]), STEP)
    found = Filter(np.array([0.1, 0.0]))
    for time, force in zip(run.inputs[0].times, run.inputs[0].values, strict=True):
        for index, output in enumerate(run.outputs):
            for value in output.values[output.times == time]:
                found.correct(index, float(value), output.sigma)
        found.carry(lambda x, f=force: transition @ x + BY_FORCE * f, transition, noise)
    return found


@pytest.mark.parametrize(
    ("solver", "outputs"),
    thinned(
        list(product(["dormand_prince", "rk4"], [1, 2])),
        lambda solver, outputs: solver,
        lambda solver, outputs: outputs,
    ),
)
def test_residuals_are_the_innovations_of_a_kalman_filter(solver, outputs):
    run = shaken(1, outputs=outputs)
    step = 0.002 if solver == "rk4" else None
    problem = spring([run], solver=ce.Solver(solver, step=step))
    found = residuals_at(problem, TRUE | {"noise.q": 0.5})
    np.testing.assert_allclose(found, kalman(run, 0.5), rtol=1e-5, atol=1e-6)


def test_a_linearisation_is_along_the_filter_and_knows_its_spread():
    """With the spread of its own fit taken off, residuals are innovations over their spreads."""
    run = shaken(1)
    problem = spring([run])
    values = TRUE | {"noise.q": 0.5}
    space = make_space(problem, (0,), values)
    with RunEnvironment().executor(problem) as executor:
        runner = RunEnvironment().runner(executor)
        (outcome,) = runner.simulate(
            space.physical(space.start), (0,), "linearisation", "test", problem.effects
        )
    linear, known = outcome.linearisation, filtered_run(run, 0.5)
    errors, spreads = np.array(known.errors[0]).T
    assert linear.log_spread == pytest.approx(np.sum(np.log(spreads)), rel=1e-5)
    # the last correction is the last thing the filter does before it is carried on
    transition, _ = discrete(SYSTEM, np.zeros((2, 2)), STEP)
    last = transition @ linear.states[-1] + BY_FORCE * run.inputs[0].values[-1]
    np.testing.assert_allclose(last, known.state, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(linear.A.at(7), SYSTEM, rtol=1e-6, atol=1e-6)
    own = replace(problem, experiments=(replace(run, log_spread=linear.log_spread),))
    plain = errors / np.sqrt(spreads)
    np.testing.assert_allclose(residuals_at(own, values), plain, rtol=1e-5, atol=1e-6)
    stronger = residuals_at(own, values | {"noise.q": 1.0})
    change = kalman(run, 1.0) @ kalman(run, 1.0) - kalman(run, 0.5) @ kalman(run, 0.5)
    assert stronger @ stronger - plain @ plain == pytest.approx(change, rel=1e-4)


def test_noise_of_no_strength_is_a_simulation():
    run = shaken(2)
    quiet = residuals_at(spring([run], q=0.0), TRUE | {"noise.q": 0.0})
    faint = residuals_at(spring([run]), TRUE | {"noise.q": 1e-7})
    plain = spring([run])
    plain = replace(plain, effects=(), parameters=plain.parameters[:3])
    np.testing.assert_array_equal(quiet, residuals_at(plain, TRUE))
    np.testing.assert_allclose(faint, quiet, rtol=1e-6, atol=1e-6)


def test_a_nonlinear_model_is_filtered_along_its_own_linearisation():
    """A pendulum, against a filter with its own equations."""
    generator = np.random.default_rng(3)
    values = {"J": 0.1, "G": 2.0, "b": 0.04, "n.q": 0.6}
    inertia, gravity, friction, q = values.values()
    step, fine, sigma = 0.02, 200, 0.02

    def rate(x: np.ndarray) -> np.ndarray:
        return np.array([x[1], (-gravity * np.sin(x[0]) - friction * x[1]) / inertia])

    times, state, path = step * np.arange(150), np.array([1.5, 0.0]), []
    for _ in times:
        path.append(state[0])
        for _ in range(fine):
            state = state + rate(state) * step / fine
            state[1] += q * np.sqrt(step / fine) * generator.normal()
    measured = np.array(path) + sigma * generator.normal(size=len(times))
    output = ce.Output("y", times, measured, sigma=sigma)
    run = ce.Experiment("a", 0.0, times[-1], (), (output,), {"angle": 1.5})
    model = ce.read_model(MODELS / "pendulum.fmu")
    parameters = tuple(ce.Parameter(name, value) for name, value in values.items())
    effect = ce.Effect("n", "der(speed)", "diffusion")
    problem = ce.Problem(model, parameters, (run,), effects=(effect,))

    found = Filter(np.array([1.5, 0.0]))
    for y in measured:
        found.correct(0, float(y), sigma)
        stiffness = -gravity * np.cos(found.state[0]) / inertia
        linear = np.array([[0.0, 1.0], [stiffness, -friction / inertia]])
        transition, noise = discrete(linear, np.diag([0.0, q * q]), step)
        found.carry(lambda x: runge_kutta(rate, x, step, 20), transition, noise)
    residuals = residuals_at(problem, values)
    np.testing.assert_allclose(residuals, found.standardised([0]), rtol=1e-6, atol=1e-6)


@pytest.fixture(scope="module")
def fitted() -> ce.Result:
    return ce.fit(spring([shaken(seed, samples=400) for seed in (11, 12, 13)], q=0.2))


def test_a_fit_finds_the_parameters_and_the_strength_of_the_noise(fitted):
    assert fitted.success
    for each in fitted.estimates:
        true = (TRUE | {"noise.q": 0.5})[each.label]
        assert abs(each.value - true) < 3.0 * each.std_error < 0.6 * true
    assert fitted.diagnostics is not None
    notes = " ".join(fitted.notes)
    assert "predictions from each measured time to the next" in notes
    assert "autocorrelated" not in notes
    assert "sigma is probably" not in notes


def test_output_errors_on_the_same_data_are_worse(fitted):
    problem = fitted.problem
    plain = ce.fit(replace(problem, effects=(), parameters=problem.parameters[:3]))
    far = [max(abs(r.x[n] / TRUE[n] - 1.0) for n in TRUE) for r in (fitted, plain)]
    assert far[0] < far[1]
    assert any("autocorrelated" in note for note in plain.notes)


def test_an_ornstein_uhlenbeck_force_has_a_strength_and_a_time(fitted):
    problem = spring(fitted.problem.experiments, 1.0, COLOURED)
    *_, q, tau = problem.parameters
    q = replace(q, bounds=(1e-3, 1e3), scale="log")
    coloured = ce.fit(replace(problem, parameters=(*problem.parameters[:3], q, tau)))
    assert coloured.success
    # white noise at the derivative is one of no time: its strength is q tau / m
    strength = coloured.x["noise.q"] * coloured.x["noise.tau"] / coloured.x["m"]
    assert coloured.x["noise.tau"] < 0.05
    assert strength == pytest.approx(fitted.x["noise.q"], rel=0.1)


def test_its_names_are_those_of_the_library():
    assert {name for _, name in PROCESS_NOISE} == set(Effect.NOISE)


def with_effect(effect: ce.Effect, own: str) -> ce.Problem:
    """One more, besides the noise, with a coefficient of its own."""
    problem = spring([shaken(1)])
    own = ce.Parameter(f"{effect.name}.{own}", 0.1, (0.01, 1.0))
    more = {"effects": (*problem.effects, effect), "parameters": (*problem.parameters, own)}
    return replace(problem, **more)


IN_COSIMULATION = {"interface": "co_simulation", "solver": ce.Solver("fmu")}
TWICE = with_effect(ce.Effect("more", "der(v)", "diffusion"), "q")


@pytest.mark.parametrize(
    ("problem", "shooting", "said"),
    [
        (
            spring([shaken(1)], effect=COLOURED, **IN_COSIMULATION),
            None,
            "needs the states and their derivatives.*model.interface must",
        ),
        (
            spring([shaken(1)], solver=ce.Solver("cvode")),
            None,
            "must be dormand_prince or rk4, but is cvode",
        ),
        (replace(spring([shaken(1)]), cost=COSTS["huber"]()), None, 'needs cost.name = "sse"'),
        (
            with_outputs(spring([shaken(1)]), lambda o: replace(o, sigma=1.0)),
            None,
            "experiment 'e1' has an output without a known sigma",
        ),
        (
            with_effect(ce.Effect("late", "output y", "lag"), "tau"),
            None,
            "cannot be combined with effect 'late' at output y",
        ),
        (TWICE, None, "may occur only once at a site in each form"),
        (spring([shaken(1)]), {"segments": 4}, "shooting: cannot be used with process noise"),
    ],
)
def test_where_a_filter_cannot_be_is_one_sentence(problem, shooting, said):
    with pytest.raises(ProblemError, match=said):
        ce.fit(problem, shooting=shooting)


def test_a_simulation_refuses_the_same_noise_twice_too():
    with pytest.raises(ProblemError, match="may occur only once at a site"):
        ce.simulate(TWICE)


def test_a_config_names_it_like_any_effect(tmp_path, capsys):
    effect = "{name='noise', site='der(v)', form='diffusion', parameters={q={start=0.2}}}"
    given = [f"effects=[{effect}]", "experiment_defaults.sigma.y=0.002"]
    assert main(["fit", SPRING, "--out", str(tmp_path / "run"), *given]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "noise.q" in printed
    assert "m/s^2 s^0.5" in printed
    assert "process noise (noise): errors, curves and residuals" in printed
    assert (tmp_path / "run" / "report.html").exists()


def test_an_export_leaves_it_out_and_says_so(fitted, tmp_path):
    exported = ce.export(fitted, ssv=tmp_path / "found.ssv")
    assert any("effect 'noise' is process noise and is left out" in note for note in exported.notes)


def test_noise_that_vanishes_says_what_the_intervals_are_worth():
    quiet = [shaken(31, q=1e-6), shaken(32, q=1e-6)]
    result = ce.fit(spring(quiet, q=0.05))
    ended = result.x["noise.q"]
    assert ended < 0.05
    said = "noise.q ended at its lower bound" in " ".join(result.notes)
    assert said is (ended <= 1e-6 * 100.0)
