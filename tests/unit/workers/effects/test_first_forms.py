"""Names of forms and coefficients that stand in users' configs keep their meaning."""

import pytest

from workers.effects.forms import FORMS

FIRST = {
    "derivative": """constant: k; coulomb: k width; cubic: k; dahl: k x0; drift: k; gap: k at;
        hinge: k at; hinge_below: k at; lagged: k tau; linear: k; product: k; quadratic: k;
        signed_root: k; sine: a b f; square: k; square_root: k; stribeck: k peak vs width;
        table: k1 k2 k3 k4 k5 k6 k7 low high; viscous: k""",
    "input": """asymmetry: k; backlash: k; bias: k; cubic: k; dead_zone: k; delay: tau; drift: k;
        gain: k; lag: tau; product: k; saturation: limit; square: k""",
    "output": """absolute: k; bias: k; clip_above: limit; clip_below: limit; delay: tau; drift: k;
        feed_through: k; gain: k; hum: a b f; hysteresis: k x0; lag: tau;
        lagged_feed_through: k tau; saturation: limit; square: k""",
    "pair": """coulomb: k back width; cubic: k back; gap: k back at; joint: k back at;
        leak: k back; linear: k back; overflow: k back at; quadratic: k back""",
    "parameter": "drift: k at; heating: k at tau; linear: k at; magnitude: k at; square: k at",
}
"""Form and coefficients at each site, as the first version had them."""


@pytest.mark.parametrize(
    ("site", "line"), [(site, line) for site, text in FIRST.items() for line in text.split(";")]
)
def test_a_form_of_the_first_version_is_still_there(site, line):
    name, _, coefficients = line.partition(":")
    form = FORMS[site, name.strip()]
    assert [c.name for c in form.coefficients] == coefficients.split()
