import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from cluster_est.closed_loop.candidates.array_forms import own_states_of
from cluster_est.problem.declared_effects import equation_text
from workers.effects.expression import parse
from workers.effects.forms import FORMS
from workers.effects.site import parse_site
from workers.messages import Effect

ARGUMENTS = ("t", "s", "v", "w")
WITH_STATES = [
    form
    for (kind, name), form in FORMS.items()
    if form.states and name in ("lag", "mode", "lagged", "heating", "hysteresis")
]


def test_a_state_of_its_own_has_another_letter_than_the_models_state():
    said = {
        state: equation_text(
            Effect("dahl", f"der({state})", "dahl", (state,)),
            FORMS["derivative", "dahl"],
            parse_site(f"der({state})", ""),
        )
        for state in ("v", "z")
    }
    assert said["v"] == "der(v) += -k * z, z' = (v - abs(v) * z) / x0"
    assert said["z"] == "der(z) += -k * dahl.z, dahl.z' = (z - abs(z) * dahl.z) / x0"


EVEN = np.linspace(0.0, 2.0, 401)
UNEVEN = np.sort(np.random.default_rng(3).uniform(0.0, 2.0, 401))


@pytest.mark.parametrize("times", [EVEN, UNEVEN], ids=["even", "uneven"])
@pytest.mark.parametrize("form", WITH_STATES, ids=lambda form: form.name)
def test_own_states_follow_their_equations(form, times):
    """Against SciPy, with signals that are linear between the times."""
    names = [*ARGUMENTS, *(z.name for z in form.states), *(c.name for c in form.coefficients)]
    symbols = {name: sp.Symbol(name, real=True) for name in names}
    signals = [times, *(np.sin(k * times) + 0.3 for k in (3.0, 2.0, 5.0))]
    coefficients = [0.5 + 0.2 * i for i in range(len(form.coefficients))]
    rates = [
        sp.lambdify([symbols[n] for n in names], parse(z.derivative, symbols, ""), "numpy")
        for z in form.states
    ]
    begin = [
        sp.lambdify(
            [symbols[n] for n in (*ARGUMENTS, *(c.name for c in form.coefficients))],
            parse(z.start, symbols, ""),
            "numpy",
        )(*(signal[0] for signal in signals), *coefficients)
        for z in form.states
    ]

    def rate(t, z):
        at = [np.interp(t, times, signal) for signal in signals]
        return [f(*at, *z, *coefficients) for f in rates]

    true = solve_ivp(
        rate, times[[0, -1]], begin, t_eval=times, rtol=1e-9, atol=1e-11, max_step=0.01
    )
    found = own_states_of(form, ARGUMENTS, symbols, "").follow(signals, coefficients)
    np.testing.assert_allclose(found, true.y, rtol=1e-3, atol=1e-3)
