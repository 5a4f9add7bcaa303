"""A model without states: a motion is given, and the current that it needs is measured."""

import numpy as np
import pytest
from support.problems.springs import ROOT

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

FMU = ROOT / "configs" / "league" / "models" / "ur5e.fmu"
NOISE = 0.01
ROLES = ("train", "train", "test")
TIMES = np.arange(300) * 0.02
LAWS = {
    "coulomb": (0.3, lambda speed: 0.3 * np.sign(speed)),
    "quadratic": (0.2, lambda speed: 0.2 * speed * np.abs(speed)),
}


def measured(law, interface="model_exchange") -> ce.Problem:
    """Three motions, each of three waves, and the current of a joint with this friction."""
    random = np.random.default_rng(3)
    runs = []
    for name, role in zip("abc", ROLES, strict=True):
        rates = np.array([0.7, 1.9, 3.1]) * random.uniform(0.8, 1.2, 3)
        waves = np.outer(TIMES, rates) + random.uniform(0.0, 6.0, 3)
        sizes = np.array([1.0, 0.5, 0.3])
        speed, turning = np.sin(waves) @ sizes, np.cos(waves) @ (sizes * rates)
        current = 0.2 * turning + 0.15 * speed + law(speed)
        current += NOISE * random.normal(size=len(TIMES))
        inputs = (ce.Input("qd", TIMES, speed), ce.Input("qdd", TIMES, turning))
        outputs = (ce.Output("i", TIMES, current, sigma=NOISE),)
        runs.append(ce.Experiment(name, 0.0, float(TIMES[-1]), inputs, outputs, role=role))
    parameters = tuple(ce.Parameter(name, 0.1, (0.0, 5.0)) for name in ("J", "Fv"))
    model = ce.read_model(FMU, interface=interface)
    return ce.Problem(model, parameters, tuple(runs))


@pytest.mark.parametrize("form", ["coulomb", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_a_term_that_its_balance_lacks_has_its_own_name(form):
    size, law = LAWS[form]
    result = ce.close_loop(measured(law))
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    assert (effect.site, effect.form, effect.variables) == ("output i", form, ("qd",))
    assert effect.coefficients[0].value == pytest.approx(size, rel=0.03)
    assert result.rms("test", "after") < 1.1


@pytest.mark.parametrize(
    "forms",
    [
        ("quadratic", "magnitude", "cubic", "drift"),
        pytest.param((), id="all forms", marks=pytest.mark.slow),
    ],
)
def test_in_co_simulation_the_outputs_say_on_which_inputs_they_depend(forms):
    """What grows with the square of a speed is a friction that grows with the speed, too."""
    problem = measured(LAWS["quadratic"][1], "co_simulation")
    result = ce.close_loop(problem, settings=ce.LoopSettings(forms=forms))
    assert result.verdict == Verdict.FOUND
    (effect,) = result.effects
    named = {(effect.site, effect.form), *((a.site, a.form) for a in effect.alternatives)}
    assert {("output i", "quadratic"), ("parameter Fv", "magnitude")} <= named
    assert result.rms("test", "after") < 1.1


def test_two_terms_are_found_together():
    def law(speed):
        return LAWS["coulomb"][1](speed) + LAWS["quadratic"][1](speed)

    few = ce.LoopSettings(forms=("coulomb", "quadratic", "cubic"), sites=("output i",))
    result = ce.close_loop(measured(law), settings=few)
    assert result.verdict == Verdict.FOUND
    assert {effect.form for effect in result.effects} == set(LAWS)
    for effect in result.effects:
        assert effect.coefficients[0].value == pytest.approx(LAWS[effect.form][0], rel=0.03)
    assert "The effects remove 100%" in result.message
    assert any(
        "are functions of the same variable, qd, at output i" in note for note in result.notes
    )


def test_a_power_law_has_its_exponent_at_a_reference_that_is_held():
    """Its strength is that at the reference: with both free, neither would be determined."""
    few = ce.LoopSettings(forms=("power", "coulomb"), sites=("output i",))
    problem = measured(lambda speed: 0.2 * np.sign(speed) * np.abs(speed) ** 1.6)
    (effect,) = ce.close_loop(problem, settings=few).effects
    known = {c.label.rpartition(".")[2]: c for c in effect.coefficients}
    assert known["n"].value == pytest.approx(1.6, rel=0.05)
    assert known["ref"].estimated_on == "known"


def test_nothing_is_found_where_nothing_is_missing():
    result = ce.close_loop(measured(lambda speed: 0.0 * speed))
    assert result.verdict == Verdict.NONE
