import re
from dataclasses import replace

import numpy as np
import pytest
from support.problems.seen_springs import (
    MASS_IS_KNOWN,
    example_without_outputs,
    seen_springs,
    values_of,
    with_outputs,
)
from support.problems.springs import TRUE

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.problem.search_space import make_space
from cluster_est.problem.sensors import shared_sensor
from cluster_est.running.environment import open_executor
from cluster_est.running.multistart import make_starts
from cluster_est.running.runner import Runner


def sensed(scale=3.7, offset=0.4, noise=0.001, **how):
    """Springs that one sensor sees."""

    def see(output, number):
        error = noise * np.random.default_rng(number).normal(size=len(output.times))
        values = scale * (output.values + error) + offset
        return replace(output, values=values, sigma=abs(scale) * noise, **how)

    return seen_springs(see)


def with_sensor(problem):
    sensor = shared_sensor("y", offset=True)
    parameters = (*problem.parameters, *sensor.parameters)
    return replace(problem, parameters=parameters, effects=(sensor.effect,))


@pytest.fixture(scope="module")
def fitted():
    return ce.fit(with_sensor(sensed()))


def simulated(problem, values):
    found = ce.simulate(problem, values=values)
    return np.concatenate([s.outcome.trajectory.values[:, 0] for s in found.values()])


@pytest.mark.parametrize(
    ("scale", "offset"),
    [
        (1e5, -2e4),
        (-200.0, 5.0),
        pytest.param(3.7, 0.4, marks=pytest.mark.slow),
        pytest.param(1e-6, 3e-7, marks=pytest.mark.slow),
    ],
)
def test_a_scale_of_any_size_and_sign_is_found(scale, offset):
    result = ce.fit(with_sensor(sensed(scale, offset)))
    assert result.success
    assert result.x["k"] == pytest.approx(TRUE["k"], rel=1e-3)
    assert result.x["c"] == pytest.approx(TRUE["c"], rel=5e-3)
    assert result.x["sensor_y.scale"] == pytest.approx(scale, rel=2e-3)
    assert result.x["sensor_y.offset"] == pytest.approx(offset, rel=0.02)


def test_its_scale_is_more_certain_than_one_for_each_experiment(fitted):
    own = {each.label: each for each in fitted.estimates}
    free = ce.fit(sensed(free_scale=True, free_offset=True))
    assert own["c"].std_error < {e.label: e for e in free.estimates}["c"].std_error


def test_each_start_has_its_own_best_scale_but_one_that_names_another():
    """Against least squares at each start; samples need no bounds of the sensor."""
    problem = with_sensor(sensed())
    space = make_space(problem, problem.indices("train"))
    multistart = ce.Multistart(n=5, points=({"sensor_y.scale": 3.0, "k": 25.0},), seed=3)
    with open_executor(problem, ce.Resources()) as executor:
        starts = make_starts(Runner(executor), space, multistart)
    labels = [unknown.label for unknown in space.unknowns]
    measured = np.concatenate([e.outputs[0].values for e in problem.experiments])
    assert len(starts) == 5
    for number, start in enumerate(starts):
        values = dict(zip(labels, start.tolist(), strict=True))
        values["k"] = np.exp(values["k"])
        scale, offset = values.pop("sensor_y.scale"), values.pop("sensor_y.offset")
        found = simulated(problem, values)
        best = np.linalg.lstsq(np.column_stack([found, np.ones(450)]), measured)[0]
        if number == 1:
            best = 3.0, np.mean(measured - 3.0 * found)
        assert (scale, offset) == pytest.approx(tuple(best), rel=1e-8)
    result = ce.fit(problem, multistart=ce.Multistart(n=4, screen=3, seed=3))
    assert result.x["sensor_y.scale"] == pytest.approx(3.7, rel=2e-3)


def test_values_below_a_detection_limit_are_seen_through_it():
    limited = with_outputs(
        sensed(noise=0.01),
        lambda o: replace(o, values=np.maximum(o.values, 0.45), detection_limit=0.45),
    )
    result = ce.fit(with_sensor(limited))
    assert result.x["sensor_y.scale"] == pytest.approx(3.7, rel=0.05)
    assert result.x["k"] == pytest.approx(TRUE["k"], rel=0.02)


