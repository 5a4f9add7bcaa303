from dataclasses import replace

import numpy as np
import pytest
from support.problems.seen_springs import with_outputs
from support.truth.systems_with_missing_effects import (
    measured,
    missing_effect_problem,
    opened,
    unfitted,
)

from cluster_est import Experiment, LeastSquares, LoopSettings, Output, close_loop
from cluster_est.closed_loop.candidates.make import make_candidates
from cluster_est.closed_loop.fitter import ENLARGED, SAMPLES_KEPT, SHORTENED, FitStart
from cluster_est.closed_loop.selection.starts import BRIEF
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.errors import ProblemError

SETTINGS = LoopSettings(forms=("coulomb", "constant"), sites=("der(v)",))


@pytest.fixture(scope="module")
def bench():
    problem = measured(missing_effect_problem("mass_spring_damper", local=("c",)), 0.01)
    with opened(problem, SETTINGS) as ready:
        yield ready


def candidates(bench):
    fitted = unfitted(bench)
    found = make_candidates(
        fitted.problem,
        bench.fitter.description,
        bench.fitter.trajectories(fitted),
        [],
        bench.settings,
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
    assert fitted.likelihood(bench.fitter.records) == pytest.approx(likelihood)
    assert fitted.criterion(bench.fitter.records) == pytest.approx(likelihood + k * np.log(n))


def test_each_output_has_a_variance_of_its_own():
    problem = measured(missing_effect_problem("two_mass_drive"), 0.1)
    with opened(problem) as ready:
        fitted = unfitted(ready)
        first, second = (fitted.residuals[ready.fitter.records.of_output(o)] for o in (0, 1))
        units = ready.fitter.noise_in_units(np.array([2.0, 3.0]))
        expected = sum(len(r) * np.log(np.mean(r**2)) for r in (first, second))
        assert fitted.likelihood(ready.fitter.records) == pytest.approx(expected)
    assert units == pytest.approx({"motor_speed": 2.0 * 0.5, "load_speed": 3.0 * 0.7})


def shortened(bench):
    """The kind of copies that are cut, the shortest of them."""
    return min(
        (kind for kind in bench.fitter.synthetic if hasattr(kind, "share")), key=lambda k: k.share
    )


def enlarged(bench):
    (kind,) = (kind for kind in bench.fitter.synthetic if hasattr(kind, "factor"))
    return kind


def test_synthetic_experiments_start_from_the_values_of_their_experiments(bench):
    start = FitStart(bench.fitter.problem, {"m": 1.3, "c[e0]": 0.7, "c[e1]": 0.9})
    kind = shortened(bench)
    space = bench.fitter.space(start, kind)
    labels = [u.label for u in space.unknowns]
    part = f"first {kind.share:.0%}"
    assert labels == ["m", "k", f"c[e0 ({part})]", f"c[e1 ({part})]"]
    np.testing.assert_allclose(space.start, [1.3, 30.0, 0.7, 0.9])
    kept = sum(space.problem.experiments[e].size for e in space.experiments)
    assert kept < 1.3 * kind.share * bench.fitter.size


def copies(bench, kind):
    runs = bench.fitter.everything.experiments
    pairs = zip(bench.fitter.train, bench.fitter.synthetic[kind], strict=True)
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
    assert len(cut.times) == min(samples, SAMPLES_KEPT)
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
    heavy, *others = bench.fitter.problem.parameters
    light = replace(heavy, start=-1.0, bounds=(-2.0, -0.5))
    broken = replace(bench.fitter.problem, parameters=(light, *others))
    good = FitStart(bench.fitter.problem, {})
    method = LeastSquares(max_iterations=2)
    fits = bench.fitter.fit(LoopStage.REFITS, [good, FitStart(broken, {}), good], method)
    assert [fit is None for fit in fits] == [False, True, False]
    assert fits[0].x.tobytes() == fits[2].x.tobytes()


@pytest.fixture(scope="module")
def declared(bench):
    fitter = bench.fitter
    (fit,) = fitter.fit(LoopStage.DECLARED_MODEL, [FitStart(fitter.problem, {})], BRIEF)
    return fit


@pytest.mark.parametrize("kind", [None, *SHORTENED, ENLARGED])
def test_a_candidate_far_more_expensive_than_the_declared_model_fails(bench, declared, kind):
    """Its friction holds the mass at a rate of 1e6 per second, and the data have 100 samples."""
    _, found = candidates(bench)
    starts = [declared.start.plus(found["coulomb"], (k, 1e-3)) for k in (0.3, 1000.0)]
    fitter = bench.fitter.limited_by(declared)
    spaces = [fitter.space(start, kind) for start in starts]
    points = [(space, space.start[None, :]) for space in spaces]
    (usual,), (held,) = fitter.evaluate(LoopStage.TRIALS, points)
    assert usual.ok
    assert usual.steps > 601 * 0.15 * 2
    assert "the simulation reached its limit of " in held.reason
    before = fitter.runner.simulations
    ((free,),) = bench.fitter.evaluate(LoopStage.TRIALS, points[:1])
    assert np.array_equal(free.residuals, usual.residuals)
    assert fitter.runner.simulations == before  # a limit that was not reached changes nothing


def test_a_limit_of_candidates_is_none_of_the_declared_model(bench, declared):
    fitter = replace(bench.fitter, step_limits=dict.fromkeys(bench.fitter.train, 1))
    again = fitter.fit(LoopStage.DECLARED_MODEL, [FitStart(fitter.problem, {})], BRIEF)
    assert again[0].steps == declared.steps > 0
    _, found = candidates(bench)
    start = declared.start.plus(found["coulomb"], (0.3, 0.1))
    assert fitter.fit(LoopStage.REFITS, [start], BRIEF) == [None]


def test_uncounted_steps_have_no_limit(bench, declared):
    uncounted = replace(declared, steps_of_runs=(0, 0))
    assert not any(bench.fitter.limited_by(uncounted).step_limits.values())


@pytest.mark.parametrize("parts", [0, 1])
def test_a_meter_counts_parts_of_experiments(bench, parts):
    kind = shortened(bench) if parts else None
    space = bench.fitter.space(FitStart(bench.fitter.problem, {}), kind)
    before = bench.fitter.meter.full
    bench.fitter.evaluate(LoopStage.TRIALS, [(space, space.start[None, :] + 1e-3)])
    share = kind.share if kind is not None else 1.0
    assert bench.fitter.meter.full - before == pytest.approx(2.0 * share, rel=1e-6)


def test_streams_of_random_numbers_are_apart_and_repeat(bench):
    one, same, other = (bench.fitter.generator(i).normal(size=4) for i in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.isclose(one, other).any()


SPRING = missing_effect_problem("mass_spring_damper")


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            {"forms": ("friction",)},
            r"there is no form 'friction'; the forms of the family 'friction' are viscous, coulomb",
        ),
        ({"forms": ("coulom",)}, r"closed_loop\.effects: there is no form 'coulom'.*coulomb"),
        ({"sites": ("der(w)",)}, r"does not offer the site 'der\(w\)'; did you mean 'der\("),
        ({"sites": ("input y",)}, r"closed_loop\.sites: mass_spring_damper\.fmu does not offer"),
        (
            {"forms": ("rate_limit",), "sites": ("output y",)},
            r"closed_loop\.effects: must name a form for one of the sites",
        ),
    ],
)
def test_forms_and_sites_that_are_not_there(settings, sentence):
    with pytest.raises(ProblemError, match=sentence), opened(SPRING, LoopSettings(**settings)):
        pass


