"""Measured signals that a model has no input for: the sun on a room, against SciPy."""

import json
import re
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.integrate import solve_ivp
from support.problems.driven_spring import model_of
from support.problems.springs import ROOT
from support.simulated import answers
from support.simulated import simulated as one_simulation

from cluster_est.cli import main
from workers.errors import EffectError
from workers.messages import Effect, Experiment, Input, Output, Solver, Task

FMU = ROOT / "configs" / "models" / "room.fmu"
C_ROOM, C_WALL, R_ROOM, R_WALL = 4e6, 3e7, 4e-3, 8e-3
TIMES = np.arange(241) * 600.0
HEATING = 1500.0 + 1000.0 * np.sin(TIMES / 9000.0)
OUTDOORS = 5.0 + 4.0 * np.sin(TIMES / 14000.0)
SUN = 400.0 * np.maximum(np.sin(TIMES / 13750.0), 0.0)
GAIN, KNOWN = 3e-7, ("R_room_wall",)
EXACT = Solver("dormand_prince", rtol=1e-10)
ROOM = model_of(EXACT, KNOWN, FMU)
CO_SIMULATION = Solver("fmu", step=20.0)  # in which a parameter is held


def solved(warming=lambda sun: 0.0, power=lambda p, sun: p, resistance=lambda sun: R_ROOM):
    """The room's temperature; from sample to sample, so that no kink is stepped across."""
    x, found = np.array([20.0, 15.0]), [20.0]
    for i in range(len(TIMES) - 1):

        def slope(t, x, i=i):
            p, out, sun = (
                np.interp(t, TIMES[i : i + 2], u[i : i + 2]) for u in (HEATING, OUTDOORS, SUN)
            )
            inner = (x[0] - x[1]) / resistance(sun)
            outer = (x[1] - out) / R_WALL
            return [(power(p, sun) - inner) / C_ROOM + warming(sun), (inner - outer) / C_WALL]

        x = solve_ivp(slope, TIMES[i : i + 2], x, rtol=1e-10, atol=1e-10).y[:, -1]
        found.append(x[0])
    return np.array(found)


BASE = solved()


SIGNALS = (Input("sun", TIMES, SUN),)


def experiment(signals=SIGNALS):
    inputs = (Input("P", TIMES, HEATING), Input("T_out", TIMES, OUTDOORS))
    output = Output("y", TIMES, np.zeros(len(TIMES)))
    values = (("C_room", C_ROOM), ("C_wall", C_WALL), ("R_wall_out", R_WALL))
    values += (("T_room", 20.0), ("T_wall", 15.0))
    return Experiment("e", 0.0, float(TIMES[-1]), inputs, (output,), values, signals=signals)


def simulated(effects, coefficients, solver, run=None):
    of, run = model_of(solver, KNOWN, FMU), run or experiment()
    found = one_simulation(of, run, (R_ROOM, *coefficients), effects)
    return found[:, 0]


@pytest.mark.parametrize("solver", [EXACT, Solver("rk4", step=60.0)])
def test_a_signal_at_a_state_derivative(solver):
    effect = Effect("sun", "der(T_room)", "linear", ("sun",))
    truth = solved(warming=lambda sun: GAIN * sun)
    assert np.abs(truth - BASE).max() > 1.0
    np.testing.assert_allclose(simulated([effect], (GAIN,), solver), truth, atol=1e-6)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
def test_a_signal_at_an_input_an_output_and_a_parameter(solver):
    bar = 1e-6 if solver is EXACT else 1e-3
    scale = Effect("e", "input P", "product", ("sun",))
    truth = solved(power=lambda p, sun: p * (1.0 + 1e-3 * sun))
    np.testing.assert_allclose(simulated([scale], (1e-3,), solver), truth, atol=bar)
    sensor = Effect("e", "output y", "feed_through", ("sun",))
    truth = BASE + 5e-3 * SUN
    np.testing.assert_allclose(simulated([sensor], (5e-3,), solver), truth, atol=1e-4)
    draught = Effect("e", "parameter R_room_wall", "linear", ("sun",))
    truth = solved(resistance=lambda sun: R_ROOM * (1.0 + 1e-3 * (sun - 100.0)))
    np.testing.assert_allclose(simulated([draught], (1e-3, 100.0), solver), truth, atol=bar)


@pytest.mark.parametrize("solver", [EXACT, CO_SIMULATION])
def test_a_signal_that_nothing_depends_on_changes_no_bit(solver):
    without = replace(experiment(), signals=())
    plain = simulated([], (), solver, without)
    assert simulated([], (), solver).tobytes() == plain.tobytes()
    effect = Effect("e", "input P", "gain")
    bent = simulated([effect], (0.1,), solver, without)
    assert simulated([effect], (0.1,), solver).tobytes() == bent.tobytes()


