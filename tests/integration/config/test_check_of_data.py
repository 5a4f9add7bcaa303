import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import StateSpace, lsim
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.preflight.all_checks import run_checks
from cluster_est.problem.tables.sources import TableSource
from workers.process.trial import BenchHere

MODELS = ROOT / "configs" / "models"
MINUTE = 60.0
slow = pytest.mark.slow
RPM = 30.0 / np.pi
TIMES = np.arange(401) * 0.005
VOLTS = np.where(TIMES < 0.1, 0.0, np.where(TIMES < 1.0, 6.0, 9.0))
STARTS = {
    "dc_motor": {"R": 1.0, "K": 0.05, "J": 0.0005},
    "pendulum": {"J": 0.1, "G": 2.0, "b": 0.04},
    "thermal_two_node": {"C_core": 60.0, "C_case": 200.0},
}
R, L, K, J, B = 1.0, 0.01, 0.06, 5e-4, 2e-4
"""Of the motor that was measured; its K is not that of the FMU."""


def motor():
    """The DC motor's current and speed, exactly, with the voltage held between samples."""
    system = StateSpace([[-R / L, -K / L], [K / J, -B / J]], [[1 / L], [0]], np.eye(2), [[0]] * 2)
    current, speed = lsim(system, VOLTS, TIMES, interp=False)[2].T
    return {"t": TIMES, "V": VOLTS, "i": current, "w": speed}


TRUTH = motor()
HELD = {"V": {"column": "V", "interpolation": "hold"}}


def run(columns, **changes):
    given = {"id": "run", "time": "t", "inputs": {"V": "V"}}
    given |= {"outputs": {"current": "i", "speed": "w"}}
    return ce.Experiment.from_table(dict(columns), **(given | changes))  # type: ignore[arg-type]


def swing(times, angle, start):
    columns = {"t": times, "a": angle, "m": 0.0 * times}
    how = {"inputs": {"torque": "m"}, "outputs": {"y": "a"}, "values": {"angle": start}}
    return run(columns, **how)


def heated(times, values):
    columns = {"t": times, "P": 3.0 + 0.0 * times, "T": values}
    return run(columns, inputs={"P": "P"}, outputs={"y_core": "T"})


def problem(*runs):
    """A problem with the model that has the outputs of the runs."""
    outputs = {"current": "dc_motor", "speed": "dc_motor", "y": "pendulum"}
    fmu = outputs.get(runs[0].outputs[0].variable, "thermal_two_node")
    starts = STARTS[fmu]
    model = ce.read_model(MODELS / f"{fmu}.fmu")
    few = replace(model.solver, max_steps=1000)  # what is read as much longer ends at once
    model = replace(model, solver=few)
    return ce.Problem(model, [ce.Parameter(*each) for each in starts.items()], list(runs))


def findings(given, check=""):
    """Those of one check; without a name all that are not ok."""
    page = run_checks(given, ce.Resources(), MINUTE, open_bench=BenchHere)
    return [f for f in page.findings if (f.check == check if check else f.verdict != "ok")]


def spikes(size):
    """Two samples that stand alone."""
    return np.where(np.isin(np.arange(401), [150, 300]), size, 0.0)


REST = {"t": TIMES, "V": 0.0 * TIMES}
COASTING = run(REST | {"w": 80.0 * np.exp(-2.0 * TIMES)}, outputs={"speed": "w"})
SLOW = np.arange(200) * 10.0
RISE = 25.0 + 5.0 * (1.0 - np.exp(-SLOW / 600.0))
LONG, RECORD = np.arange(2500) * 0.016, np.arange(4000) * 30.0
DEGREES = np.rad2deg(0.4 * np.cos(np.sqrt(20.0) * TIMES) * np.exp(-0.2 * TIMES))


def missing(places):
    volts = VOLTS.copy()
    volts[places] = np.nan
    return volts


def rounded(sigma):
    """An encoder of 256 lines, and a sigma that was taken from its data sheet."""
    return run(TRUTH | {"w": np.round(TRUTH["w"] / 0.25) * 0.25}, sigma={"speed": sigma})


