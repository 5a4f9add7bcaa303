from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import made_candidate, made_fitter, made_problem
from support.named_effects import estimate

from cluster_est.closed_loop.account import like_ramps
from cluster_est.problem.display import plain_number
from cluster_est.results.facts import fitted_to_held_out
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.messages import Input

STEPS = np.repeat([0.0, 1.0, -1.0, 2.0, 0.0], 10)


@pytest.mark.parametrize(
    ("form", "how", "said"),
    [("delay", "linear", True), ("delay", "hold", False), ("dead_zone", "linear", False)],
)
def test_a_delay_at_an_input_that_jumps_may_come_from_its_interpolation(form, how, said):
    problem = made_problem(50)
    (run,) = problem.experiments
    given = Input("F", np.linspace(0.0, 1.0, 50), STEPS, how)
    problem = replace(problem, experiments=(replace(run, inputs=(given,)),))
    one = made_candidate("late")
    effect = replace(one.effect, site="input F", form=form, variables=())
    site = EffectSite("input", "F")
    one = replace(one, effect=effect, form=FORMS["input", form], site=site)
    notes = like_ramps(made_fitter(problem), [one])
    assert len(notes) == said
    assert all(f"{form} at input F may come in part from" in note for note in notes)


def own_value(name: str, scope: str):
    one = estimate(name, 1.0)
    return replace(one, label=f"{name}[{scope}]", parameter=name, scope=scope, estimated_on="test")


def test_values_of_held_out_experiments_are_named_by_parameter_and_experiment():
    values = [own_value(n, e) for n in ("h1_start", "h2_start") for e in ("5 a", "6 b")]
    (said,) = fitted_to_held_out(values)
    assert said.startswith(
        "h1_start and h2_start (values for '5 a' and '6 b') were fitted to the held-out data, "
        "because no training experiment uses them"
    )


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1830.4, 3, "1830"), (12345.6, 4, "12346"), (0.00012, 4, "0.00012"), (2.5e9, 4, "2.5e+09")],
)
def test_large_numbers_have_no_exponent(value, digits, text):
    assert plain_number(value, digits) == text
