"""A structure that is stuck is refitted from other starts; the truth is in an FMU's C source."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import measured, missing_effect_problem, opened

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.selection.declared_model import THOROUGH
from cluster_est.closed_loop.selection.restarts import refit_from_other_starts
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart, FittedModel

TRUE = 0.8


@pytest.fixture(scope="module")
def problem():
    """A spring whose force is lost where it is below TRUE: the force that acts is declared zero.

    The plain model makes the data from what is left of the force, so no effect is involved.
    """
    plain = missing_effect_problem("mass_spring_damper", experiments=2)
    lost = replace(
        plain,
        experiments=tuple(
            replace(
                run,
                inputs=tuple(
                    replace(i, values=np.sign(i.values) * np.maximum(np.abs(i.values) - TRUE, 0.0))
                    for i in run.inputs
                ),
            )
            for run in plain.experiments
        ),
    )
    made = measured(lost, 0.001)
    return replace(
        made,
        experiments=tuple(
            replace(run, inputs=own.inputs)
            for run, own in zip(made.experiments, plain.experiments, strict=True)
        ),
    )


def dead_zone(bench, base):
    settings = LoopSettings(forms=("dead_zone",), sites=("input F",))
    (candidate,) = make_candidates(
        base.problem, bench.description, bench.trajectories(base), (), settings
    )
    return candidate


def test_a_dead_zone_that_swallows_the_whole_force_is_left(problem):
    """There the cost is flat, so no gradient leads out."""
    with opened(problem) as bench:
        (base,) = bench.fit(LoopStage.DECLARED_MODEL, [FitStart(problem, {})], THOROUGH)
        candidate = dead_zone(bench, base)
        largest = max(np.abs(i.values).max() for run in problem.experiments for i in run.inputs)
        stuck = base.start.plus(candidate, (2.0 * largest,))
        (grown,) = bench.fit(LoopStage.REFITS, [stuck], THOROUGH)
        label = f"{candidate.effect.name}.k"
        assert grown.estimates[label] > largest
        found = refit_from_other_starts(bench, base, grown)
    assert found.structure == grown.structure
    assert found.estimates[label] == pytest.approx(TRUE, rel=0.01)
    assert found.sse < 1e-3 * grown.sse


def test_a_structure_that_fits_best_is_kept(problem):
    with opened(problem) as bench:
        (base,) = bench.fit(LoopStage.DECLARED_MODEL, [FitStart(problem, {})], THOROUGH)
        candidate = dead_zone(bench, base)
        (grown,) = bench.fit(LoopStage.REFITS, [base.start.plus(candidate, (TRUE,))], THOROUGH)
        found = refit_from_other_starts(bench, base, grown)
    assert found.sse <= grown.sse
    assert found.estimates == pytest.approx(grown.estimates, rel=1e-3)


def test_the_users_own_starts_are_tried_too(problem):
    """From the fit of the declared model, which stands at its bounds, there is no way back."""
    with opened(problem) as bench:
        (base,) = bench.fit(LoopStage.DECLARED_MODEL, [FitStart(problem, {})], THOROUGH)
        candidate = dead_zone(bench, base)
        bounds = {u.label: u.parameter.upper for u in base.space.unknowns if not u.scope}
        lost = FitStart(base.problem, base.estimates | bounds)
        far = replace(base, x=bench.space(lost).start)
        grown = far.start.plus(candidate, (TRUE,))
        space = bench.space(grown)
        (at,) = bench.evaluate(LoopStage.TRIALS, [(space, space.start[None])])[0]
        stuck = FittedModel(
            space, space.start, at.residuals, np.zeros((len(at.residuals), space.size)), grown.added
        )
        found = refit_from_other_starts(bench, far, stuck)
    assert found.sse < 1e-3 * stuck.sse