@pytest.mark.parametrize(
    ("experiment", "check", "found", "do"),
    [
        (
            run(TRUTH | {"w": TRUTH["w"] * RPM}),
            "unit of speed",
            "times as large as the simulated.*1 rad/s is 9.549 rpm.*seems to be in rpm",
            "columns.COLUMN = { factor = 0.104719755",
        ),
        (swing(TIMES, DEGREES, 0.4), "unit of y", "1 rad is 57.3 deg.*seems to be in deg", ""),
        (
            heated(SLOW, RISE + 273.15),
            "unit of y_core",
            "K and degC differ by as much.*seems to be in K",
            "columns.COLUMN = { factor = 1, offset = -273.15 }",
        ),
        (
            run(TRUTH | {"V": VOLTS * 1e3}),
            "unit of V",
            "seems to be in mV.*uses V.*of the outputs' spread, instead of",
            "",
        ),
        *(
            pytest.param(
                run(TRUTH | {"t": TIMES * factor}),
                "time",
                f"seem to be in {unit}, but are read as seconds.* {2.0 * factor:.4g} s",
                f"columns.COLUMN = {{ factor = {1.0 / factor:g} }}, .* sample_time",
                marks=marks,
            )
            for unit, factor, marks in (("milliseconds", 1e3, slow), ("minutes", 1.0 / 60.0, ()))
        ),
        pytest.param(  # twenty periods, whose frequency is off by a tenth at the start values
            swing(LONG * 1e3, 0.3 * np.cos(1.1 * np.sqrt(20.0) * LONG), 0.3),
            "time",
            r"in milliseconds, but are read as seconds.* 3.998e\+04 s.*own experiment lasts 20 "
            "s.*only",
            "",
            marks=slow,
        ),
        (
            run(TRUTH, inputs={}),
            "input V",
            "no data, and stays at 0 V",
            'inputs.V = "COLUMN", or values.V = NUMBER',
        ),
        (
            run(TRUTH, inputs={}),
            "parameters",
            "do not depend on R, K, J while input V has no data and stays at 0 V",
            "",
        ),
        (
            run(TRUTH | {"V": missing([50, *range(100, 160)])}),
            "input V",
            "61 of 401 samples are missing in run, .*gap is 0.305 s in run, from 0.495 to 0.8 s",
            "interpolation",
        ),
        (
            run(TRUTH | {"V": missing(TIMES < 0.2)}),
            "input V",
            "40 of 401 samples are missing.*longest gap is 0.2 s in run, from 0 to 0.2 s",
            "",
        ),
        (
            run(TRUTH),
            "jumps",
            "input V jumps between samples in experiment 'run' .2 times.; the largest jump is "
            "from 0 to 6 V at t = 0.095 s in 'run'; linear interpolation",
            'inputs.V = { column = "COLUMN", interpolation = "hold" }',
        ),
        (
            run(TRUTH | {"w": np.where(abs(TIMES - 1.0) < 0.008, -9999.0, TRUTH["w"])}),
            "missing",
            "output speed is -9999 in 3 of 401 samples in experiment run, far from all other "
            "values",
            r"if nothing was measured there, leave .* with missing=\[-9999\] in "
            "Experiment.from_table",
        ),
        (
            run(TRUTH | {"w": TRUTH["w"] + spikes(40.0)}, inputs=HELD),
            "output speed",
            "2 of 401 samples are far from both of their neighbours",
            'if they are faults.*reduce their weight.*cost.name = "huber", .*sigma.speed',
        ),
        (
            rounded(0.01),
            "output speed",
            "multiples of 0.25.*an error of 0.0722, which is 7.2 times the given sigma",
            "0.0722 or more",
        ),
        (
            COASTING,
            "start",
            "nothing changes .* experiment run.*equilibrium.*measured speed changes by 78.5 rad/s",
            'parameters.i = { start = 0, per = "experiment" }',
        ),
    ],
)
def test_a_likely_mistake_is_named(experiment, check, found, do):
    (said,) = findings(problem(experiment), check)
    assert said.verdict in ("note", "problem")
    assert re.search(found, said.found), said.found
    assert re.search(do, said.do), said.do


