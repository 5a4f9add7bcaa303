"""Cases of hidden dynamics: their models, their truth without the effect, and how they divide."""

import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop_benchmark.hidden_dynamics import (
    CLASSES,
    HIDDEN,
    WITHOUT,
    cases_of,
    hidden_cases,
    hidden_data,
    hidden_problem,
)
from closed_loop_benchmark.hidden_systems import HIDDEN_SYSTEMS, archive
from closed_loop_benchmark.hidden_truth import Hidden, follow
from closed_loop_benchmark.system import Run, System
from closed_loop_benchmark.systems import SYSTEMS
from closed_loop_benchmark.truth import simulate
from fmpy import extract
from support.exported import NEEDS_CC, output_of

SAMPLES = 40


def short(name: str) -> tuple[System, list[Run]]:
    whole = HIDDEN_SYSTEMS[name]
    runs = whole.excitation(whole.times, np.random.default_rng(0))
    system = replace(whole, samples=SAMPLES)
    return system, [replace(run, inputs=run.inputs[:SAMPLES]) for run in runs]


@NEEDS_CC
@pytest.mark.parametrize("name", HIDDEN_SYSTEMS)
def test_truth_with_nothing_hidden_is_the_fmu(name, tmp_path):
    system, runs = short(name)
    (tmp_path / "model.fmu").write_bytes(archive(name))
    folder = Path(extract(str(tmp_path / "model.fmu"), str(tmp_path / "folder")))
    run, found = runs[1], follow(system, runs)[1]
    inputs = dict(zip(system.inputs, run.inputs.T, strict=True))
    given = {**system.parameters, **system.constants, **run.starts}
    columns = [output_of(folder, system.times, inputs, output, given) for output in system.outputs]
    expected = np.column_stack(columns)
    assert (np.abs(found - expected).max(axis=0) / expected.std(axis=0)).max() < 1e-4


@pytest.mark.parametrize("case", hidden_cases(), ids=lambda case: case.name)
def test_an_effect_of_no_share_leaves_the_declared_model(case):
    system, _ = short(case.system)
    data = hidden_data(case, SAMPLES, share=0.0)
    runs = [Run(e.waveform, e.role, e.inputs, e.true_starts, e.signals) for e in data.experiments]
    for run, expected in zip(data.experiments, simulate(system, runs), strict=True):
        assert np.abs(run.true_outputs - expected).max() < 1e-5 * np.abs(expected).max()


def test_a_store_and_a_delay_answer_as_by_hand():
    system, (run, *_) = short("infusion")
    run = replace(run, inputs=np.zeros_like(run.inputs), starts={"A": 10.0})
    slow = replace(system, parameters={"CL": 1e-12, "V_d": 1.0})
    times, tau = system.times, 700.0
    emptying = Hidden({"tau": tau}, states={"z": ("-z / tau", "5")}, rates={"A": "z / tau"})
    (found,) = follow(slow, [run], emptying)
    np.testing.assert_allclose(found[:, 0], 15.0 - 5.0 * np.exp(-times / tau), rtol=1e-6)
    late = Hidden({"k": 1e-4}, late={"before": ("A", "700")}, rates={"A": "k * before"})
    (found,) = follow(slow, [run], late)
    after = np.maximum(times - 700.0, 0.0)
    expected = 10.0 * (1.0 + 1e-4 * times + 0.5 * (1e-4 * after) ** 2)
    np.testing.assert_allclose(found[:5, 0], expected[:5], rtol=1e-6)  # before twice the delay


def test_there_are_sixty_cases_on_new_systems_each_half_open():
    cases, others = hidden_cases(), cases_of(WITHOUT)
    assert not {*HIDDEN_SYSTEMS} & {*SYSTEMS}
    classes = Counter(case.name.split("/")[2] for case in cases)
    assert set(classes) == set(CLASSES)
    assert classes["store"] == 20
    assert set(classes.values()) == {10, 20}
    labels = Counter(case.name.split("/")[2] for case in others)
    assert labels == {"clean": 100, "coloured": 100, "disturbed": 100}
    for own in (cases, others):
        halves = Counter((case.name.split("/")[2], case.split) for case in own)
        assert all(halves[name, "tune"] == halves[name, "report"] for name, _ in halves)
    assert len({case.seed for case in (*cases, *others)}) == 360


def test_the_cases_that_are_held_back_stay_the_same():
    held = sorted(case.name for case in cases_of(HIDDEN) if case.split == "report")
    assert zlib.crc32("\n".join(held).encode()) == 3769432128


def test_data_are_deterministic_and_a_push_acts():
    case = next(case for case in cases_of(WITHOUT) if case.disturbance is not None)
    data, again = (hidden_data(case, SAMPLES) for _ in range(2))
    calm = hidden_data(replace(case, disturbance=None), SAMPLES)
    for run, other, still in zip(
        data.experiments, again.experiments, calm.experiments, strict=True
    ):
        np.testing.assert_array_equal(run.outputs, other.outputs)
        np.testing.assert_array_equal(run.inputs, still.inputs)
    assert any(
        np.abs(run.true_outputs - still.true_outputs).max() > data.sigma.max()
        for run, still in zip(data.experiments, calm.experiments, strict=True)
    )


@NEEDS_CC
def test_a_problem_has_the_noise_of_its_case_and_names_no_effect():
    case = hidden_cases()[0]
    problem, data = hidden_problem(case)
    assert problem.effects == ()
    assert [run.role for run in problem.experiments] == ["train"] * 4 + ["test"] * 2
    for run in data.experiments:
        noise = (run.outputs - run.true_outputs) / data.sigma
        assert noise.std() == pytest.approx(1.0, rel=0.2)
