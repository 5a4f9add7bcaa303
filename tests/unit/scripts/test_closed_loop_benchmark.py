"""The benchmark's truth is that of the FMUs plus the effect, and its cases are what they say."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from closed_loop_benchmark.data import draw_noise, make
from closed_loop_benchmark.effect import Effect, Name, names
from closed_loop_benchmark.effects import OUTSIDE, PAIRS, SINGLE, TEXTBOOK, TRIPLES
from closed_loop_benchmark.rate_forms import PARAMETER_LAWS, RATE_LAWS
from closed_loop_benchmark.scenarios import Noise, Scenario, all_scenarios, listed, singles
from closed_loop_benchmark.signal_forms import backlash, delay, hysteresis, lag, mode, rate_limit
from closed_loop_benchmark.system import Array, Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import integrate, lay_out, simulate
from fmpy.fmi2 import FMU2Slave
from scipy.signal import lsim
from support.thinning import thinned

MODELS = Path(__file__).resolve().parents[3] / "configs" / "models"

LABELLED = [(system, e) for system, effects in SINGLE.items() for e in effects]
OUTER = [(system, e) for system, effects in OUTSIDE.items() for e in effects]
BOOKS = [(system, e) for system, effects in TEXTBOOK.items() for e in effects]
TIME = np.arange(0.0, 1.0, 1e-3)
FRICTIONS = ("coulomb", "stribeck", "two_levels", "pressed_friction")


@pytest.fixture(params=thinned([(n,) for n in SYSTEMS], lambda name: SYSTEMS[name].interface))
def system(request: pytest.FixtureRequest) -> System:
    return SYSTEMS[request.param]


@pytest.fixture
def slave(system: System, tmp_path: Path) -> Iterator[Any]:
    """Give an instance of a system's FMU for co-simulation."""
    folder = fmpy.extract(str(MODELS / system.fmu), str(tmp_path))
    description = fmpy.read_model_description(folder)
    instance = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="benchmark",
    )
    instance.instantiate()
    yield instance
    instance.freeInstance()


def runs_of(system: System, seed: int = 0) -> list[Run]:
    return system.excitation(system.times, np.random.default_rng(seed))


def run_fmu(slave: Any, system: System, run: Run) -> Array:
    """Return the FMU's outputs, its inputs linear between the samples."""
    described = fmpy.read_model_description(slave.unzipDirectory).modelVariables
    known = {v.name: v.valueReference for v in described}
    starts = {**system.parameters, **system.constants, **run.starts}
    inputs, outputs = ([known[n] for n in names] for names in (system.inputs, system.outputs))
    slave.setReal([known[n] for n in starts], list(starts.values()))
    slave.setReal(inputs, run.inputs[0].tolist())
    slave.setupExperiment(startTime=0.0)
    slave.enterInitializationMode()
    slave.exitInitializationMode()
    rows = [slave.getReal(outputs)]
    slopes = np.diff(run.inputs, axis=0) / system.interval
    for n, slope in enumerate(slopes):
        slave.setReal(inputs, run.inputs[n].tolist())
        slave.setRealInputDerivatives(inputs, [1] * len(inputs), slope.tolist())
        slave.doStep(system.times[n], system.interval)
        slave.setReal(inputs, run.inputs[n + 1].tolist())
        rows.append(slave.getReal(outputs))
    return np.array(rows)


def test_truth_without_effect_is_the_fmu(system: System, slave: Any) -> None:
    runs = runs_of(system)
    for place in (1, -1):
        expected = run_fmu(slave, system, runs[place])
        slave.reset()
        (found,) = simulate(system, [runs[place]])
        error = np.abs(found - expected).max(axis=0) / expected.std(axis=0)
        assert error.max() < 1e-5


def test_excitation_has_training_and_held_out_runs(system: System) -> None:
    runs = runs_of(system)
    roles = Counter(run.role for run in runs)
    assert 4 <= roles["train"] <= 6
    assert roles["test"] == 2
    seen = {run.waveform for run in runs if run.role == "train"}
    assert all(run.waveform not in seen for run in runs if run.role == "test")
    swings = [np.ptp(run.inputs, axis=0) for run in runs if run.role == "train"]
    assert (np.max(swings, axis=0) > 1.5 * np.min(swings, axis=0)).any()
    for run in runs:
        assert run.inputs.shape == (system.samples, len(system.inputs))
        assert run.signals.shape == (system.samples, len(system.signals))
        assert set(run.starts) == set(system.states)