def test_a_search_without_a_candidate_says_so():
    settings = LoopSettings(forms=("coulomb",), sites=("output y",))
    result = close_loop(SPRING, settings=settings)
    assert not result.effects
    assert result.notes[0].startswith(
        "no effect was tried: with these data, none of the forms coulomb can be used at the sites "
        "output y (some"
    )


def test_states_are_closed_in_co_simulation():
    problem = missing_effect_problem("mass_spring_damper", interface="co_simulation")
    with (
        pytest.raises(ProblemError, match="does not offer"),
        opened(problem, LoopSettings(sites=("der(v)",))),
    ):
        pass
    with opened(problem) as bench:
        assert "der(v)" not in bench.scope.sites
        (note,) = (n for n in bench.scope.notes if "state derivatives are not accessible" in n)
        assert 'set model.interface = "model_exchange"' in note


def of_few_samples(*samples, sigma=0.5):
    """Springs of which only so many measurements are left, the first ones."""
    runs = []
    for run, count in zip(SPRING.experiments, samples, strict=True):
        (output,) = run.outputs
        kept = {"times": output.times[:count], "values": output.values[:count], "sigma": sigma}
        runs.append(replace(run, outputs=(replace(output, **kept),)))
    return replace(SPRING, experiments=tuple(runs))


@pytest.mark.parametrize("samples", [3, 7])
def test_too_few_measurements(samples):
    sentence = f"at least 16 measured values, .* 3 parameters, but they have {2 * samples}"
    with pytest.raises(ProblemError, match=sentence), opened(of_few_samples(samples, samples)):
        pass


