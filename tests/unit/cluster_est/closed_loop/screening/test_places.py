from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.screening.places import PlaceThresholds
from cluster_est.closed_loop.screening.screen import leading_places, rank, rank_curves

LEADING = 12
FEW = PlaceThresholds(most_candidates=1, leading=LEADING)


class Drive:
    """Two masses on a shaft, with the directions of all candidates, and a way to look at few."""

    def __init__(self, bench):
        self._bench = bench
        self._fitted = unfitted(bench)
        self.whole = rank(bench.fitter, bench.settings, self._fitted)
        self.size = bench.fitter.size

    def planted(self, form, site, *variables):
        """The direction of a candidate in the middle of its grid, of length 1."""
        own = [
            i
            for i, trial in enumerate(self.whole.trials)
            if key(trial.candidate) == (form, site, *variables)
        ]
        direction = self.whole.columns[own[len(own) // 2]][:, 0]
        return direction / np.linalg.norm(direction)

    def ranked(self, residuals):
        """Few candidates against these residuals."""
        bench, fitted = self._bench, replace(self._fitted, residuals=residuals)
        return rank(bench.fitter, bench.settings, fitted, FEW)


def key(candidate):
    return (candidate.form.name, str(candidate.site), *candidate.effect.variables)


def keys(ranking):
    return {key(trial.candidate) for trial in ranking.trials}


@pytest.fixture(scope="module")
def drive():
    with ExitStack() as stack:
        yield Drive(stack.enter_context(opened(missing_effect_problem("two_mass_drive"))))


@pytest.mark.parametrize(
    "planted",
    [
        pytest.param(("coulomb", "der(w_load)", "w_load"), marks=pytest.mark.slow),
        ("drift", "der(w_load)"),
        ("square", "der(w_motor)", "w_load"),
        ("gap", "pair w_motor,w_load", "twist"),
        ("linear", "parameter k_shaft", "w_load"),
        ("feed_through", "output load_speed", "torque"),
    ],
    ids=" ".join,
)
def test_what_is_missing_is_among_the_few_and_leads(drive, planted):
    """Others may explain as much: what acts on a load acts on its damping too."""
    noise = np.random.default_rng(1).standard_normal(drive.size)
    residuals = drive.planted(*planted) + 0.1 * noise / np.linalg.norm(noise)
    found = drive.ranked(residuals)
    assert len(keys(found)) < 0.5 * len(keys(drive.whole))
    own = [key(trial.candidate) == planted for trial in found.trials]
    best = float(found.plain.statistics[own].max())
    assert best > 0.95 * float(found.plain.statistics.max())


@pytest.fixture(scope="module")
def few(drive):
    return drive.ranked(np.random.default_rng(8).standard_normal(drive.size))


def test_the_price_of_the_few_is_that_of_all_that_were_looked_at(drive, few):
    assert few.count == pytest.approx(drive.whole.count, rel=0.3)


def test_functions_are_only_looked_at_where_they_lead(drive, few):
    """What depends on time or on the signal itself is looked at everywhere but at states."""
    places = {(site, *v) for _, site, *v in keys(few) if len(v) == 1}
    assert 0 < len(places) <= LEADING
    everywhere = {k for k in keys(drive.whole) if len(k) == 2 and not k[1].startswith("der")}
    assert {k for k in keys(few) if len(k) == 2 and not k[1].startswith("der")} == everywhere


def test_scales_do_not_matter(drive, few):
    residuals = 1e6 * np.random.default_rng(8).standard_normal(drive.size)
    assert keys(drive.ranked(residuals)) == keys(few)


@pytest.fixture(scope="module")
def ranked():
    with opened(missing_effect_problem("mass_spring_damper")) as bench:
        fitted = unfitted(bench)
        ranking = rank(bench.fitter, bench.settings, fitted)
        yield {n: rank_curves(bench.fitter, fitted, ranking, variables=n) for n in (1, 2)}


def forms(ranking):
    return {trial.candidate.form.name for trial in ranking.trials}


@pytest.mark.slow
def test_curves_of_one_argument_are_not_crowded_out_by_those_of_a_switch(ranked):
    assert forms(ranked[2]) == {"coulomb_table", "coulomb_table_13", "coulomb_table_25"}
    assert not forms(ranked[1]) & forms(ranked[2])
    assert {"table", "table_13", "table_25"} <= forms(ranked[1])


def test_a_switch_is_that_of_the_state_at_its_site_and_its_level_a_function_of_another(ranked):
    places = [ranked[2].trials[i].candidate for i in leading_places(ranked[2])]
    own = {(c.site.target, *c.effect.variables) for c in places}
    assert ("v", "v", "x") in own  # a friction that depends on the place
    assert all(variables[0] == site for site, *variables in own)
    assert all(variables[0] != variables[1] for _, *variables in own)
