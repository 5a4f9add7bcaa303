"""In co-simulation, parameters and inputs that follow what the FMU shows, against SciPy."""

from dataclasses import replace

import numpy as np
import pytest
from support.problems.driven_spring import driven, model_of
from support.simulated import simulated
from support.truth.springs_with_effects import TIMES, C, K, M, plain, pushed, solve

from cluster_est import Solver
from workers.effects.definition import define
from workers.errors import EffectError
from workers.fmu.description import describe_model
from workers.messages import Effect, Input

FINE = model_of(Solver("fmu", step=0.0005))


@pytest.mark.parametrize(
    ("effect", "values", "added"),
    [
        (
            Effect("e", "parameter c", "linear", ("y",)),
            (3.0, 0.02),
            lambda t, x, f: -C / M * 3.0 * (x[0] - 0.02) * x[1],
        ),
        (
            Effect("e", "parameter k", "square", ("v",)),
            (0.9, 0.1),
            lambda t, x, f: -K / M * 0.9 * (x[1] ** 2 - 0.1) * x[0],
        ),
        (
            Effect("e", "input F", equation="s + k * y * v", coefficients=(("k", 0.0),)),
            (5.0,),
            lambda t, x, f: 5.0 * x[0] * x[1] / M,
        ),
    ],
)
def test_it_follows_what_the_fmu_computes(effect, values, added):
    """What is read is held for a step: the error is one of first order."""
    truth = solve(pushed(added))[:, 0]
    without = solve(plain)[:, 0]
    errors = []
    for step in (0.001, 0.0005):
        model = model_of(Solver("fmu", step=step))
        found = simulated(model, driven(), (M, K, C, *values), [effect])[:, 0]
        errors.append(np.abs(found - truth).max())
    assert errors[1] < 0.02 * np.abs(truth - without).max()
    assert errors[1] < 0.7 * errors[0]


def test_a_lag_of_an_output_begins_where_the_output_does():
    def slope(t, x, f):
        v, dv = plain(t, x, f)
        return [v, dv - C / M * 4.0 * (x[2] - 0.02) * v, (x[0] - x[2]) / 0.2]

    truth = solve(slope, (0.1, 0.0, 0.1))[:, 0]
    effect = Effect("e", "parameter c", "lagged", ("y",))
    found = simulated(FINE, driven(), (M, K, C, 4.0, 0.02, 0.2), [effect])[:, 0]
    np.testing.assert_allclose(found, truth, atol=2e-5)


def test_neutral_changes_no_bit():
    effect = Effect("e", "parameter c", "linear", ("y",))
    with_it = simulated(FINE, driven(), (M, K, C, 0.0, 0.02), [effect])
    assert with_it.tobytes() == simulated(FINE, driven(), (M, K, C), []).tobytes()


def test_a_measured_signal_of_that_name_is_what_it_was():
    effect = Effect("e", "parameter c", "linear", ("y",))
    still = Input("y", TIMES, np.full(len(TIMES), 0.5))
    measured = replace(driven(), signals=(still,))
    found = simulated(FINE, measured, (M, K, C, 0.1, 0.02), [effect])[:, 0]
    damped = simulated(FINE, driven(), (M, K, C * 1.048), [])[:, 0]
    np.testing.assert_allclose(found, damped, atol=1e-9)


def test_in_model_exchange_states_and_inputs_are_known_alone():
    model = model_of(Solver("dormand_prince"))
    with pytest.raises(EffectError, match="unknown variable 'y'"):
        define(
            Effect("e", "parameter c", "linear", ("y",)), describe_model(model), "model_exchange"
        )
