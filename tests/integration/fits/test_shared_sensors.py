"""Sensors with one scale in all experiments, and records whose parts have one."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from support.problems.springs import ROOT, TRUE, spring_problem

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.problem.effects.sensors import shared_sensor
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.environment import open_executor
from cluster_est.running.multistart import Multistart, make_starts
from cluster_est.running.runner import Runner

CONFIG = ROOT / "configs" / "mass_spring_damper.toml"


def sensed(scale, offset, noise=0.001, **how):
    """Springs that one sensor sees; mass and start positions are known."""
    truth, runs = spring_problem(3), []
    for number, experiment in enumerate(truth.problem.experiments):
        (output,) = experiment.outputs
        error = noise * np.random.default_rng(number).normal(size=len(output.times))
        values = scale * (output.values + error) + offset
        made = replace(output, values=values, sigma=abs(scale) * noise, **how)
        start = {"x": truth.values[f"x0[{experiment.id}]"]}
        runs.append(replace(experiment, outputs=(made,), values=start))
    known = tuple(
        replace(p, start=TRUE["m"], fixed=True) if p.name == "m" else p
        for p in truth.problem.parameters
    )
    return replace(truth.problem, parameters=known, experiments=tuple(runs))


def with_sensor(problem, **changes):
    sensor = shared_sensor("y", offset=True)
    given = tuple(replace(p, **changes) for p in sensor.parameters)
    return replace(problem, parameters=(*problem.parameters, *given), effects=(sensor.effect,))


@pytest.mark.parametrize(
    ("scale", "offset"), [(3.7, 0.4), (1e5, -2e4), (1e-6, 3e-7), (-200.0, 5.0)]
)
def test_a_scale_of_any_size_and_sign_is_found(scale, offset):
    result = ce.fit(with_sensor(sensed(scale, offset)))
    assert result.success
    assert result.x["k"] == pytest.approx(TRUE["k"], rel=1e-3)
    assert result.x["c"] == pytest.approx(TRUE["c"], rel=5e-3)
    assert result.x["sensor_y.scale"] == pytest.approx(scale, rel=2e-3)
    assert result.x["sensor_y.offset"] == pytest.approx(offset, rel=0.02)


def test_its_scale_is_more_certain_than_one_for_each_experiment():
    """By as much as least squares with a column for each scale says."""
    shared = ce.fit(with_sensor(sensed(3.7, 0.4)))
    own = {each.label: each for each in shared.estimates}
    tall, steps = [], {"k": 0.003, "c": 0.0003}
    problem, base = sensed(3.7, 0.4), {name: shared.x[name] for name in ("k", "c")}

    def simulated(values):
        found = ce.simulate(problem, values=values)
        return np.concatenate([s.outcome.trajectory.values[:, 0] for s in found])

    usual = simulated(base)
    for name, step in steps.items():
        moved = [simulated(base | {name: base[name] + sign * step}) for sign in (1.0, -1.0)]
        tall.append(shared.x["sensor_y.scale"] * (moved[0] - moved[1]) / (2.0 * step))
    columns = np.column_stack([*tall, usual, np.ones(len(usual))]) / 0.0037
    left = shared.fun
    variance = left @ left / (len(left) - 4)
    errors = np.sqrt(np.diag(variance * np.linalg.inv(columns.T @ columns)))
    names = ("k", "c", "sensor_y.scale", "sensor_y.offset")
    white = [i.error_white for i in shared.uncertainty.intervals]
    found = [white[list(shared.x).index(name)] for name in names]
    assert found == pytest.approx(list(errors), rel=0.01)
    free = ce.fit(sensed(3.7, 0.4, free_scale=True, free_offset=True))
    assert own["c"].std_error < {e.label: e for e in free.estimates}["c"].std_error


def test_each_start_has_its_own_best_scale_but_one_that_names_another():
    """Against least squares at each start; samples need no bounds of the sensor."""
    problem = with_sensor(sensed(3.7, 0.4))
    space = make_space(problem, problem.indices("train"))
    multistart = Multistart(n=5, points=({"sensor_y.scale": 3.0, "k": 25.0},), seed=3)
    with open_executor(problem, ce.Resources()) as executor:
        starts = make_starts(Runner(executor), space, multistart)
    labels = [unknown.label for unknown in space.unknowns]
    measured = np.concatenate([e.outputs[0].values for e in problem.experiments])
    assert len(starts) == 5
    for number, start in enumerate(starts):
        values = dict(zip(labels, start.tolist(), strict=True))
        values["k"] = np.exp(values["k"])
        scale, offset = values.pop("sensor_y.scale"), values.pop("sensor_y.offset")
        found = ce.simulate(problem, values=values)
        simulated = np.concatenate([s.outcome.trajectory.values[:, 0] for s in found])
        best = np.linalg.lstsq(np.column_stack([simulated, np.ones(450)]), measured)[0]
        if number == 1:
            best = 3.0, np.mean(measured - 3.0 * simulated)
        assert (scale, offset) == pytest.approx(tuple(best), rel=1e-8)
    result = ce.fit(problem, multistart=ce.Multistart(n=4, screen=3, seed=3))
    assert result.x["sensor_y.scale"] == pytest.approx(3.7, rel=2e-3)


def test_values_below_a_detection_limit_are_seen_through_it():
    problem = sensed(3.7, 0.4, noise=0.01)
    limited = tuple(
        replace(
            e,
            outputs=tuple(
                replace(o, values=np.maximum(o.values, 0.45), detection_limit=0.45)
                for o in e.outputs
            ),
        )
        for e in problem.experiments
    )
    result = ce.fit(with_sensor(replace(problem, experiments=limited)))
    assert result.x["sensor_y.scale"] == pytest.approx(3.7, rel=0.05)
    assert result.x["k"] == pytest.approx(TRUE["k"], rel=0.02)


@pytest.mark.parametrize("shared", [True, False])
def test_a_held_out_part_has_the_scale_of_its_record(shared):
    """Against the best scale and offset of the training part by least squares."""
    how = {} if shared else {"free_scale": True, "free_offset": True}
    problem = sensed(3.7, 0.4, noise=0.02, **how)
    train, held_out = ce.Experiment.hold_out(problem.experiments[1], [(1.0, 1.2)])
    others = () if shared else (problem.experiments[0], problem.experiments[2])
    problem = replace(problem, experiments=(train, held_out, *others))
    result = ce.fit(with_sensor(problem) if shared else problem)
    first, second = result.simulations[:2]
    plain = ce.simulate(problem, values={name: result.x[name] for name in ("k", "c")})
    tall = [
        np.column_stack([s.outcome.trajectory.at("y", e.outputs[0].times), ones(e)])
        for s, e in zip(plain, problem.experiments[:2], strict=False)
    ]
    best = np.linalg.lstsq(tall[0], train.outputs[0].values)[0]
    expected = held_out.outputs[0].values - tall[1] @ best
    rows = result.residuals.to_pylist()
    own = [r["measured"] - r["simulated"] for r in rows if r["experiment"] == held_out.id]
    np.testing.assert_allclose(own, expected, atol=1e-6)
    (error,) = [e for e in result.errors if e.experiment == held_out.id]
    assert error.rmse_after == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-4)
    # what workers answer is the same
    residuals = second.outcome.residuals
    assert first.outcome.ok
    np.testing.assert_allclose(residuals, expected / held_out.outputs[0].sigma, atol=1e-4)


def ones(experiment):
    return np.ones(len(experiment.outputs[0].times))


@pytest.fixture
def config(tmp_path):
    """The example without outputs of its own, in volts."""
    text = CONFIG.read_text(encoding="utf-8")
    kept = [line for line in text.splitlines() if not line.startswith("outputs")]
    configs = f'"{ROOT.as_posix()}/configs/'
    text = "\n".join(kept).replace('"models/', f"{configs}models/")
    text = text.replace('"data/', f"{configs}data/")
    (tmp_path / "volts.toml").write_text(text, encoding="utf-8")
    return tmp_path


KNOWN = ["parameters.m.fixed=true", "parameters.m.start=1.2"]
VOLTS = "experiment_defaults.columns={position={factor=5.0, offset=2.5}}"


def outputs(more):
    return f"experiment_defaults.outputs={{y={{column='position', {more}}}}}"


SHARED = outputs("free_scale='shared', free_offset='shared'")


@pytest.mark.parametrize("executor", ["local", "processes"])
def test_a_config_asks_for_it_and_a_run_that_is_taken_up_again_has_the_same_bits(config, executor):
    run = config / executor
    given = [SHARED, VOLTS, *KNOWN, f"executor.name={executor}", "executor.workers=2"]
    given = given if executor == "processes" else given[:-1]
    file = str(config / "volts.toml")
    assert main(["fit", file, "--out", str(run), *given]) == 0
    first = values_of(run)
    assert first["sensor_y.scale"] == pytest.approx(5.0, rel=2e-3)
    assert first["sensor_y.offset"] == pytest.approx(2.5, rel=1e-3)
    assert first["k"] == pytest.approx(TRUE["k"], rel=2e-3)
    facts = json.loads((run / "run.json").read_text(encoding="utf-8"))
    facts |= {"status": "running", "verdict": None}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    assert main(["fit", file, "--out", str(run), "--resume", *given]) == 0
    assert values_of(run) == first
    if executor == "processes":
        other = config / "other"
        assert main(["fit", file, "--out", str(other), SHARED, VOLTS, *KNOWN]) == 0
        assert values_of(other) == first


def values_of(run):
    rows = pq.read_table(run / "parameters.parquet").to_pylist()
    return {row["label"]: row["value"] for row in rows}


def test_a_check_takes_volts_for_no_wrong_unit(config, capsys):
    main(["check", str(config / "volts.toml"), SHARED, VOLTS, *KNOWN])
    said = capsys.readouterr().out
    assert "begin elsewhere" not in said
    assert "seems to be in" not in said


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (outputs("free_scale='share'"), 'free_scale: must be true, false or "shared" but is'),
        (outputs("free_offset=1"), 'free_offset: must be true, false or "shared" but is 1'),
        (
            outputs("free_scale=true, free_offset='shared'"),
            'free_offset: must not be "shared" where free_scale is true',
        ),
        (
            "experiments.exp2.outputs={y={column='position', free_scale='shared'}}",
            'free_scale: must be "shared" in all experiments with this output, or in none',
        ),
    ],
)
def test_a_mistake_is_met_with_a_sentence(given, said, config, capsys):
    usual = [] if given.startswith("experiment_defaults") else [outputs("weight=1.0")]
    out = str(config / "run")
    assert main(["fit", str(config / "volts.toml"), "--out", out, *usual, given]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


def test_the_closed_loop_takes_it():
    problem = with_sensor(sensed(-200.0, 5.0))
    settings = ce.LoopSettings(forms=("gain",), sites=("input F",), max_effects=1)
    found = ce.close_loop(problem, settings=settings)
    values = {each.label: each.value for each in found.after.estimates}
    assert values["sensor_y.scale"] == pytest.approx(-200.0, rel=5e-3)
    assert values["k"] == pytest.approx(TRUE["k"], rel=2e-3)