def test_notes_for_a_reader():
    with opened(missing_effect_problem("mass_spring_damper", experiments=1)) as bench:
        assert any("only one training experiment" in note for note in bench.scope.notes)
        assert any('no experiment has role = "test"' in note for note in bench.scope.notes)
    first, second = SPRING.experiments
    with opened(replace(SPRING, experiments=(first, replace(second, role="test")))) as bench:
        assert bench.fitter.train == (0,)
        assert not any("role" in note for note in bench.scope.notes)


def two_units(sigma):
    """Two speeds, one with ten times the noise."""
    problem = measured(missing_effect_problem("two_mass_drive"), 0.0)
    generator, sizes = np.random.default_rng(8), {"motor_speed": 0.02, "load_speed": 0.2}

    def noisy(output):
        noise = sizes[output.variable] * generator.normal(size=len(output.values))
        return replace(output, sigma=sigma, values=output.values + noise)

    return with_outputs(problem, noisy)


@pytest.mark.parametrize("guess", [None, 0.5])
def test_outputs_without_sigma_are_weighted_with_their_noise(guess):
    problem = two_units(1.0 if guess is None else guess)
    if guess is not None:
        problem = with_outputs(problem, lambda output: replace(output, sigma_known=False))
    with opened(problem) as bench:
        assert not bench.fitter.sigma_declared
        for run in bench.fitter.problem.experiments:
            assert [o.sigma for o in run.outputs] == pytest.approx([0.02, 0.2], rel=0.2)
        assert any("sigma = { motor_speed = 0.0" in note for note in bench.scope.notes)


def test_a_known_sigma_does_not_make_those_of_other_outputs_known():
    """The sigma of the load's speed is a guess, so both outputs are weighted with their noise."""

    def half(output):
        return replace(output, sigma_known=output.variable == "motor_speed")

    with opened(with_outputs(two_units(0.5), half)) as bench:
        assert not bench.fitter.sigma_declared
        for run in bench.fitter.problem.experiments:
            assert [o.sigma for o in run.outputs] == pytest.approx([0.02, 0.2], rel=0.2)
        assert any("not every sigma of the outputs is known, so" in n for n in bench.scope.notes)


def test_one_line_is_not_proposed_for_sigmas_that_differ_between_experiments():
    problem = two_units(0.5)
    first, *others = problem.experiments
    unknown = replace(first, outputs=tuple(replace(o, sigma=1.0) for o in first.outputs))
    with opened(replace(problem, experiments=(unknown, *others))) as bench:
        (note,) = (n for n in bench.scope.notes if "not every sigma of the outputs is known" in n)
    assert "sigma = {" not in note


def test_a_guess_that_grows_with_the_value_keeps_its_shape():
    """The guess is ten times the noise everywhere, so it is divided by ten everywhere."""

    def guessed(output):
        return replace(output, relative_sigma=0.3, sigma_known=False)

    problem = with_outputs(two_units(0.2), guessed)
    with opened(problem) as bench:
        for run in bench.fitter.problem.experiments:
            for output in run.outputs:
                assert output.relative_sigma / output.sigma == pytest.approx(0.3 / 0.2)


def test_an_output_without_known_noise_is_not_said_to_be_weighted_with_it():
    """Nothing was measured of one of them."""
    none = {"motor_speed": {}, "load_speed": {"times": np.zeros(0), "values": np.zeros(0)}}
    problem = with_outputs(two_units(1.0), lambda output: replace(output, **none[output.variable]))
    with opened(problem) as bench:
        (note,) = (note for note in bench.scope.notes if "sigma" in note)
    assert "noise, except load_speed, whose noise is not known; for" in note
    assert "load_speed = 1 }" in note


@pytest.mark.parametrize(
    ("samples", "sigma", "said"), [((9, 9), 1.0, True), ((9, 10), 1.0, False), ((9, 9), 0.1, False)]
)
def test_records_too_short_to_know_their_noise_are_named(samples, sigma, said):
    """The whole residual of the declared model is taken for noise then."""
    with opened(of_few_samples(*samples, sigma=sigma)) as bench:
        notes = [
            note
            for note in bench.scope.notes
            if "all records of y have fewer than 10 samples" in note
        ]
    assert bool(notes) is said


def test_given_sigmas_are_kept():
    with opened(two_units(0.5)) as bench:
        assert {o.sigma for run in bench.fitter.problem.experiments for o in run.outputs} == {0.5}
        assert not any("sigma" in note for note in bench.scope.notes)