def test_systems_behave_for_any_seed(system: System) -> None:
    for seed in range(5):
        runs = runs_of(replace(system, samples=200), seed)
        outputs = np.concatenate(simulate(replace(system, samples=200), runs))
        assert np.isfinite(outputs).all()


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
@pytest.mark.parametrize("effects", [LABELLED, OUTER, BOOKS], ids=["inside", "outside", "books"])
def test_effects_are_visible(effects: list[tuple[str, Effect]]) -> None:
    found = [signal_to_noise(*one) for one in effects]
    assert np.isfinite(found).all()
    assert min(found) > 0.1
    assert np.mean(np.array(found) > 2.0) > 0.9


@pytest.mark.slow
def test_size_scales_an_effect() -> None:
    for name, effect in [LABELLED[0], *(one for one in LABELLED if one[1].form == "saturation")]:
        weak, strong = (signal_to_noise(name, effect.scaled(size)) for size in (0.1, 1.0))
        assert 0.0 < weak < strong


def test_friction_is_sharper_than_one_percent(system: System) -> None:
    runs = runs_of(system)
    course = lay_out(system, runs, (), ())
    values = [*system.parameters.values(), *system.constants.values()]
    states, _, _ = integrate(system, runs, (), course, values)
    for effect in (e for e in listed(system.name) if e.form in FRICTIONS):
        speed = states[:, system.states.index(effect.variable)]
        assert effect.numbers[1] < 0.005 * np.sqrt(np.mean(speed**2))


def test_names_are_canonical_first(system: System) -> None:
    for effect in (*listed(system.name), *OUTSIDE.get(system.name, ())):
        first, *_ = found = names(effect, system)
        assert (first.form, first.site) == (effect.form, effect.site)
        assert len(set(found)) == len(found)


def test_co_simulation_leaves_no_rate_to_act_on() -> None:
    for name, effect in LABELLED:
        if SYSTEMS[name].interface == "co_simulation":
            assert effect.kind in ("input", "output", "parameter")


def test_alias_of_a_bias_is_a_load() -> None:
    bias = Effect("bias", "bias", "input F", (0.6,))
    assert Name("constant", "der(v)") in names(bias, SYSTEMS["mass_spring_damper"])
    load = Effect("load", "constant", "der(v)", (0.5,))  # 0.6 N on 1.2 kg
    system, runs, _ = short("mass_spring_damper")
    np.testing.assert_allclose(
        simulate(system, runs, [bias]), simulate(system, runs, [load]), atol=1e-12
    )


def test_alias_of_a_drag_is_a_parameter() -> None:
    system, runs, _ = short("mass_spring_damper")
    drag = next(e for e in SINGLE[system.name] if e.label == "drag")
    assert Name("magnitude", "parameter c", "v") in names(drag, system)
    slope = 0.25 * system.parameters["m"] / system.parameters["c"]
    damper = Effect("damper", "magnitude", "parameter c", (slope, 0.0), "v")
    np.testing.assert_allclose(
        simulate(system, runs, [drag]), simulate(system, runs, [damper]), atol=1e-12
    )


def test_counts() -> None:
    cases = all_scenarios()
    kinds = Counter(case.kind for case in cases)
    assert len(SYSTEMS) >= 10
    assert len(LABELLED) >= 60
    assert all(len(effects) >= 6 for effects in SINGLE.values())
    assert kinds["pair"] >= 18
    assert kinds["outside"] >= 24
    assert kinds["disturbance"] >= 11
    assert kinds["clean"] >= 300
    assert kinds["single"] == 3 * len(LABELLED)
    assert len({case.name for case in cases}) == len({case.seed for case in cases}) == len(cases)
    assert {case.split for case in cases} == {"tune", "report"}
    assert set(SINGLE) == set(OUTSIDE)
    assert set(PAIRS) == set(SYSTEMS) == {*SINGLE, *TEXTBOOK}
    assert set(SINGLE).isdisjoint(TEXTBOOK)


def test_half_of_what_is_from_textbooks_is_only_reported_on() -> None:
    splits = Counter(SYSTEMS[name].split for name, _ in BOOKS)
    assert len(TEXTBOOK) >= 6
    assert len(BOOKS) >= 80
    assert splits["report"] >= splits["tune"]


def test_noise_and_combinations_are_many_enough() -> None:
    cases = all_scenarios()
    kinds = Counter(case.kind for case in cases)
    colours = Counter(case.noise.correlation > 0.0 for case in cases if case.kind == "clean")
    assert min(colours.values()) >= 100
    assert kinds["disturbance"] >= 100
    assert kinds["triple"] == sum(map(len, TRIPLES.values())) >= 15
    assert kinds["process noise"] == kinds["outliers"] >= 60


def test_effects_name_what_their_system_has(system: System) -> None:
    known = {
        "der": system.states,
        "pair": system.states,
        "input": system.inputs,
        "output": system.outputs,
        "parameter": tuple(system.parameters),
    }
    for effect in (*listed(system.name), *OUTSIDE.get(system.name, ())):
        assert set(effect.targets) <= set(known[effect.kind])
    assert set(system.unknown_starts) <= set(system.states)


