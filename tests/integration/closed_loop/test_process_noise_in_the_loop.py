"""The closed loop on springs under a random force: it names a friction, and nothing but the noise.

The truth is integrated here: an exact Ornstein-Uhlenbeck process, and Runge-Kutta steps.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.springs import ROOT
from support.truth.kalman_filter import runge_kutta

import cluster_est as ce
from cluster_est.errors import BudgetError, ProblemError

TRUE = {"m": 1.2, "k": 30.0, "c": 0.6}
DRY, PUSH, LASTING = 1.0, 0.5, 0.4
STEP, FINE, SIGMA = 0.02, 10, 0.01
SETTINGS = ce.LoopSettings(
    sites=("der(v)",), forms=("coulomb", "quadratic", "constant"), pairs=False
)


def record(seed: int, dry: float, role: str, samples: int = 300) -> ce.Experiment:
    """A spring with dry friction under a held force and an Ornstein-Uhlenbeck process."""
    generator = np.random.default_rng(seed)
    times, step = STEP * np.arange(samples), STEP / FINE
    force = 3.0 * np.sin((3.0 + 0.5 * seed) * times) + 2.0 * np.sign(np.sin(1.9 * times + seed))
    kept = np.exp(-step / LASTING)
    push = PUSH * generator.normal()
    state, places = np.array([0.1, 0.0]), []
    for known in force:
        places.append(state[0])
        for _ in range(FINE):

            def rate(x: np.ndarray, given: float = known + push) -> np.ndarray:
                resisting = TRUE["k"] * x[0] + TRUE["c"] * x[1] + dry * np.tanh(x[1] / 0.01)
                return np.array([x[1], (given - resisting) / TRUE["m"]])

            state = runge_kutta(rate, state, step, 1)
            push = kept * push + PUSH * np.sqrt(1.0 - kept * kept) * generator.normal()
    seen = np.array(places) + SIGMA * generator.normal(size=samples)
    driven = ce.Input("F", times, force, "hold")
    output = ce.Output("y", times, seen, sigma=SIGMA)
    return ce.Experiment(f"e{seed}", 0.0, times[-1], (driven,), (output,), {"x": 0.1}, role=role)


def problem(dry: float) -> ce.Problem:
    roles = ("train", "train", "train", "test")
    parameters = (
        ce.Parameter("m", 1.0, (0.1, 10.0)),
        ce.Parameter("k", 25.0, (1.0, 200.0)),
        ce.Parameter("c", 0.4, (0.0, 10.0)),
        ce.Parameter("wind.q", 1.0, (0.01, 100.0), "log"),
        ce.Parameter("wind.tau", 0.2, (0.01, 10.0), "log"),
    )
    return ce.Problem(
        ce.read_model(ROOT / "configs" / "models" / "mass_spring_damper.fmu"),
        parameters,
        tuple(record(seed, dry, role) for seed, role in enumerate(roles)),
        effects=(ce.Effect("wind", "input F", "coloured_noise"),),
    )


@pytest.fixture(scope="module")
def rubbing() -> ce.LoopResult:
    return ce.close_loop(problem(DRY), settings=SETTINGS)


def test_a_missing_coulomb_friction_is_named(rubbing):
    assert rubbing.verdict == "found"
    (effect,) = rubbing.effects
    assert (effect.form, effect.site) == ("coulomb", "der(v)")
    strength = next(c for c in effect.coefficients if c.label.endswith(".k"))
    assert strength.value * rubbing.x["m"] == pytest.approx(DRY, rel=0.25)


def test_the_friction_takes_the_place_of_noise(rubbing):
    (change,) = rubbing.process_noise
    assert change.after == pytest.approx(PUSH, rel=0.3)
    assert change.before > 1.2 * change.after
    assert 0.0 < change.variance_left < 0.7
    assert "Process noise wind: standard deviation" in rubbing.message
    assert rubbing.facts()["process_noise"][0]["after"] == change.after


def test_the_parameters_come_back(rubbing):
    before, after = rubbing.before.x["c"], rubbing.x["c"]
    assert abs(after - TRUE["c"]) < abs(before - TRUE["c"])
    assert rubbing.after.cost < rubbing.before.cost


def test_errors_are_over_what_the_noise_that_is_left_explains(rubbing):
    assert rubbing.errors_over == "predicted spread"
    for role in ("train", "test"):
        assert rubbing.rms(role, "after") == pytest.approx(1.0, abs=0.15)
        assert rubbing.rms(role, "before") > rubbing.rms(role, "after")
    assert any("simulations from start to end without process noise" in n for n in rubbing.notes)
    assert rubbing.competing == ()


def test_nothing_but_the_noise_is_none():
    """The budget is one for all passes of the search."""
    found = ce.close_loop(problem(0.0), settings=SETTINGS)
    scarce = ce.Resources(budget=ce.Budget(evaluations=found.evaluations - 20))
    with pytest.raises(BudgetError, match="was used up"):
        ce.close_loop(problem(0.0), scarce, SETTINGS)
    assert found.verdict == "none"
    assert found.effects == found.process_noise == ()
    assert "Process noise wind: standard deviation" in found.message
    assert found.after is found.before


def test_what_does_not_work_with_it_is_one_sentence():
    made = problem(0.0)
    with pytest.raises(ProblemError, match="detect and locate: cannot be used with process noise"):
        ce.detect(made)
    with pytest.raises(ProblemError, match="detect and locate: cannot be used with process noise"):
        ce.locate(made)
    output = SETTINGS.changed(sites=("output y",))
    with pytest.raises(ProblemError, match="'output y' cannot be used with process noise"):
        ce.close_loop(made, settings=output)
    *others, strength, lasting = made.parameters
    each = (*others, replace(strength, per="experiment"), lasting)
    with pytest.raises(ProblemError, match=r'close-loop: parameters\."wind\.q"\.per: is'):
        ce.close_loop(replace(made, parameters=each))
