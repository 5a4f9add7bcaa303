"""Where an effect's argument was: its own signal as it was before the effect."""

from __future__ import annotations

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.findings.effect_curves import arguments
from workers.effects.site import EffectSite


@pytest.mark.parametrize("limited", [False, True])
def test_an_effect_at_an_input_sees_what_was_measured(limited):
    """A limit at the input: what acts behind it sees the limited force."""
    problem = missing_effect_problem("mass_spring_damper")
    with opened(problem) as bench:
        (trajectory, *_) = bench.trajectories(unfitted(bench))
    force = trajectory.driven["F"]
    trajectory.signals["F"][:] = np.clip(force, -0.1, 0.1)
    place = EffectSite("derivative", "v") if limited else EffectSite("input", "F")
    seen = arguments(trajectory, place, "F")
    assert np.abs(force).max() > 0.1
    assert np.abs(seen).max() == pytest.approx(0.1 if limited else np.abs(force).max())