def some_cases() -> list[Scenario]:
    """Return a case of each kind."""
    cases = all_scenarios()
    return [next(c for c in cases if c.kind == kind) for kind in {c.kind: None for c in cases}]


@pytest.mark.parametrize("case", thinned([(c,) for c in some_cases()], lambda _: "one"))
def test_data_are_deterministic(case: Scenario) -> None:
    first, again = make(case), make(case)
    assert first.start_parameters == again.start_parameters
    for one, other in zip(first.experiments, again.experiments, strict=True):
        np.testing.assert_array_equal(one.outputs, other.outputs)
        np.testing.assert_array_equal(one.inputs, other.inputs)
        assert one.starts == other.starts


def test_data_are_wrong_where_they_should_be() -> None:
    case = next(c for c in singles() if c.system == "room")
    data = make(case)
    for name, true in data.true_parameters.items():
        assert data.start_parameters[name] != true
        assert abs(data.start_parameters[name] / true - 1.0) <= 0.25
    for run in data.experiments:
        assert run.starts["T_room"] == run.true_starts["T_room"]
        assert run.starts["T_wall"] != run.true_starts["T_wall"]
        noise = (run.outputs - run.true_outputs) / data.sigma
        assert noise.std() == pytest.approx(1.0, rel=0.2)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8])
def test_noise_has_its_correlation(rho: float) -> None:
    wave = draw_noise((20000, 1), Noise(0.01, rho), np.random.default_rng(1))[:, 0]
    assert wave.std() == pytest.approx(1.0, rel=0.03)
    assert np.corrcoef(wave[1:], wave[:-1])[0, 1] == pytest.approx(rho, abs=0.03)


def test_one_sample_in_a_hundred_is_far_off() -> None:
    noise = Noise(0.01, outliers=0.01)
    wave = draw_noise((50000, 1), noise, np.random.default_rng(1))[:, 0]
    assert np.mean(np.abs(wave) > 5.0) == pytest.approx(0.01, rel=0.15)
    plain = draw_noise((50000, 1), Noise(0.01), np.random.default_rng(1))[:, 0]
    same = np.abs(wave) < 5.0
    np.testing.assert_array_equal(wave[same], plain[same])


def test_mode_is_an_oscillator() -> None:
    random = np.random.default_rng(3)
    signal = np.cumsum(random.normal(size=(TIME.size, 2)), axis=0)
    rate, damping = 2.0 * np.pi * 7.0, 0.3
    for column, found in zip(signal.T, mode(TIME, signal, 7.0, damping).T, strict=True):
        system = ([rate**2], [1.0, 2.0 * damping * rate, rate**2])
        _, expected, _ = lsim(system, column - column[0], TIME)
        np.testing.assert_allclose(found, column[0] + expected, atol=1e-9 * np.ptp(signal))


def test_lag_answers_a_ramp() -> None:
    ramp = TIME[:, None].copy()
    expected = TIME - 0.1 * (1.0 - np.exp(-TIME / 0.1))
    np.testing.assert_allclose(lag(TIME, ramp, 0.1)[:, 0], expected, atol=1e-12)


def test_delay_shifts() -> None:
    ramp = TIME[:, None].copy()
    expected = np.maximum(TIME - 0.25, 0.0)
    np.testing.assert_allclose(delay(TIME, ramp, 0.25)[:, 0], expected, atol=1e-12)


def test_backlash_keeps_still_when_the_signal_turns() -> None:
    signal = np.array([[0.0], [1.0], [0.9], [0.5], [0.0]])
    np.testing.assert_allclose(backlash(signal, 0.2)[:, 0], [0.0, 0.8, 0.8, 0.7, 0.2])


def test_rate_limit_holds() -> None:
    step = (TIME > 0.5)[:, None].astype(float)
    limited = rate_limit(TIME, step, 10.0)
    assert np.diff(limited[:, 0]).max() == pytest.approx(0.01)
    assert limited[-1, 0] == 1.0


def test_hysteresis_saturates() -> None:
    memory = hysteresis(TIME, np.ones((TIME.size, 1)), 0.1)[:, 0]
    np.testing.assert_allclose(memory, 1.0 - np.exp(-TIME / 0.1), atol=1e-12)


def test_laws_are_functions_of_columns() -> None:
    v = np.array([-1.0, 0.5])
    numbers = (1.0, 0.3, 0.2, 0.5)
    for law in (*RATE_LAWS.values(), *PARAMETER_LAWS.values()):
        assert np.isfinite(law(numbers, 0.1, v, v, v)).all()
