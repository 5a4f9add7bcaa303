"""Curves with more values say the same as the ones that they come from."""

from dataclasses import dataclass

import numpy as np
import pytest

from cluster_est.closed_loop.candidates.finer_curves import finer_form, in_finer_form, refined
from cluster_est.closed_loop.candidates.make import EffectCandidate
from workers.effects.forms import FORMS
from workers.effects.site import parse_site
from workers.messages import Effect


@dataclass(frozen=True)
class Course:
    """A trajectory of one signal."""

    values: np.ndarray

    def has(self, name):
        return True

    def signal(self, name):
        return self.values


def candidate(kind, name, site, variables, grid):
    form = FORMS[kind, name]
    free = (-np.inf,) * len(form.coefficients), (np.inf,) * len(form.coefficients)
    effect = Effect("e", site, name, variables)
    return EffectCandidate(effect, form, parse_site(site, "site"), False, grid, *free)


def curve(kind, name, site, variables, low=0.0, high=6.0):
    ends = {"low": low, "high": high, "back": 2.0}
    form = FORMS[kind, name]
    return candidate(
        kind, name, site, variables, (tuple(ends.get(c.name, 0.0) for c in form.coefficients),)
    )


@pytest.mark.parametrize(
    ("kind", "name", "site", "variables"),
    [
        ("derivative", "table", "der(v)", ("x",)),
        ("pair", "table", "pair v,w", ("v",)),
        ("input", "characteristic", "input u", ()),
        ("output", "table", "output y", ("x",)),
        ("parameter", "table", "parameter k", ("x",)),
    ],
)
def test_a_finer_curve_says_the_same_where_the_coarse_one_was(kind, name, site, variables):
    coarse = curve(kind, name, site, variables)
    heights = dict(zip(coarse.strengths, np.sin(np.arange(len(coarse.strengths))), strict=True))
    values = [heights.get(c.name, v) for c, v in zip(coarse.form.coefficients, coarse.grid[0],
                                                     strict=True)]  # fmt: skip
    form = finer_form(coarse)
    goes = Course(np.linspace(1.0, 5.0, 100))
    finer, found = refined(coarse, values, [goes], form)
    known = dict(zip([c.name for c in form.coefficients], found, strict=True))
    assert form.values == 13
    if len(coarse.strengths) == 7:  # all are free: it goes to where its argument does
        assert (known["low"], known["high"]) == pytest.approx((1.0, 5.0), abs=0.03)
    else:
        assert (known["low"], known["high"]) == (0.0, 6.0)
    at = np.linspace(known["low"], known["high"], 13)
    expected = np.interp(at, np.arange(7), [heights.get(f"k{i}", 0.0) for i in range(1, 8)])
    np.testing.assert_allclose([known.get(f"k{i}", 0.0) for i in range(1, 14)], expected)
    for parameter in finer.parameters(found):
        assert parameter.lower <= parameter.start <= parameter.upper
    assert known.get("back", 2.0) == 2.0


def test_there_are_three_resolutions_and_none_finer():
    coarse = curve("derivative", "table", "der(v)", ("x",))
    sizes = [coarse.form.values]
    while (form := finer_form(coarse)) is not None:
        coarse = in_finer_form(coarse, form)
        sizes.append(coarse.form.values)
    assert sizes == [7, 13, 25]
    assert coarse.effect.form == "table_25"
