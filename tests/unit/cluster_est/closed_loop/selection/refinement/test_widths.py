"""What counts as the width of a switch."""

from __future__ import annotations

from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.selection.refinement.switch_widths import _widths
from cluster_est.closed_loop.settings import LoopSettings


def test_what_a_power_law_refers_to_is_none():
    """Its strength is that at the reference: with both free, neither would be determined."""
    problem = missing_effect_problem("mass_spring_damper", signals=())
    settings = LoopSettings(forms=("coulomb", "power", "contact"))
    with opened(problem) as bench:
        courses = bench.trajectories(unfitted(bench))
        candidates = make_candidates(problem, bench.description, courses, (), settings)
    widths = {c.form.name: tuple(_widths(c)) for c in candidates if c.own}
    assert widths == {"coulomb": ("coulomb_v.width",), "power": (), "contact": ()}
