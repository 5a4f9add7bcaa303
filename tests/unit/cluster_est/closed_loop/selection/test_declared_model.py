"""The declared model is fitted past local minima."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    started,
)

from cluster_est.closed_loop.selection.declared_model import THOROUGH, at_noise, fit_declared
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart
from cluster_est.errors import ProblemError

NOISE = 0.01


@pytest.fixture(scope="module")
def pendulum():
    return measured(missing_effect_problem("pendulum", signals=()), NOISE)


@pytest.mark.parametrize("starts", [{"G": 6.0}, {"G": 0.7}, {"J": 0.04}])
def test_a_pendulum_that_starts_at_a_wrong_frequency(pendulum, starts):
    with opened(started(pendulum, **starts)) as bench:
        start = FitStart(bench.problem, {})
        (stuck,) = bench.fit(LoopStage.DECLARED_MODEL, [start], THOROUGH)
        assert not at_noise(bench, stuck)
        found = fit_declared(bench, start)
        assert at_noise(bench, found)
    assert stuck.sse > 1000.0 * found.sse
    assert found.estimates == pytest.approx({"J": 0.1, "G": 2.0, "b": 0.04}, rel=0.01)


def test_values_of_each_experiment_grow_along(pendulum):
    """Starting angles of their own, which the shortened ones know under other names."""
    angle = replace(
        pendulum.parameters[0], name="angle0", variable="angle", per="experiment",
        start=0.3, lower=-2.0, upper=2.0,
    )  # fmt: skip
    runs = tuple(replace(e, values=()) for e in pendulum.experiments)
    model = replace(pendulum.model, parameters=(*pendulum.model.parameters, "angle"))
    problem = replace(
        started(pendulum, G=6.0), model=model, experiments=runs,
        parameters=(*started(pendulum, G=6.0).parameters, angle),
    )  # fmt: skip
    with opened(problem) as bench:
        found = fit_declared(bench, FitStart(bench.problem, {}))
    assert found.estimates["G"] == pytest.approx(2.0, rel=0.01)
    for e in range(2):
        assert found.estimates[f"angle0[e{e}]"] == pytest.approx(0.5, abs=0.01)


def test_a_fit_at_the_noise_asks_for_nothing_more(pendulum):
    with opened(pendulum) as bench:
        fit_declared(bench, FitStart(bench.problem, {}))
        assert bench.runner.evaluations < 40


def test_a_model_that_cannot_be_simulated_says_so(pendulum):
    mass, *others = pendulum.parameters
    broken = replace(mass, start=-1.0, lower=-2.0, upper=-0.5)
    problem = replace(pendulum, parameters=(broken, *others))
    with opened(problem) as bench, pytest.raises(ProblemError, match="cannot be simulated"):
        fit_declared(bench, FitStart(bench.problem, {}))