@pytest.mark.parametrize(
    ("experiment", "check"),
    [
        (run(TRUTH, inputs=HELD), ""),
        (run(TRUTH | {"w": TRUTH["w"] * 3.0}, inputs=HELD), ""),  # a gain may be far off
        (heated(RECORD, 25.0 + 12.0 * (1.0 - np.exp(-RECORD / 900.0))), "time"),
        (run(TRUTH, inputs={}, values={"V": 6.0}), "input V"),
        (run(TRUTH, inputs={}), "parameter R"),  # said of the input, once
        (run(TRUTH | {"V": missing(np.arange(401) % 4 != 0)}), "input V"),
        (
            run(TRUTH | {"V": missing(~np.isin(np.arange(401), [0, 20, 200]))}, inputs=HELD),
            "input V",
        ),
        (run({n: v[np.r_[0:100, 200:401]] for n, v in TRUTH.items()}), "input V"),
        (rounded(0.2), "output speed"),
        (run(TRUTH | {"V": VOLTS + spikes(40.0), "w": TRUTH["w"] + spikes(40.0)}), "output speed"),
        (run(TRUTH | {"w": np.clip(TRUTH["w"], 0.0, 60.0)}), "missing"),
        (
            run(REST | {"w": np.random.default_rng(0).normal(size=401)}, outputs={"speed": "w"}),
            "start",
        ),
    ],
)
def test_what_may_well_be_so_raises_no_alarm(experiment, check):
    assert findings(problem(experiment), check) == []


@pytest.mark.parametrize(
    ("time", "sample_time", "key"),
    [
        ("Time", None, "columns.Time = { factor = 60 }"),
        ("t (min)", None, 'columns."t (min)" = { factor = 60 }'),
        (None, 0.01, "sample_time = 0.6"),
    ],
)
def test_the_key_for_times_names_the_column_where_that_is_known(time, sample_time, key):
    source = TableSource("run", Path("a.csv"), time, sample_time, None, ())
    given = replace(problem(run(TRUTH | {"t": TIMES / 60.0})), tables=(source,))
    (said,) = findings(given, "time")
    assert said.do == f"write {key}"


def test_missing_samples_are_counted_in_each_experiment():
    """Whatever the length of a gap: each empty cell counts."""
    every = np.array([i for i in range(0, 401, 2) if not 100 <= i < 120])
    gappy = missing(np.setdiff1d(np.arange(401), every))
    runs = [run(TRUTH | {"V": gappy}), run(TRUTH | {"V": missing([50, 51])}, id="other")]
    (said,) = findings(problem(*runs), "input V")
    counts = "210 of 401 samples are missing in run, 2 of 401 in other, and are interpolated"
    assert f"{counts}; the longest gap is 0.11 s in run, from 0.49 to 0.6 s" in said.found


def test_an_input_with_few_samples_is_named_with_its_key():
    uneven = np.cumsum([0, 21, 47, 30, 62, 25, 70, 41, 33, 55])
    kept = missing(np.setdiff1d(np.arange(401), uneven))
    jumping = np.where(np.isnan(kept), np.nan, np.sin(TIMES * 1e3))
    for values, verdict, words in (
        (jumping, "note", "has 10 samples in run, where current has 401; its times are irregular"),
        (missing(np.arange(401) % 40 > 0) + TIMES, "ok", "11 samples in run, where current has"),
    ):
        given = problem(run(TRUTH | {"V": values}))
        (said,) = findings(given, "few samples")
        assert said.verdict == verdict
        assert words in said.found
        assert 'inputs.V = { column = "COLUMN", interpolation = "hold" }, if' in said.do
        assert findings(given, "input V") == []
    held = problem(run(TRUTH | {"V": jumping}, inputs=HELD))
    assert findings(held, "few samples") == findings(held, "input V") == []


def test_an_input_that_another_experiment_has_is_no_alarm():
    coast = run(TRUTH, id="coast", inputs={}, values={"w": 50.0})
    (said,) = findings(problem(run(TRUTH), coast), "input V")
    assert said.verdict == "ok"
    assert "no data in 1 of 2 experiments, where it stays at 0 V" in said.found


def test_a_fit_says_which_inputs_nothing_drives():
    driven = spring_problem(experiments=1, samples=20).problem
    runs = tuple(replace(e, inputs=()) for e in driven.experiments)
    result = ce.fit(replace(driven, experiments=runs), ce.LeastSquares(max_iterations=1))
    said = [note for note in result.notes if note.startswith("input F")]
    assert re.search(
        r"\(0 N\) has no data and keeps its start value; to change that, write inputs.F = ", said[0]
    )


