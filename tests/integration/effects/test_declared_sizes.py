"""A declared time constant or speed is found from a start far off; the truth is SciPy's."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from support.truth.systems_with_missing_effects import missing_effect_problem, started

import cluster_est as ce
from workers.messages import Experiment, FloatArray

MASS, SPRING, DAMPER = 1.2, 30.0, 0.6
LAG = 0.15
DRY, PEAK, SPEED, WIDTH = 0.2, 0.3, 0.1, 0.005


def simulated(run: Experiment, *, lag: bool) -> FloatArray:
    """The position of a driven mass, as a slow sensor shows it or with a dry friction."""
    (force,), (position,) = run.inputs, run.outputs

    def rates(t: float, y: FloatArray) -> list[float]:
        x, v, shown = y
        push = np.interp(t, force.times, force.values)
        dry = (DRY + PEAK * np.exp(-((v / SPEED) ** 2))) * np.tanh(v / WIDTH)
        rate = (push - SPRING * x - DAMPER * v) / MASS - (0.0 if lag else dry)
        return [v, rate, (x - shown) / LAG]

    start, how = dict(run.values)["x"], {"rtol": 1e-9, "atol": 1e-11, "max_step": 0.01}
    found = solve_ivp(rates, (0.0, run.stop), [start, 0.0, start], t_eval=position.times, **how)
    return np.asarray(found.y[2 if lag else 0])


@cache
def shown(*, lag: bool = True) -> ce.Problem:
    """What was measured, with noise of a thousandth of it, and starts that are off."""
    generator = np.random.default_rng(1)
    problem = missing_effect_problem("mass_spring_damper", signals=())
    runs = []
    for run in problem.experiments:
        (output,) = run.outputs
        values = simulated(run, lag=lag)
        sigma = 1e-3 * float(values.std())
        values = values + sigma * generator.standard_normal(len(values))
        runs.append(replace(run, outputs=(replace(output, values=values, sigma=sigma),)))
    return started(replace(problem, experiments=tuple(runs)), m=1.1, k=33.0, c=0.7)


def tried(*values: float) -> list[object]:
    """The last by default."""
    *others, last = values
    return [*(pytest.param(value, marks=pytest.mark.slow) for value in others), last]


@pytest.mark.parametrize("factor", tried(0.2, 5.0, 10.0, 0.1))
@pytest.mark.slow
def test_a_lag_is_found_from_a_start_far_off(factor: float) -> None:
    fit = ce.fit(ce.add_effect(shown(), "output y", "lag", start={"tau": factor * LAG}))
    assert fit.x["lag.tau"] == pytest.approx(LAG, rel=0.02)
    assert fit.failures == 0
    assert fit.rmse("train") == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize("factor", tried(5.0, 10.0))
def test_a_speed_is_found_without_a_trial_at_nothing(factor: float) -> None:
    # with a linear scale and a bound of 0 two to ten simulations fail at vs = 0
    starts = {"k": 0.8 * DRY, "peak": 0.8 * PEAK, "width": WIDTH, "vs": factor * SPEED}
    grown = ce.add_effect(shown(lag=False), "der(v)", "stribeck", start=starts)
    *others, width = grown.parameters
    assert width.name == "stribeck.width"
    fit = ce.fit(replace(grown, parameters=(*others, replace(width, fixed=True))))
    assert fit.failures == 0
    assert fit.x["stribeck.vs"] == pytest.approx(SPEED, rel=0.05)
    assert fit.rmse("train") == pytest.approx(1.0, rel=0.1)


def test_a_lag_that_is_added_starts_from_the_sampling() -> None:
    grown = ce.add_effect(shown(), "output y", "lag")
    tau = grown.parameters[-1]
    assert (tau.name, tau.scale) == ("lag.tau", "log")
    assert 0.0 < tau.lower < tau.start
    assert ce.fit(grown).x["lag.tau"] == pytest.approx(LAG, rel=0.02)
