"""Models with effects, and what every step works with."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.selection.declared_model import BRIEF
from cluster_est.closed_loop.settings import LoopSettings
from cluster_est.closed_loop.simulation_meter import SimulationMeter
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.synthetic_experiments import ShortenedCopy
from cluster_est.closed_loop.workbench import FitStart
from cluster_est.running.records import TaskOrigin
from workers.messages import Outcome, Status, Task

NAME = "mass_spring_damper"
SETTINGS = LoopSettings(forms=("coulomb", "constant"), sites=("der(v)",))


@pytest.fixture(scope="module")
def bench():
    problem = measured(missing_effect_problem(NAME, local=("c",)), 0.01)
    with opened(problem, SETTINGS) as ready:
        yield ready


def candidates(bench):
    fitted = unfitted(bench)
    found = make_candidates(
        fitted.problem, bench.description, bench.trajectories(fitted), [], bench.settings
    )
    return fitted, {c.form.name: c for c in found}


def test_an_effect_is_added_and_taken_away(bench):
    fitted, found = candidates(bench)
    one = fitted.start.plus(found["constant"], (0.2,))
    two = one.plus(found["coulomb"], (0.3, 0.01))
    names = [p.name for p in two.problem.parameters]
    assert names == ["m", "k", "c", "constant_v.k", "coulomb_v.k", "coulomb_v.width"]
    assert [p.start for p in two.problem.parameters[3:]] == [0.2, 0.3, 0.01]
    assert [p.fixed for p in two.problem.parameters[3:]] == [False, False, True]
    left = two.minus(0)
    assert left.added == (found["coulomb"],)
    assert [e.name for e in left.problem.effects] == ["coulomb_v"]
    assert [p.name for p in left.problem.parameters[3:]] == ["coulomb_v.k", "coulomb_v.width"]


def test_the_criterion_is_that_of_schwarz(bench):
    fitted = unfitted(bench)
    n, k = len(fitted.residuals), 4  # m, k and two of c
    likelihood = n * np.log(np.mean(fitted.residuals**2))
    assert fitted.likelihood(bench.records) == pytest.approx(likelihood)
    assert fitted.criterion(bench.records) == pytest.approx(likelihood + k * np.log(n))


def test_each_output_has_a_variance_of_its_own():
    problem = measured(missing_effect_problem("two_mass_drive"), 0.1)
    with opened(problem) as ready:
        fitted = unfitted(ready)
        first, second = (fitted.residuals[ready.records.of_output(o)] for o in (0, 1))
        units = ready.noise_in_units(np.array([2.0, 3.0]))
        expected = sum(len(r) * np.log(np.mean(r**2)) for r in (first, second))
        assert fitted.likelihood(ready.records) == pytest.approx(expected)
    assert units == pytest.approx({"motor_speed": 2.0 * 0.5, "load_speed": 3.0 * 0.7})


def test_synthetic_experiments_start_from_the_values_of_their_experiments(bench):
    start = FitStart(bench.problem, {"m": 1.3, "c[e0]": 0.7, "c[e1]": 0.9})
    space = bench.space(start, ShortenedCopy(0.15))
    labels = [u.label for u in space.unknowns]
    assert labels == ["m", "k", "c[e0 (first 15%)]", "c[e1 (first 15%)]"]
    np.testing.assert_allclose(space.start, [1.3, 30.0, 0.7, 0.9])
    assert sum(space.problem.experiments[e].size for e in space.experiments) < 0.2 * bench.size


def test_a_fit_that_cannot_be_simulated_is_none(bench):
    heavy, *others = bench.problem.parameters
    light = replace(heavy, start=-1.0, lower=-2.0, upper=-0.5)
    broken = replace(bench.problem, parameters=(light, *others))
    good = FitStart(bench.problem, {})
    fits = bench.fit(LoopStage.REFITS, [good, FitStart(broken, {}), good], BRIEF)
    assert [fit is None for fit in fits] == [False, True, False]
    assert fits[0].x.tobytes() == fits[2].x.tobytes()


def test_a_meter_counts_parts_of_experiments(bench):
    heard = []
    runs = bench.everything.experiments
    meter = SimulationMeter(runs, lambda origin, outcome: heard.append(origin.task.experiment))
    for i in (0, 2, 2, 4):
        meter(TaskOrigin(Task(i, i, np.zeros(0)), "s", 0, "p"), Outcome(i, Status.OK))
    expected = sum((runs[i].stop - runs[i].start) / 6.0 for i in (0, 2, 2, 4))
    assert meter.full == pytest.approx(expected, rel=1e-6)
    assert heard == [0, 2, 2, 4]


def test_streams_of_random_numbers_are_apart_and_repeat(bench):
    one, same, other = (bench.generator(i).normal(size=4) for i in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.isclose(one, other).any()
