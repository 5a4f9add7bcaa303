from dataclasses import replace

import numpy as np
import pytest
from support.problems.seen_springs import with_outputs
from support.truth.systems_with_missing_effects import measured, missing_effect_problem

from cluster_est import LoopResult, LoopSettings, Problem, close_loop, detect
from workers.messages import FloatArray

NOISE = 0.01
SETTINGS = LoopSettings(
    forms=("constant",), sites=("der(v)",), draws=100, max_effects=1, pairs=False
)


@pytest.fixture(scope="module")
def clean() -> Problem:
    """A spring with white noise; the second experiment is held out."""
    problem = measured(missing_effect_problem("mass_spring_damper"), NOISE)
    first, second = problem.experiments
    return replace(problem, experiments=(first, replace(second, role="test")))


def changed(problem: Problem, *added: FloatArray) -> Problem:
    """With this added to the output of each experiment."""
    runs = []
    for run, more in zip(problem.experiments, added, strict=True):
        (output,) = run.outputs
        runs.append(replace(run, outputs=(replace(output, values=output.values + more),)))
    return replace(problem, experiments=tuple(runs))


def spikes(count: int, seed: int) -> FloatArray:
    """So many outliers of 15 times the noise, apart from each other."""
    generator = np.random.default_rng(seed)
    off = np.zeros(601)
    off[10 + 25 * generator.permutation(23)[:count]] = 15.0 * NOISE
    return off


def closed(problem: Problem) -> LoopResult:
    """A loop that looks for next to nothing."""
    return close_loop(problem, settings=SETTINGS)


def test_nothing_is_set_aside_where_nothing_is_off(clean: Problem) -> None:
    found = closed(clean)
    assert found.before.problem.experiments == clean.experiments
    assert not any("outlier" in note or "grows" in note for note in found.notes)


def test_outliers_are_left_out_and_counted(clean: Problem) -> None:
    off = (spikes(6, 1), spikes(3, 2))
    spoiled = changed(clean, *off)
    found = closed(spoiled)
    for run, all_of_it, where in zip(
        found.before.problem.experiments, spoiled.experiments, off, strict=True
    ):
        kept = where == 0.0
        assert run.outputs[0].times.tolist() == all_of_it.outputs[0].times[kept].tolist()
        assert run.outputs[0].values.tolist() == all_of_it.outputs[0].values[kept].tolist()
        assert run.inputs == all_of_it.inputs
    assert found.before.problem.experiments[0].size == 601 - 6
    (note,) = (note for note in found.notes if "outlier" in note)
    assert note.startswith("outliers were left out of fits, errors and tables: y 6 of 601 training")
    assert "and y 3 of 601 held-out samples (up to" in note
    assert [len(run.outputs[0].times) for run in spoiled.experiments] == [601, 601]


def test_too_many_are_kept_and_said(clean: Problem) -> None:
    generator = np.random.default_rng(3)
    many = np.where(generator.uniform(size=601) < 0.09, generator.choice([-0.3, 0.3], 601), 0.0)
    spoiled = changed(clean, many, np.zeros(601))
    found = closed(spoiled)
    assert found.before.problem.experiments == spoiled.experiments
    (note,) = (each for each in found.notes if "far from all their neighbours" in each)
    assert "too many to be sensor faults, so all samples were kept" in note


def test_the_same_is_set_aside_each_time(clean: Problem) -> None:
    spoiled = changed(clean, spikes(6, 1), spikes(3, 2))
    one, other = (closed(spoiled).before.problem.experiments for _ in range(2))
    assert [run.key for run in one] == [run.key for run in other]


def test_noise_that_grows_weights_each_sample_unless_a_sigma_is_given(clean: Problem) -> None:
    generator = np.random.default_rng(4)
    louder = [
        0.2 * run.outputs[0].values * generator.standard_normal(601) for run in clean.experiments
    ]
    spoiled = changed(with_outputs(clean, lambda o: replace(o, sigma=1.0)), *louder)
    found = closed(spoiled)
    (note,) = (each for each in found.notes if "grows" in each)
    outputs = [run.outputs[0] for run in found.before.problem.experiments]
    assert found.errors_over == "estimated noise"
    assert note.startswith("the noise of y grows with the signal: from the third of the samples")
    assert "so each sample was weighted with its own sigma; for a fit with" in note
    assert "write sigma.y = 0.0" in note
    for output in outputs:
        assert output.sigma == pytest.approx(0.01, rel=0.6)
        assert output.relative_sigma == pytest.approx(0.2, rel=0.2)
        assert (
            f"sigma.y = {output.sigma:.3g} and relative_sigma.y = {output.relative_sigma:.3g}"
            in note
        )
    found = closed(with_outputs(spoiled, lambda o: replace(o, sigma=0.01)))
    (note,) = (each for each in found.notes if "grows" in each)
    assert [run.outputs[0].relative_sigma for run in found.before.problem.experiments] == [0.0] * 2
    assert "relative_sigma.y = " in note
    assert "suitable values are about sigma.y = " in note


