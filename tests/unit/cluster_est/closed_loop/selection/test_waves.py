"""Waves in time are believed only where they cannot be the model's own, and all agree."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from support.loop_objects import made_screening
from support.truth.systems_with_missing_effects import missing_effect_problem, opened, unfitted

from cluster_est.closed_loop.candidates.make import EffectCandidate
from cluster_est.closed_loop.selection.accept import LeaveOneOutPrediction
from cluster_est.closed_loop.selection.gates import best_that_passes
from cluster_est.closed_loop.selection.refinement.refine import RefittedCandidate
from cluster_est.closed_loop.selection.refinement.visited_models import VisitedModels
from cluster_est.closed_loop.selection.rounds import RejectionReason, RoundStart
from cluster_est.closed_loop.selection.waves import believable, period_of, residuals_without
from cluster_est.closed_loop.workbench import FitStart, FittedModel, LoopWorkbench
from workers.effects.forms import FORMS
from workers.effects.site import EffectSite
from workers.messages import Effect

RESONANCE = np.sqrt(30.0 / 1.2)
"""Of the mass on its spring, in rad/s: its damping ratio is 0.05."""


@pytest.mark.parametrize(
    ("name", "expected"),
    [("sine", True), ("drift", True), ("constant", False), ("coulomb", False), ("table", False)],
)
def test_forms_of_time_alone(name, expected):
    assert FORMS["derivative", name].of_time_alone is expected


@pytest.fixture(scope="module")
def bench():
    with opened(missing_effect_problem("mass_spring_damper")) as made:
        yield made


def candidate(form: str) -> EffectCandidate:
    found = FORMS["derivative", form]
    site = EffectSite("derivative", "v")
    variables = ("v",) if found.variables else ()
    count = len(found.coefficients)
    return EffectCandidate(
        Effect(form, str(site), form, variables), found, site, True,
        ((1.0,) * count,), (-100.0,) * count, (100.0,) * count,
    )  # fmt: skip


def grown(bench, form: str, values: tuple[float, ...], left: float, apart: float = 0.0):
    """A model with one effect; the second experiment wants a wave that is this much apart."""
    start = FitStart(bench.problem, {}).plus(candidate(form), values)
    space = bench.space(start)
    random = np.random.default_rng(4)
    jacobian = random.standard_normal((bench.size, space.size))
    residuals = np.full(bench.size, np.sqrt(left / bench.size))
    if apart:
        labels = [u.label for u in space.unknowns]
        column = labels.index("sine.a")
        for rows, sign in zip(space.rows, (1.0, -1.0), strict=True):
            residuals[rows] -= sign * apart * jacobian[rows][:, column]
    fitted = FittedModel(space, space.start, residuals, jacobian, start.added)
    return RefittedCandidate(fitted, float(np.log(fitted.sse)), True)


def names(found):
    return [c.candidate.effect.name for c in found]


@pytest.mark.parametrize(
    ("frequency", "kept"),
    [(9.0, True), (RESONANCE, False), (1.05 * RESONANCE, False), (2.0, False), (3.5, True)],
)
def test_a_wave_is_no_resonance_and_has_three_periods(bench, frequency, kept):
    """The records last 6 s."""
    wave = grown(bench, "sine", (1.0, 0.5, frequency), 1.0)
    assert period_of(wave.candidate, wave.fitted) == pytest.approx(2.0 * np.pi / frequency)
    base = unfitted(bench)
    assert names(believable(bench, base, [wave])) == (["sine"] if kept else [])


@pytest.mark.parametrize(("apart", "kept"), [(0.1, True), (0.4, True), (0.7, False), (2.0, False)])
def test_all_experiments_agree_on_a_wave(bench, apart, kept):
    wave = grown(bench, "sine", (1.0, 0.0, 9.0), 1.0, apart)
    assert bool(believable(bench, unfitted(bench), [wave])) is kept


@pytest.mark.parametrize(("left", "first"), [(0.03, "coulomb"), (0.2, "sine")])
def test_a_mechanism_that_does_nearly_as_much_comes_first(bench, left, first):
    base = unfitted(bench)
    wave = grown(bench, "sine", (1.0, 0.5, 9.0), 0.01 * base.sse)
    friction = grown(bench, "coulomb", (1.0, 0.01), left * base.sse)
    found = believable(bench, base, [wave, friction])
    assert names(found) == [first, *({"sine", "coulomb"} - {first})]


def test_where_only_waves_are_left_that_cannot_be_believed_that_is_the_reason(bench):
    """The first has less than three periods in its records, the second does not fit better."""
    base = unfitted(bench)
    screening = made_screening(base.jacobian, base.residuals, [], [])
    begun = RoundStart(
        base, base, LeaveOneOutPrediction(np.ones(2)), screening, VisitedModels(1.0), 1.0
    )
    brief = grown(bench, "sine", (1.0, 0.5, 2.0), 1.0)
    brief = replace(brief, criterion=base.criterion(bench.records) - 100.0)
    worse = replace(brief, criterion=base.criterion(bench.records) + 100.0)
    assert best_that_passes(bench, begun, [brief]).seen.why is RejectionReason.ONLY_WAVES
    assert best_that_passes(bench, begun, [worse]).seen.why is RejectionReason.NO_IMPROVEMENT


def test_an_output_without_samples_has_no_periods(bench):
    """Its record counts not, instead of ending the search."""
    wave = grown(bench, "sine", (1.0, 0.5, 9.0), 1.0)
    last = bench.records.items[-1]
    empty = replace(last, rows=slice(last.rows.stop, last.rows.stop), times=np.zeros(0))
    records = replace(bench.records, items=(*bench.records.items, empty))
    found = believable(replace(bench, records=records), unfitted(bench), [wave])
    assert names(found) == ["sine"]


def test_what_is_no_wave_stays_in_its_order(bench):
    base = unfitted(bench)
    made = [grown(bench, "drift", (1.0,), 0.1), grown(bench, "coulomb", (1.0, 0.01), 0.11)]
    assert believable(bench, base, made) == made


def test_what_a_wave_leaves_when_it_is_taken_away(bench):
    """To first order: a residual that is the wave's own leaves nothing but what was there."""
    made = grown(bench, "sine", (3.0, -2.0, 7.0), 1.0).fitted
    labels = [u.label for u in made.space.unknowns]
    a, b = (made.jacobian[:, labels.index(f"sine.{part}")] for part in "ab")
    without = residuals_without(made, made.added[0])
    assert without == pytest.approx(made.residuals - 3.0 * a + 2.0 * b)


@pytest.mark.parametrize(("places", "kept"), [(5, False), (3, False), (2, True), (0, True)])
def test_a_mode_that_soon_goes_is_no_resonance(bench, monkeypatch, places, kept):
    """Of a model that is not linear: at so many of the five places the mode is there."""
    ringing, still = np.array([[0.0, 81.0], [-1.0, 0.0]]), -np.eye(2)
    base = unfitted(bench)
    found = []
    for trajectory in bench.trajectories(base):
        steps = np.linspace(0, len(trajectory.linear.times) - 1, 5).astype(int).tolist()
        matrices = dict(zip(steps, [ringing] * places + [still] * (5 - places), strict=True))
        linear = SimpleNamespace(
            times=trajectory.linear.times, A=SimpleNamespace(at=matrices.__getitem__)
        )
        found.append(replace(trajectory, linear=linear))
    monkeypatch.setattr(LoopWorkbench, "trajectories", lambda self, fitted: found)
    wave = grown(bench, "sine", (1.0, 0.5, 9.0), 1.0)
    assert bool(believable(bench, base, [wave])) is kept
