"""Places are ranked by what a free curve there would explain."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.candidates.arguments import TIME, open_arguments
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.candidates.places import count_variables, open_places
from cluster_est.closed_loop.candidates.sites import candidate_sites, forms_at
from cluster_est.closed_loop.screening.directions import CandidatePoint, directions
from cluster_est.closed_loop.screening.places import rank_places
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.thresholds import PlaceThresholds
from cluster_est.statistics.projection import OrthogonalProjection, ProjectedResidual
from workers.effects.kinds import FormCondition

SETTINGS = LoopSettings()


class Screened:
    """A system with its places and the directions of all candidates."""

    def __init__(self, name):
        with opened(missing_effect_problem(name)) as bench:
            fitted = unfitted(bench)
            self.trajectories = bench.trajectories(fitted)
            given = (fitted.problem, bench.description, self.trajectories)
            self.sites = candidate_sites(*given, SETTINGS)
            self.arguments = open_arguments(*given)
            self.forms = {s: forms_at(s, *given[:2], SETTINGS) for s in self.sites}
            self.places = open_places(self.sites, self.arguments, self.trajectories)
            self.candidates = make_candidates(*given, [], SETTINGS)
            clocks = [place for place in self.places if place.argument == TIME]
            self.chosen = [*self.places[:4], clocks[-1]]
            self.few = make_candidates(*given, [], SETTINGS, self.chosen)
            self.size = bench.size
            self.known = [
                np.array([fitted.estimates[n] for n in each.linear.parameter_names])
                for each in self.trajectories
            ]

    def direction(self, form, place):
        (candidate,) = [
            c
            for c in self.candidates
            if (c.form.name, c.site) == (form, place.site)
            and c.effect.variables == (() if place.argument == TIME else (place.argument,))
        ]
        trial = CandidatePoint(candidate, candidate.grid[len(candidate.grid) // 2])
        return directions(self.trajectories, [trial], self.known)[0]

    def ranked(self, residuals, seed=0):
        residual = ProjectedResidual(OrthogonalProjection(np.zeros((self.size, 0))), residuals)
        generator = np.random.default_rng(seed)
        return rank_places(
            self.places, self.trajectories, residual, (), generator, PlaceThresholds()
        )


@pytest.fixture(scope="module")
def drive():
    return Screened("two_mass_drive")


@pytest.mark.parametrize(
    ("form", "site", "argument"),
    [
        ("coulomb", "der(w_load)", "w_load"),
        ("drift", "der(w_load)", TIME),
        ("square", "der(w_motor)", "w_load"),
        ("gap", "pair w_motor,w_load", "twist"),
        ("linear", "parameter k_shaft", "w_load"),
        ("feed_through", "output load_speed", "torque"),
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
def test_the_place_of_a_direction_leads(drive, form, site, argument, seed):
    """Others may explain as much: what acts on a load acts on its damping too."""
    (place,) = [p for p in drive.places if (str(p.site), p.argument) == (site, argument)]
    direction = drive.direction(form, place)[:, 0]
    noise = np.random.default_rng(seed).standard_normal(drive.size)
    residuals = direction / np.linalg.norm(direction) + 0.1 * noise / np.linalg.norm(noise)
    statistics = {each.place: each.statistic for each in drive.ranked(residuals, seed)}
    # some places explain the same, and their sizes are estimated
    assert statistics[place] > 0.7 * max(statistics.values())
    assert np.quantile(list(statistics.values()), 0.25) < 0.6 * statistics[place]


def test_scales_and_order_do_not_matter(drive):
    residuals = np.random.default_rng(8).standard_normal(drive.size)
    found = drive.ranked(residuals)
    scaled = drive.ranked(1e6 * residuals)
    assert [each.place for each in scaled] == [each.place for each in found]
    assert {each.place for each in found} == set(drive.places)


def test_the_count_is_that_of_the_list(drive):
    for site in drive.sites:
        for form in drive.forms[site]:
            names = drive.arguments.at(site)
            listed = {
                0: 1,
                1: sum(drive.arguments.takes(form, site, name) for name in names),
                2: len(names) * (len(names) - 1) // 2,
            }[form.variables]
            if form.variables == 2 and FormCondition.OWN in form.when:
                listed = len(set(names) - {site.target})
            if FormCondition.FEEDS in form.when and form.variables == 2:
                listed = 0  # the drive's outputs are states
            if FormCondition.AROUND in form.when:
                listed = len(drive.arguments.around(site))
            assert count_variables(form, site, drive.arguments) == listed


def test_functions_are_only_looked_at_where_they_lead(drive):
    chosen = {(p.site, p.argument) for p in drive.chosen}
    one = [c for c in drive.few if c.form.variables == 1]
    assert {(c.site, c.effect.variables[0]) for c in one} <= chosen
    assert one
    constants = {
        c.effect.name
        for c in drive.candidates
        if c.form.variables == 0 and (c.site.kind != "derivative" or (c.site, TIME) in chosen)
    }
    assert {c.effect.name for c in drive.few if c.form.variables == 0} == constants