def test_noise_that_is_declared_to_grow_is_as_declared(clean: Problem) -> None:
    generator = np.random.default_rng(4)
    noise = [
        np.hypot(2e-3, 0.05 * run.outputs[0].values) * generator.standard_normal(601)
        for run in clean.experiments
    ]
    declared = {"sigma": 2e-3, "relative_sigma": 0.05}
    found = closed(with_outputs(changed(clean, *noise), lambda o: replace(o, **declared)))
    assert not [each for each in found.notes if "grows" in each]


@pytest.mark.parametrize(("answers", "count"), [(True, 0), (False, 9)])
def test_outliers_that_follow_jumps_are_answers_to_them(
    clean: Problem, answers: bool, count: int
) -> None:
    """Nine samples stand alone: all of them just after a jump of the force, or one by chance."""
    times = clean.experiments[0].outputs[0].times
    jumps = 60 * np.arange(1, 10)
    steps = 1.0 * (np.searchsorted(jumps, np.arange(601), side="right") % 2)
    runs = [
        replace(run, inputs=(replace(run.inputs[0], times=times, values=steps),))
        for run in missing_effect_problem("mass_spring_damper").experiments
    ]
    driven = measured(replace(clean, experiments=tuple(runs)), NOISE)
    off = np.zeros(601)
    off[jumps + (0 if answers else np.array([0, *range(10, 26, 2)]))] = 15.0 * NOISE
    found = closed(changed(driven, off, np.zeros(601)))
    assert 601 - len(found.before.problem.experiments[0].outputs[0].times) == count


@pytest.mark.parametrize(("answers", "count"), [(True, 0), (False, 9)])
def test_peaks_that_follow_pulses_of_an_input_are_no_outliers(
    clean: Problem, answers: bool, count: int
) -> None:
    """Nine samples stand alone: each where the force has a pulse, as a flood after rain, or not."""
    times = clean.experiments[0].outputs[0].times
    pulses = 60 * np.arange(1, 10)
    rain = np.sin(times)
    rain[pulses] += 3.0
    runs = [
        replace(run, inputs=(replace(run.inputs[0], times=times, values=rain),))
        for run in missing_effect_problem("mass_spring_damper").experiments
    ]
    driven = measured(replace(clean, experiments=tuple(runs)), NOISE)
    off = np.zeros(601)
    off[pulses + (0 if answers else np.array([*range(10, 28, 2)]))] = 15.0 * NOISE
    found = closed(changed(driven, off, np.zeros(601)))
    assert 601 - len(found.before.problem.experiments[0].outputs[0].times) == count


@pytest.mark.parametrize(
    ("sigma", "expected"),
    [pytest.param(0.5, 0.5, id="given"), pytest.param(1.0, 10.0, id="not given")],
)
def test_records_too_short_to_show_their_noise_have_the_sigma_that_is_given(
    clean: Problem, sigma: float, expected: float
) -> None:
    """Four records of nine samples in which the model leaves ten units."""
    times = np.arange(9) * 0.1
    residual = np.random.default_rng(3).standard_normal((4, 9))
    residual *= 10.0 / np.sqrt(np.mean(residual**2))
    runs = []
    for e, part in enumerate(residual):
        run = clean.experiments[0]
        (output,) = run.outputs
        values = np.interp(times, output.times, output.values) + part
        output = replace(output, times=times, values=values, sigma=sigma)
        runs.append(replace(run, id=f"e{e}", outputs=(output,)))
    fixed = tuple(replace(p, fixed=p.name != "m") for p in clean.parameters)
    problem = replace(clean, experiments=tuple(runs), parameters=fixed)
    assert detect(problem, settings=SETTINGS).noise["y"] == pytest.approx(expected, rel=0.1)
