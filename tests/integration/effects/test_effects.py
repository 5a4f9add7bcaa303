"""Effects around an FMU that knows nothing of them, against SciPy on equations that have them."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.problems.driven_spring import driven, model_of
from support.simulated import Worker, answer, simulated
from support.thinning import thinned
from support.truth.form_terms import OWN_TESTS, TRUTHS, forms_with_a_truth
from support.truth.springs_with_effects import SITES, C, K, M, plain, pushed, solve

from cluster_est import Parameter, Problem, Solver, add_effect, fit
from workers.effects.forms import FORMS
from workers.errors import EffectError
from workers.messages import Effect

SOLVERS = {
    "exact": Solver("dormand_prince", rtol=1e-10),
    "rk4": Solver("rk4", step=0.005),
    "co_simulation": Solver("fmu", step=0.002),
}
EXACT = model_of(SOLVERS["exact"])


@pytest.fixture(scope="module")
def shown():
    """What y is with effects, by one worker of each solver."""
    workers = cache(lambda solver: Worker(model_of(SOLVERS[solver]), driven()))

    def of(solver, effects, *coefficients):
        points = [(M, K, C, *each) for each in coefficients]
        return [y[:, 0] for y in workers(solver).outputs(*points, effects=effects)]

    return of


def test_every_form_has_a_truth():
    listed = forms_with_a_truth()
    assert set(FORMS) - listed == set(), "add its truth to a table of support/truth/form_terms.py"
    assert listed - set(FORMS) == set(), "it is no form any more"
    here = [file.read_text(encoding="utf-8") for file in Path(__file__).parent.glob("test_*.py")]
    named = {test for test in OWN_TESTS.values() if f"def {test}(" in "".join(here)}
    assert named == set(OWN_TESTS.values()), "write this test of the form"


@pytest.mark.parametrize(
    ("truth", "solver"),
    [
        pytest.param(
            truth,
            solver,
            id=f"{truth.kind}-{truth.form}-{solver}",
            marks=pytest.mark.slow if FORMS[truth.kind, truth.form].finer_than else (),
        )
        for truth in TRUTHS
        for solver in ("exact", "co_simulation")
        if solver == "exact" or truth.in_steps
    ],
)
def test_a_form_does_what_its_equation_says(shown, truth, solver):
    effect = Effect("e", SITES[truth.kind], truth.form, truth.variables)
    (found,) = shown(solver, [effect], truth.coefficients)
    np.testing.assert_allclose(
        found,
        truth.output,
        atol=truth.bar if solver == "exact" else truth.in_steps,
        err_msg="the form's equation and its truth in support/truth/form_terms.py differ",
    )


SIZES = {
    "arrhenius": {"at": 0.1, "zero": 30.0},
    "exponential": {"k": -0.4, "width": 0.5},
    "inverse": {"k": 0.1},
    "inverse_square": {"k": 0.1},
}
"""Of forms that leave the range of numbers, or divide by nothing, with the usual ones."""


@pytest.mark.parametrize(
    ("kind", "name", "solver"),
    thinned(
        [
            pytest.param(kind, name, solver, id=f"{kind}-{name}-{solver}")
            for kind, name in FORMS
            for solver in SOLVERS
            if kind not in ("derivative", "pair") or solver != "co_simulation"  # closed sites
        ],
        lambda kind, name, solver: (kind, name),
        lambda kind, name, solver: (kind, solver),
    ),
)
def test_every_form_does_nothing_when_neutral_and_something_otherwise(shown, kind, name, solver):
    form = FORMS[kind, name]
    variables = (("v", "x") if kind in ("derivative", "pair") else ("F", "F"))[: form.variables]
    known = {"low": -0.5, "limit": 0.03} | SIZES.get(name, {})
    sizes = {
        c.name: known.get(c.name, 0.4 if c.neutral == 0.0 else 0.03) for c in form.coefficients
    }
    neutral = [
        known.get(c.name, 0.03) if c.neutral is None else c.neutral for c in form.coefficients
    ]
    effect = Effect("e", SITES[kind], name, variables)
    (without,) = shown(solver, [], ())
    found = shown(solver, [effect], neutral, sizes.values())
    assert found[0].tobytes() == without.tobytes(), (
        "with each coefficient at its `neutral`, the equation must add 0 to a derivative, and be s "
        "elsewhere"
    )
    assert np.abs(found[1] - without).max() > 1e-6, (
        f"it does nothing with {sizes}: look at the equation, or give this test others in `known`"
    )


def test_effects_combine(shown):
    def slope(t, x, force):
        v, dv = plain(t, x, 1.2 * (force + 0.3))
        return [v, dv - 0.7 * x[1] * abs(x[1])]

    effects = [
        Effect("a", "input F", "bias"),
        Effect("b", "input F", "gain"),
        Effect("c", "der(v)", "quadratic"),
        Effect("d", "output y", "gain"),
    ]
    (found,) = shown("exact", effects, (0.3, 0.2, 0.7, -0.1))
    np.testing.assert_allclose(found, 0.9 * solve(slope)[:, 0], atol=1e-8)


def test_effects_of_different_tasks_keep_their_own_coefficients(shown):
    """One worker, asked for an effect alone and then behind another that is neutral."""
    bias, drag = Effect("a", "input F", "bias"), Effect("b", "der(v)", "quadratic")
    (alone,) = shown("exact", [drag], (0.7,))
    for effects, coefficients in (((bias, drag), (0.0, 0.7)), ((drag, bias), (0.7, 0.0))):
        (found,) = shown("exact", effects, coefficients)
        assert found.tobytes() == alone.tobytes()


def test_an_equation_of_the_users_own(shown):
    equation = "-a*x^3 + where(x > 0.05, b * F, 0)"
    effect = Effect("own", "der(v)", equation=equation, coefficients=(("a", 0.0), ("b", 0.0)))
    truth = solve(pushed(lambda t, x, f: -40.0 * x[0] ** 3 + (0.1 * f if x[0] > 0.05 else 0.0)))
    (found,) = shown("exact", [effect], (40.0, 0.1))
    np.testing.assert_allclose(found, truth[:, 0], atol=1e-5)


PARAMETERS = (
    Parameter("m", 1.0, (0.1, 10.0)),
    Parameter("k", 25.0, (1.0, 100.0)),
    Parameter("c", 0.8, (0.0, 10.0)),
)


def test_a_declared_effect_is_fitted_together_with_the_parameters():
    measured = solve(pushed(lambda t, x, f: -0.5 * np.tanh(x[1] / 0.01)))[:, 0]
    coefficients = (
        Parameter("friction.k", 0.0, (0.0, np.inf)),
        Parameter("friction.width", 0.01, fixed=True),
    )
    problem = Problem(EXACT, PARAMETERS, (driven(measured),))
    declared = replace(
        problem,
        parameters=(*PARAMETERS, *coefficients),
        effects=(Effect("friction", "der(v)", "coulomb"),),
    )
    result = fit(declared)
    assert result.x == pytest.approx({"m": M, "k": K, "c": C, "friction.k": 0.5}, rel=1e-5)
    assert fit(problem).cost > 1e3 * result.cost


@pytest.mark.parametrize(
    ("effect", "said"),
    [
        (("der(q)", "coulomb"), r"has no site der\(q\).*'x', 'v'"),
        (("input f", "gain"), "has no site input f.*did you mean 'F'"),
        (("nowhere", "gain"), "must be.*'nowhere'"),
        (("der(v)", "coulom"), "'coulom'.*did you mean 'coulomb'"),
        (("der(v)", "product", ("x",)), "product needs 2 variables, but was given 1"),
        (("der(v)", "linear", ("z",)), "variables.*'z'"),
        (("der(v)", "linear", ("x - z",)), "variables.*unknown variable 'z'"),
        (("der(v)", "linear", ("2 * x",)), "a name or the difference of two"),
        (("pair v", "gap"), "two different states.*'pair v'"),
        (("pair v,v", "gap"), "two different states.*'pair v,v'"),
        (("pair v,q", "gap"), r"has no site der\(q\).*'x', 'v'"),
        (("pair x,v", "jiont"), "'jiont'.*did you mean 'joint'"),
        (("pair x,v", "", (), "x"), r"reaction: is missing.*to der\(v\)"),
        (("der(v)", "", (), "x", (), "x"), r"only with an equation.*site is 'der\(v\)'"),
        (("pair x,v", "gap", (), "", (), "x"), r"only with an equation.*a form \('gap'\)"),
        (("der(v)", "", (), "2 *"), r"must be an equation.*'2 \*'"),
        (("der(v)", "", (), "2 * q"), "unknown variable 'q'"),
        (("der(v)", "", (), "sinn(x)"), "unknown function 'sinn'.*'sin'"),
        (("der(v)", "", (), "__import__('os').remove('x')"), "must consist of"),
        (("der(v)", "", (), "x.__class__"), "unknown variable 'x.__class__'"),
        (("der(v)", "", (), "[x for x in (1,)]"), "must consist of"),
        (("der(v)", "", (), "sin(x, x, x)"), r"sin\(.*cannot be used in this way"),
    ],
)
def test_an_effect_that_cannot_be_is_refused_with_a_sentence(effect, said):
    with pytest.raises(EffectError, match=said):
        Worker(EXACT, driven()).outputs((M, K, C), effects=[Effect("e", *effect)])


@pytest.mark.parametrize(("site", "form"), [("der(v)", "coulomb"), ("pair x,v", "gap")])
def test_co_simulation_closes_the_sites_at_derivatives(site, form):
    problem = Problem(model_of(SOLVERS["co_simulation"]), PARAMETERS, (driven(),))
    with pytest.raises(EffectError, match=r"(der|pair).* cannot be used.*gives no access"):
        add_effect(problem, site, form)


@pytest.mark.parametrize("solver", ["exact", "co_simulation"])
def test_a_sensor_at_a_variable_that_is_no_output(shown, solver):
    """The state x is what the output y shows."""
    effect = Effect("sensor", "output x", "gain")
    found = simulated(model_of(SOLVERS[solver]), driven(shown="x"), (M, K, C, 0.25), [effect])[:, 0]
    (plain_outputs,) = shown(solver, [], ())
    np.testing.assert_allclose(found, 1.25 * plain_outputs, rtol=1e-12)


def test_an_effect_that_divides_by_zero_ends_its_simulation_with_a_reason():
    effect = Effect("e", "der(v)", "coulomb")
    outcome = answer(EXACT, driven(), (M, K, C, 0.5, 0.0), "residuals", (effect,))
    assert not outcome.ok
    assert outcome.message
