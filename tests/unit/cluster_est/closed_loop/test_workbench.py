"""Models with effects, and what every step works with."""

from dataclasses import replace

import numpy as np
import pytest
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est import Experiment, LeastSquares, LoopSettings, Output
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.stages import LoopStage
from cluster_est.closed_loop.workbench import FitStart

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


def shortened(bench):
    """The kind of copies that are cut, the shortest of them."""
    return min((kind for kind in bench.synthetic if hasattr(kind, "share")), key=lambda k: k.share)


def enlarged(bench):
    (kind,) = (kind for kind in bench.synthetic if hasattr(kind, "factor"))
    return kind


def test_synthetic_experiments_start_from_the_values_of_their_experiments(bench):
    start = FitStart(bench.problem, {"m": 1.3, "c[e0]": 0.7, "c[e1]": 0.9})
    kind = shortened(bench)
    space = bench.space(start, kind)
    labels = [u.label for u in space.unknowns]
    part = f"first {kind.share:.0%}"
    assert labels == ["m", "k", f"c[e0 ({part})]", f"c[e1 ({part})]"]
    np.testing.assert_allclose(space.start, [1.3, 30.0, 0.7, 0.9])
    kept = sum(space.problem.experiments[e].size for e in space.experiments)
    assert kept < 1.3 * kind.share * bench.size


def copies(bench, kind):
    runs = bench.everything.experiments
    pairs = zip(bench.train, bench.synthetic[kind], strict=True)
    return [(runs[own], runs[copy]) for own, copy in pairs]


def test_a_part_has_the_measurements_until_its_end(bench):
    for whole, part in copies(bench, shortened(bench)):
        assert part.stop == pytest.approx(6.0 * shortened(bench).share)
        (own,), (cut,) = whole.outputs, part.outputs
        kept = own.times <= part.stop
        np.testing.assert_array_equal(cut.times, own.times[kept])
        np.testing.assert_array_equal(cut.values, own.values[kept])
        assert (cut.sigma, part.values, part.inputs) == (own.sigma, whole.values, whole.inputs)


@pytest.mark.parametrize("samples", [4, 101])
def test_a_part_is_as_long_as_each_output_needs(bench, samples):
    """One of few measurements has them all."""
    times = np.linspace(0.0, 10.0, samples)
    few = Experiment("few", 0.0, 10.0, (), (Output("y", times, times**2),))
    kind = replace(shortened(bench), share=0.01)
    (cut,) = kind.of(few).outputs
    assert len(cut.times) == min(samples, kind.samples)
    assert kind.of(few).stop == cut.times[-1]


def test_inputs_swing_further_about_their_means(bench):
    kind = enlarged(bench)
    for own, copy in copies(bench, kind):
        (given,), (more,) = own.inputs, copy.inputs
        swing = given.values - given.values.mean()
        np.testing.assert_allclose(more.values - given.values, (kind.factor - 1.0) * swing)
        assert copy.outputs == own.outputs
        still = replace(own, inputs=())
        assert kind.of(still).key == still.key


def test_a_fit_that_cannot_be_simulated_is_none(bench):
    heavy, *others = bench.problem.parameters
    light = replace(heavy, start=-1.0, lower=-2.0, upper=-0.5)
    broken = replace(bench.problem, parameters=(light, *others))
    good = FitStart(bench.problem, {})
    method = LeastSquares(max_iterations=2)
    fits = bench.fit(LoopStage.REFITS, [good, FitStart(broken, {}), good], method)
    assert [fit is None for fit in fits] == [False, True, False]
    assert fits[0].x.tobytes() == fits[2].x.tobytes()


@pytest.mark.parametrize("parts", [0, 1])
def test_a_meter_counts_parts_of_experiments(bench, parts):
    kind = shortened(bench) if parts else None
    space = bench.space(FitStart(bench.problem, {}), kind)
    before = bench.meter.full
    bench.evaluate(LoopStage.TRIALS, [(space, space.start[None, :] + 1e-3)])
    share = kind.share if kind is not None else 1.0
    assert bench.meter.full - before == pytest.approx(2.0 * share, rel=1e-6)


def test_streams_of_random_numbers_are_apart_and_repeat(bench):
    one, same, other = (bench.generator(i).normal(size=4) for i in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.isclose(one, other).any()
