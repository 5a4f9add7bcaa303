"""Free curves of one argument and those of a switch are ranked apart, the coarse ones first."""

import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.screening.curves import leading_places, rank_curves
from cluster_est.closed_loop.screening.ranking import rank


@pytest.fixture(scope="module")
def ranked():
    with opened(missing_effect_problem("mass_spring_damper")) as bench:
        fitted = unfitted(bench)
        ranking = rank(bench, fitted)
        yield {n: rank_curves(bench, fitted, ranking, variables=n) for n in (1, 2)}


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