def test_one_whose_start_is_estimated_may_begin_at_rest():
    given = problem(COASTING)
    model = replace(given.model, parameters=(*given.model.parameters, "w"))
    parameters = (*given.parameters, ce.Parameter("w", 0.0))
    assert findings(replace(given, model=model, parameters=parameters), "start") == []


@pytest.fixture
def checked(tmp_path, capsys):
    """What check says, without a simulation, of a config of the motor and its table."""

    def call(columns, defaults, experiments, *overrides):
        rows = np.column_stack([*columns.values()])
        np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=",".join(columns), comments="")
        text = (
            f'[model]\nfmu = "{MODELS / "dc_motor.fmu"}"\n[parameters]\nK.start = 0.05\n'
            f'[experiment_defaults]\ntime = "t"\ndata = "a.csv"\ninputs.V = "V"\n{defaults}\n'
        )
        path = tmp_path / "c.toml"
        path.write_text(text + experiments, encoding="utf-8")
        code = main(["check", str(path), "--seconds", "0", *overrides])
        said = " ".join(capsys.readouterr().out.split())
        assert code == ("problem missing" in said)
        return said

    return call


@pytest.mark.parametrize(
    ("defaults", "experiments", "found"),
    [
        (
            "sigma.speed = 0.5",
            ['id = "a"'],
            "given for speed, but not for current, where 1 A is used instead.* -> give "
            "sigma.current = NUMBER",
        ),
        (
            "",
            ['id = "a"\noutputs.current = ""\nsigma.speed = 0.5', 'id = "b"\noutputs.current = ""'],
            "sigma is given for speed in experiment a, but not in experiment b",
        ),
        ("", ['id = "a"'], ""),
        ("sigma = { speed = 0.5, current = 0.1 }", ['id = "a"'], ""),
    ],
)
def test_a_sigma_for_some_is_named(checked, defaults, experiments, found):
    defaults = f'outputs = {{ current = "i", speed = "w" }}\n{defaults}'
    said = checked(TRUTH, defaults, "".join(f"[[experiments]]\n{each}\n" for each in experiments))
    assert re.search(found, said) if found else "sigma" not in said


@pytest.mark.parametrize(
    ("missing", "advised"), [("", "[-9999, 65535]"), ("missing = [-9999]", "[-9999, 65535]")]
)
def test_numbers_that_are_no_measurements_are_named_with_the_key(
    tmp_path, checked, missing, advised
):
    """As they are in the file, whatever its columns are changed to; with the key they are gone."""
    volts = np.where(abs(TIMES - 1.5) < 0.008, 65535.0, VOLTS + 0.1 * np.sin(40.0 * TIMES))
    speed = np.where(abs(TIMES - 1.0) < 0.008, -9999.0, TRUTH["w"])
    given = f'outputs.speed = "w"\ncolumns.w.factor = {1 / RPM}\n{missing}'
    given = {"t": TIMES, "V": volts, "w": speed}, given, "[[experiments]]\nid = 'a'\n"
    said = checked(*given)
    assert "input V is 65535 in 3 of 401 samples of column 'V' in experiment a" in said
    named = "output speed is -9999 in 3 of 401 samples of column 'w' in experiment a"
    assert (named in said) is not bool(missing)
    assert f"missing = {advised} in [experiment_defaults], or in the experiment" in said
    override = f"experiment_defaults.missing={advised}"
    assert "65535" not in checked(*given, override)
    given = ce.read_config(tmp_path / "c.toml", [override])
    (run,) = ce.build_problem(given, tmp_path).experiments
    assert len(run.outputs[0].values) == len(run.inputs[0].values) == 398


def test_the_error_of_a_solver_is_compared_with_the_noise():
    given = problem(run(TRUTH, sigma={"speed": 0.5, "current": 0.01}))
    coarse = replace(given, model=replace(given.model, solver=ce.Solver("rk4", step=0.01)))
    (found,) = findings(coarse, "accuracy")
    assert found.verdict != "ok"
    assert "of sigma.current, which is not small compared with the noise" in found.found
    (fine,) = findings(given, "accuracy")
    assert fine.verdict == "ok"
    assert "of sigma." in fine.found
