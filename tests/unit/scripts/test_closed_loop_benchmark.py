from collections import Counter
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest
from closed_loop_benchmark.data import OWN, Sampling, draw_noise, make
from closed_loop_benchmark.effect import (
    OUTSIDE,
    PAIRS,
    SINGLE,
    TEXTBOOK,
    TRIPLES,
    Effect,
    Name,
    names,
)
from closed_loop_benchmark.forms import backlash, delay, hysteresis, lag, mode, rate_limit
from closed_loop_benchmark.scenarios import Noise, ablation_cases, all_scenarios, singles
from closed_loop_benchmark.single_records import one_record, single_records
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import simulate
from fmpy import extract
from scipy.signal import lsim
from support.exported import output_of
from support.thinning import thinned

MODELS = Path(__file__).resolve().parents[3] / "configs" / "models"
TIME = np.arange(0.0, 1.0, 1e-3)


@pytest.fixture(params=thinned([(n,) for n in SYSTEMS], lambda name: SYSTEMS[name].interface))
def system(request: pytest.FixtureRequest) -> System:
    return SYSTEMS[request.param]


def runs_of(system: System) -> list[Run]:
    return system.excitation(system.times, np.random.default_rng(0))


def by_the_fmu(folder: Path, system: System, run: Run) -> Array:
    """Return the FMU's outputs by fmpy, its inputs linear between the samples."""
    inputs = dict(zip(system.inputs, run.inputs.T, strict=True))
    given = {**system.parameters, **system.constants, **run.starts}
    columns = [output_of(folder, system.times, inputs, name, given) for name in system.outputs]
    return np.column_stack(columns)


def test_truth_without_effect_is_the_fmu(system, tmp_path):
    folder, runs = Path(extract(str(MODELS / system.fmu), str(tmp_path))), runs_of(system)
    for run in (runs[1], runs[-1]):
        expected = by_the_fmu(folder, system, run)
        (found,) = simulate(system, [run])
        error = np.abs(found - expected).max(axis=0) / expected.std(axis=0)
        assert error.max() < 1e-5


def test_excitation_has_training_and_held_out_runs(system):
    runs = runs_of(system)
    roles = Counter(run.role for run in runs)
    assert 4 <= roles["train"] <= 6
    assert roles["test"] == 2
    seen = {run.waveform for run in runs if run.role == "train"}
    assert all(run.waveform not in seen for run in runs if run.role == "test")
    swings = [np.ptp(run.inputs, axis=0) for run in runs if run.role == "train"]
    assert (np.max(swings, axis=0) > 1.5 * np.min(swings, axis=0)).any()


@cache
def short(name: str) -> tuple[System, tuple[Run, ...], Array]:
    """Return a system with fewer samples, its runs and its outputs without effect."""
    system = replace(SYSTEMS[name], samples=200, substeps=2)
    runs = tuple(runs_of(system))
    return system, runs, np.stack(simulate(system, runs))


def signal_to_noise(name: str, effect: Effect) -> float:
    """Return the rms of what an effect changes, in units of 1 % of the outputs' deviation."""
    system, runs, without = short(name)
    change = np.stack(simulate(system, runs, [effect])) - without
    deviation = 0.01 * without.std(axis=(0, 1))
    return float(np.sqrt(np.mean((change / deviation) ** 2)))


@pytest.mark.slow
@pytest.mark.parametrize("effects", [SINGLE, OUTSIDE, TEXTBOOK], ids=["inside", "outside", "books"])
def test_effects_are_visible(effects):
    found = [signal_to_noise(system, e) for system, listed in effects.items() for e in listed]
    assert np.isfinite(found).all()
    assert min(found) > 0.1
    assert np.mean(np.array(found) > 2.0) > 0.9


SPRING = SYSTEMS["mass_spring_damper"]
DRAG = next(e for e in SINGLE[SPRING.name] if e.label == "drag")
SLOPE = 0.25 * SPRING.parameters["m"] / SPRING.parameters["c"]


@pytest.mark.parametrize(
    ("effect", "name", "same"),
    [
        (  # 0.6 N on 1.2 kg
            Effect("bias", "bias", "input F", (0.6,)),
            Name("constant", "der(v)"),
            Effect("load", "constant", "der(v)", (0.5,)),
        ),
        (
            DRAG,
            Name("magnitude", "parameter c", "v"),
            Effect("damper", "magnitude", "parameter c", (SLOPE, 0.0), "v"),
        ),
    ],
    ids=["bias", "drag"],
)
def test_another_name_of_an_effect_is_the_same_model(effect, name, same):
    assert name in names(effect, SPRING)
    system, runs, _ = short(SPRING.name)
    found, expected = (simulate(system, runs, [each]) for each in (effect, same))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_there_are_cases_of_each_kind_on_every_system_each_with_a_seed_of_its_own():
    cases = all_scenarios()
    kinds = Counter(case.kind for case in cases)
    assert set(PAIRS) == set(SYSTEMS) == {*SINGLE, *TEXTBOOK}
    assert kinds["single"] == 3 * sum(map(len, SINGLE.values())) >= 180
    assert kinds["clean"] >= 300
    assert min(kinds.values()) >= 15
    assert len({case.name for case in cases}) == len({case.seed for case in cases}) == len(cases)
    assert {case.split for case in cases} == {"tune", "report"}