@pytest.mark.parametrize("shared", [True, False])
def test_a_held_out_part_has_the_scale_of_its_record(shared):
    """Against the best scale and offset of the training part by least squares."""
    how = {} if shared else {"free_scale": True, "free_offset": True}
    problem = sensed(noise=0.02, **how)
    train, held_out = ce.Experiment.hold_out(problem.experiments[1], [(1.0, 1.2)])
    others = () if shared else (problem.experiments[0], problem.experiments[2])
    problem = replace(problem, experiments=(train, held_out, *others))
    result = ce.fit(with_sensor(problem) if shared else problem)
    first, second = result.simulations[:2]
    plain = ce.simulate(problem, values={name: result.x[name] for name in ("k", "c")})
    tall = []
    for simulation, experiment in zip(plain.values(), problem.experiments[:2], strict=False):
        times = experiment.outputs[0].times
        seen = simulation.outcome.trajectory.at("y", times)
        tall.append(np.column_stack([seen, np.ones(len(times))]))
    best = np.linalg.lstsq(tall[0], train.outputs[0].values)[0]
    expected = held_out.outputs[0].values - tall[1] @ best
    rows = result.table("residuals").to_pylist()
    own = [r["measured"] - r["simulated"] for r in rows if r["experiment"] == held_out.id]
    np.testing.assert_allclose(own, expected, atol=1e-6)
    (error,) = [e for e in result.errors if e.experiment == held_out.id]
    assert error.rmse_after == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-4)
    # what workers answer is the same
    residuals = second.outcome.residuals
    assert first.outcome.ok
    np.testing.assert_allclose(residuals, expected / held_out.outputs[0].sigma, atol=1e-4)


@pytest.fixture
def config(tmp_path):
    """The example without outputs of its own, in volts."""
    path = tmp_path / "volts.toml"
    path.write_text(example_without_outputs(), encoding="utf-8")
    return str(path)


VOLTS = "experiment_defaults.columns={position={factor=5.0, offset=2.5}}"


def outputs(more):
    return f"experiment_defaults.outputs={{y={{column='position', {more}}}}}"


SHARED = [outputs("free_scale='shared', free_offset='shared'"), VOLTS, *MASS_IS_KNOWN]


def test_a_config_asks_for_it(config, tmp_path):
    assert main(["fit", config, "--out", str(tmp_path / "run"), "--no-report", *SHARED]) == 0
    found = values_of(tmp_path / "run")
    assert found["sensor_y.scale"] == pytest.approx(5.0, rel=2e-3)
    assert found["sensor_y.offset"] == pytest.approx(2.5, rel=1e-3)
    assert found["k"] == pytest.approx(TRUE["k"], rel=2e-3)


def test_a_check_takes_volts_for_no_wrong_unit(config, capsys):
    main(["check", config, *SHARED])
    said = capsys.readouterr().out
    assert "a different state" not in said
    assert "seems to be in" not in said


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (outputs("free_scale='share'"), 'free_scale: must be true, false or "shared"'),
        (outputs("free_offset=1"), 'free_offset: must be .*"shared", but is 1'),
        (outputs("free_scale=true, free_offset='shared'"), "free_offset: must not .*free_scale is"),
        (
            "experiments.exp2.outputs={y={column='position', free_scale='shared'}}",
            'free_scale: must be "shared" in every experiment that has this output, or in none',
        ),
    ],
)
def test_a_mistake_is_met_with_a_sentence(given, said, config, tmp_path, capsys):
    usual = [] if given.startswith("experiment_defaults") else [outputs("weight=1.0")]
    assert main(["fit", config, "--out", str(tmp_path / "run"), *usual, given]) == 2
    error = capsys.readouterr().err
    assert re.search(said, error)
    assert "Traceback" not in error


def test_the_closed_loop_takes_it():
    problem = with_sensor(sensed(-200.0, 5.0))
    settings = ce.LoopSettings(forms=("gain",), sites=("input F",), max_effects=1)
    found = ce.close_loop(problem, settings=settings)
    values = {each.label: each.value for each in found.after.estimates}
    assert values["sensor_y.scale"] == pytest.approx(-200.0, rel=5e-3)
    assert values["k"] == pytest.approx(TRUE["k"], rel=2e-3)
