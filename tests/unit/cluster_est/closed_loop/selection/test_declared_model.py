"""The declared model is fitted past local minima, before anything counts as missing."""

from dataclasses import replace

import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, started

from cluster_est import LoopSettings, close_loop, detect, fit
from cluster_est.errors import ProblemError

NOISE = 0.01
SETTINGS = LoopSettings(forms=("constant",), sites=("der(speed)",), draws=100)


@pytest.fixture(scope="module")
def pendulum():
    return measured(missing_effect_problem("pendulum", signals=()), NOISE)


@pytest.mark.parametrize(
    "starts", [{"G": 6.0}, {"G": 0.7}, pytest.param({"J": 0.04}, marks=pytest.mark.slow)]
)
def test_a_pendulum_that_starts_at_a_wrong_frequency(pendulum, starts):
    problem = started(pendulum, **starts)
    stuck = fit(problem)
    assert stuck.errors[0].rmse_after > 10.0 * NOISE
    seen = detect(problem, settings=SETTINGS)
    assert seen.rms["y"] == pytest.approx(NOISE, rel=0.1)
    assert not seen.missing


def test_values_of_each_experiment_grow_along(pendulum):
    """Starting angles of their own, which the shortened ones know under other names."""
    angle = replace(
        pendulum.parameters[0], name="angle0", variable="angle", per="experiment",
        start=0.3, lower=-2.0, upper=2.0,
    )  # fmt: skip
    runs = tuple(replace(e, values=()) for e in pendulum.experiments)
    model = replace(pendulum.model, parameters=(*pendulum.model.parameters, "angle"))
    parameters = (*started(pendulum, G=6.0).parameters, angle)
    problem = replace(pendulum, model=model, experiments=runs, parameters=parameters)
    found = close_loop(problem, settings=SETTINGS)
    assert found.verdict == "none"
    assert found.x["G"] == pytest.approx(2.0, rel=0.01)
    for e in range(2):
        assert found.x[f"angle0[e{e}]"] == pytest.approx(0.5, abs=0.01)


def test_a_model_that_cannot_be_simulated_says_so(pendulum):
    mass, *others = pendulum.parameters
    broken = replace(mass, start=-1.0, lower=-2.0, upper=-0.5)
    with pytest.raises(ProblemError, match="cannot be simulated"):
        detect(replace(pendulum, parameters=(broken, *others)), settings=SETTINGS)