def test_drawn_cases_are_new_and_each_of_their_effects_is_another_model():
    listed, cases = {case.name for case in all_scenarios()}, ablation_cases()
    assert [case.name for case in cases] == [case.name for case in ablation_cases()]
    assert len({case.name for case in cases}) == len(cases)
    counts = Counter(case.kind for case in cases)
    assert counts["pair"] >= 100
    assert counts["triple"] >= 50
    assert {case.split for case in cases} == {"tune"}
    for case in (case for case in cases if case.name not in listed):
        assert case.kind in ("pair", "triple")
        assert [e.label for e in case.effects] not in (PAIRS | TRIPLES)[case.system]
        accepted = [name for own in case.accepted for name in own]
        assert len(set(accepted)) == len(accepted)
    first = cases[:66]
    assert {case.kind for case in first} == set(counts)
    assert {case.system for case in first} == {case.system for case in cases}


def test_data_are_deterministic_and_wrong_where_they_should_be():
    case = next(c for c in singles() if c.system == "room")
    data, again = make(case), make(case)
    for name, true in data.true_parameters.items():
        assert data.start_parameters[name] == again.start_parameters[name] != true
        assert abs(data.start_parameters[name] / true - 1.0) <= 0.25
    for run, other in zip(data.experiments, again.experiments, strict=True):
        np.testing.assert_array_equal(run.outputs, other.outputs)
        assert run.starts == other.starts
        assert run.starts["T_room"] == run.true_starts["T_room"]
        assert run.starts["T_wall"] != run.true_starts["T_wall"]
        noise = (run.outputs - run.true_outputs) / data.sigma
        assert noise.std() == pytest.approx(1.0, rel=0.2)


def test_a_faster_logger_samples_the_same_course_in_as_much_noise_in_all():
    case = next(c for c in singles() if c.system == "pendulum")
    slow, fast, uneven = (make(case, each) for each in (OWN, Sampling(10), Sampling(10, 0.3)))
    np.testing.assert_allclose(fast.sigma, np.sqrt(10.0) * slow.sigma, rtol=0.01)
    assert fast.start_parameters == slow.start_parameters
    for run, few, other in zip(fast.experiments, slow.experiments, uneven.experiments, strict=True):
        np.testing.assert_allclose(run.true_outputs[::10], few.true_outputs, atol=1e-6)
        np.testing.assert_allclose(run.inputs[::10], few.inputs, atol=1e-12)
        expected = np.interp(uneven.times, fast.times, run.true_outputs[:, 0])
        np.testing.assert_allclose(other.true_outputs[:, 0], expected, atol=1e-3)
    steps = np.diff(uneven.times) / np.diff(fast.times)
    assert 0.3 < steps.min() < 0.7
    assert 1.3 < steps.max() < 1.7


@pytest.mark.parametrize(
    ("correlation", "outliers"), [(0.0, 0.0), (0.8, 0.0), (0.0, 0.01)], ids=str
)
def test_noise_has_its_correlation_and_its_outliers(correlation, outliers):
    noise = Noise(0.01, correlation, outliers)
    wave = draw_noise((50000, 1), noise, np.random.default_rng(1))[:, 0]
    usual = np.abs(wave) < 5.0
    assert np.mean(~usual) == pytest.approx(outliers, rel=0.15)
    assert wave[usual].std() == pytest.approx(1.0, rel=0.03)
    both = usual[1:] & usual[:-1]
    found = np.corrcoef(wave[1:][both], wave[:-1][both])[0, 1]
    assert found == pytest.approx(correlation, abs=0.03)


def test_mode_is_an_oscillator():
    signal = np.cumsum(np.random.default_rng(3).normal(size=TIME.size))
    rate, damping = 2.0 * np.pi * 7.0, 0.3
    system = ([rate**2], [1.0, 2.0 * damping * rate, rate**2])
    _, expected, _ = lsim(system, signal - signal[0], TIME)
    found = mode(TIME, signal[:, None], 7.0, damping)[:, 0]
    np.testing.assert_allclose(found, signal[0] + expected, atol=1e-9 * np.ptp(signal))


@pytest.mark.parametrize(
    ("form", "signal", "expected"),
    [
        (partial(lag, TIME), TIME, TIME - 0.1 * (1.0 - np.exp(-TIME / 0.1))),
        (partial(delay, TIME), TIME, np.maximum(TIME - 0.1, 0.0)),
        (partial(hysteresis, TIME), np.ones(TIME.size), 1.0 - np.exp(-TIME / 0.1)),
        (partial(rate_limit, TIME), (TIME > 0.0) * 1.0, 0.1 * TIME),
        (backlash, np.array([0.0, 1.0, 0.9, 0.5, 0.0]), [0.0, 0.9, 0.9, 0.6, 0.1]),
    ],
    ids=["lag", "delay", "hysteresis", "rate limit", "backlash"],
)
def test_a_form_with_memory_answers_a_simple_signal(form, signal, expected):
    found = form(signal[:, None], 0.1)
    np.testing.assert_allclose(found[:, 0], expected, atol=1e-12)


def test_a_single_record_is_long_and_its_last_third_is_held_out():
    cases = single_records()
    assert len({case.name for case in cases}) == len(cases) == 60
    problem, data = one_record(cases[0])
    _, test = problem.experiments
    assert [run.role for run in problem.experiments] == ["train", "test"]
    assert 1000 <= len(data.times) <= 5000
    assert len(test.outputs[0].times) == pytest.approx(len(data.times) / 3, abs=1)
    starts = [each for each in problem.parameters if each.per == "experiment"]
    assert {each.variable for each in starts} == set(data.system.states)
    true = data.experiments[0].true_starts
    assert all(each.start != true[each.variable] for each in starts)
    assert all(each.lower < true[each.variable] < each.upper for each in starts)