def test_a_difference_with_a_signal_and_an_own_equation():
    truth = solved(warming=lambda sun: GAIN * (sun - 50.0))
    own = Effect("own", "der(T_room)", equation="a * (sun - 50)", coefficients=(("a", 0.0),))
    np.testing.assert_allclose(simulated([own], (GAIN,), EXACT), truth, atol=1e-6)
    shift = Input("shift", TIMES[[0, -1]], np.array([50.0, 50.0]), "hold")
    run = experiment((shift, Input("sun", TIMES, SUN)))
    effect = Effect("e", "der(T_room)", "linear", ("sun - shift",))
    np.testing.assert_allclose(simulated([effect], (GAIN,), EXACT, run), truth, atol=1e-6)


def test_points_in_a_batch_give_what_each_gives_alone():
    """One parameter and several known values, which NumPy would lay out column by column."""
    effect = Effect("e", "der(T_room)", "linear", ("sun",))
    for effects, size in (((), 1), ((effect,), 2)):
        points = [np.array([r, GAIN])[:size] for r in (0.003, 0.004, 0.005)]
        tasks = [Task(i, 0, p, "residuals", effects) for i, p in enumerate(points)]
        together = answers(ROOM, [experiment()], tasks)
        for task, outcome in zip(tasks, together, strict=True):
            (alone,) = answers(ROOM, [experiment()], [task])
            assert outcome.residuals.tobytes() == alone.residuals.tobytes()


def test_signals_are_part_of_an_experiments_key_where_there_are_any():
    run = experiment()
    without = replace(run, signals=())
    bare = Experiment(run.id, run.start, run.stop, run.inputs, run.outputs, run.values)
    assert without.key == bare.key != run.key


def test_an_experiment_without_the_signal_is_refused():
    dark = replace(experiment(()), id="dark")
    effect = Effect("e", "der(T_room)", "linear", ("sun",))
    task = Task(0, 1, np.array([R_ROOM, GAIN]), "trajectory", (effect,))
    with pytest.raises(EffectError, match=r"'dark'.*signal 'sun'"):
        answers(ROOM, [experiment(), dark], [task])


CONFIG = """
[model]
fmu = {fmu}
[values]
C_room = 4e6
C_wall = 3e7
R_wall_out = 8e-3
[parameters]
R_room_wall = {{ start = 3e-3, bounds = [1e-3, 1e-1], scale = "log" }}
[[effects]]
name = "sun"
site = "der(T_room)"
form = "linear"
variables = ["sun"]
parameters = {{ k = {{ start = 1e-7, bounds = [0.0, 1e-5] }} }}
[[experiments]]
id = "run"
data = "run.csv"
time = "t"
inputs = {{ P = "heating", T_out = "outdoors" }}
signals = {{ sun = "sunshine" }}
outputs = {{ y = "room" }}
"""


DARK = """
[[experiments]]
id = "dark"
data = "run.csv"
time = "t"
inputs = { P = "heating", T_out = "outdoors" }
outputs = { y = "room" }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With what the config reads."""
    made = tmp_path_factory.mktemp("sun")
    measured = solved(warming=lambda sun: GAIN * sun)
    columns = np.column_stack([TIMES, HEATING, OUTDOORS, SUN, measured])
    head = "t,heating,outdoors,sunshine,room"
    np.savetxt(made / "run.csv", columns, "%.17g", ",", header=head, comments="")
    return made


def written(folder, old="", new=""):
    path = folder / "config.toml"
    path.write_text(CONFIG.format(fmu=json.dumps(str(FMU))).replace(old, new))
    return str(path)


@pytest.mark.slow
def test_the_sun_is_fitted_from_a_config(folder):
    assert main(["fit", written(folder), "--out", str(folder / "run"), "--no-report"]) == 0
    rows = pq.read_table(folder / "run" / "parameters.parquet").to_pylist()
    found = {row["label"]: row["value"] for row in rows if row["estimated_on"] == "train"}
    assert found == pytest.approx({"R_room_wall": R_ROOM, "sun.k": GAIN}, rel=1e-5)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('["sun"]', '["son"]', "'son'.*did you mean 'sun'"),
        ("{ sun =", "{ T_wall =", "T_wall.*must not be.*variable of room.fmu"),
        ("{ sun =", "{ t =", "t: must not be named t or s"),
        ("sunshine", "sunshin", "'sunshin'.*did you mean 'sunshine'"),
        ('= "sunshine"', "= 3", "must be the name of a column"),
        ("signals =", "signal =", "did you mean"),
        ('outputs = { y = "room" }', f'outputs = {{ y = "room" }}{DARK}', "'dark'.*must.*'sun'"),
    ],
)
def test_a_wrong_signal_is_one_sentence(folder, capsys, old, new, said):
    assert main(["check", written(folder, old, new)]) == 2
    error = capsys.readouterr().err
    assert re.search(said, error)
    assert "Traceback" not in error
