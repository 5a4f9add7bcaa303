"""Refusals of keys and tables say where it is, what it must be, what it is, what to do."""

import re

import pytest
from support.spoiled import INF, MASS, NAN, REMOVED, ROWS, spoiled_fmu, write_input

from cluster_est.cli import main

A = "experiments.0"
EXPERIMENT = r"experiments\['a'\]"


@pytest.mark.parametrize(
    ("path", "near"),
    [
        ("modle", "model"),
        ("model.fmuu", "fmu"),
        ("parameters.m.strat", "start"),
        (f"{A}.outptus", "outputs"),
        (f"{A}.columns.force.fator", "factor"),
    ],
)
def test_an_unknown_key_is_named_with_its_line_and_the_nearest_known_one(refuse, path, near):
    shown = path.replace(A, EXPERIMENT)
    refuse({path: 1.0}, rf"config.toml, line \d+: unknown key {shown}.*'{near}'")


def test_a_key_that_stands_too_deep_is_shown_where_it_belongs(refuse):
    outputs = {"x": {"column": "x", "sigma": 0.1}}
    belongs = rf"outputs\.x\.sigma.*'sigma' is a key of {EXPERIMENT} itself, so move it"
    refuse({f"{A}.outputs": outputs}, belongs)
    outputs = {"x": {"column": "x", "sgma": 0.1}}
    assert "is a key of" not in refuse({f"{A}.outputs": outputs}, "sgma")


@pytest.mark.parametrize(
    ("path", "pattern"),
    [
        ("model", "model is missing.*the FMU"),
        ("model.fmu", "model.fmu is missing.*path of the FMU"),
        ("parameters.m.start", "parameters.m.start is missing.*start value of the estimation"),
        ("experiments", "experiments is missing"),
        (f"{A}.id", r"experiments\[0\].id is missing"),
        (f"{A}.data", f"{EXPERIMENT}.data is missing"),
        (f"{A}.outputs", f"{EXPERIMENT}.outputs is missing"),
        (f"{A}.time", f"{EXPERIMENT}.*either time .* or sample_time .*neither"),
    ],
)
def test_a_missing_key_is_named_with_what_it_is_for(refuse, path, pattern):
    refuse({path: REMOVED}, pattern)


@pytest.mark.parametrize(
    ("path", "value", "pattern"),
    [
        ("model", 3, "model: .*a table.*3"),
        ("model.fmu", 3, "model.fmu: .*text in quotes.*3"),
        ("model.interface", "cosim", "'auto', 'model_exchange' or 'co_simulation'.*'cosim'"),
        ("model.solver", "euler", "'dormand_prince', 'rk4', 'cvode' or 'fmu'.*'euler'"),
        ("model.step", 0.0, "model.step: .*greater than 0.*0.0"),
        ("model.rtol", 2.0, "model.rtol: .*less than 1.*2.0"),
        ("model.max_steps", 1.5, "model.max_steps: .*whole number.*1.5"),
        ("model.max_steps", 2**70, r"model.max_steps: .*at most 9.22337e\+18.*11805916"),
        ("data_folders", "x", "data_folders: .*a list.*'x'"),
        ("parameters", {}, "parameters: at least one must be free"),
        ("parameters.m", 3, "parameters.m: .*a table.*3"),
        ("parameters.m.start", "1.5", "parameters.m.start: .*number.*'1.5'; remove the quotes"),
        ("parameters.m.start", True, "parameters.m.start: .*number.*true"),
        ("parameters.m.start", NAN, "parameters.m.start: .*finite number.*nan"),
        ("parameters.m.bounds", 3, "parameters.m.bounds: .*list of two numbers.*3"),
        ("parameters.m.scale", "ln", "parameters.m.scale: .*'linear' or 'log'.*'ln'"),
        ("parameters.m.fixed", "true", "m.fixed: .*true or false.*'true'; remove the quotes"),
        ("parameters.m.variable", 3, "parameters.m.variable: .*text in quotes"),
        ("values", 3, "values: .*a table"),
        ("values.c", NAN, "values.c: .*finite number, true, false or text.*nan"),
        ("experiments", [], "experiments: .*at least one entry"),
        ("experiments", {}, r"experiments: .*a list.*\{\}.*\[\[experiments\]\]"),
        (f"{A}.id", "", r"experiments\[0\].id: .*not be empty"),
        (f"{A}.sample_time", 0.1, f"{EXPERIMENT}.*time.*sample_time.*both; remove one"),
        (f"{A}.inputs.F", 3, "inputs.F: .*the name of a column or { column, interpolation }.*3"),
        (f"{A}.inputs.F", {}, "inputs.F.column is missing"),
        (f"{A}.inputs.F", {"column": "force", "interpolation": "cubic"}, "'linear' or 'hold'"),
        (f"{A}.outputs.y", 3, f"{EXPERIMENT}.outputs.y: .*the name of a column"),
        (f"{A}.outputs.F", "force", "outputs.F: .*not be an input"),
        (f"{A}.sigma", {"y": 0.0}, f"{EXPERIMENT}.sigma.y: .*greater than 0.*0.0"),
        (f"{A}.sigma", {"yy": 1.0}, "sigma.yy: .*one of the outputs"),
        (f"{A}.relative_sigma", {"y": 0.1}, "relative_sigma.y: .*given together with sigma.y"),
        (f"{A}.relative_sigma", {"y": -1.0}, "relative_sigma.y: .*at least 0.*-1.0"),
        (f"{A}.relative_sigma", {"yy": 0.1}, "relative_sigma.yy: .*one of the outputs"),
        (f"{A}.start", NAN, f"{EXPERIMENT}.start: .*finite number"),
        (f"{A}.stop", INF, f"{EXPERIMENT}.stop: .*finite number"),
        (f"{A}.windows", [[0.2, 0.1]], r"windows\[0\]: .*from before to"),
        (f"{A}.windows", [[NAN, 1.0]], r"windows\[0\]: .*two numbers.*finite"),
        (f"{A}.test_windows", [[0.2, 0.1]], r"test_windows\[0\]: .*from before to"),
        (f"{A}.rows", [2, 1], r"rows: .*from below to.*\[2, 1\]"),
        (f"{A}.rows", [-1, 2], r"rows: .*two whole numbers that are not negative.*\[-1, 2\]"),
        (f"{A}.role", "tset", "role: .*'train' or 'test'.*'tset'"),
        (f"{A}.values", {"x": []}, f"{EXPERIMENT}.values.x: .*finite number, true, false"),
        (f"{A}.group", 3, "group: .*a label or { KEY.*3"),
        (f"{A}.columns", {"force": {"factor": NAN}}, "columns.force.factor: .*finite number.*nan"),
        (f"{A}.warm_up", -1, f"{EXPERIMENT}.warm_up: .*at least 0.*-1"),
        (f"{A}.weight", 0, f"{EXPERIMENT}.weight: .*greater than 0.*0"),
        ("cost.name", "ssee", "cost.name: .*no 'ssee'.*'sse'"),
        ("cost.weights", {"y": 0}, "cost.weights.y: .*greater than 0.*0"),
        ("cost.step", 0, "cost.step: .*greater than 0.*0"),
        ("cost.time_base", "mesured", "cost.time_base: .*'measured'.*'mesured'"),
        ("cost.normalise", "mean", "cost.normalise: .*'sigma', 'max' or 'range'.*'mean'"),
        ("method.name", "least_square", "method.name: .*no 'least_square'.*'least_squares'"),
        ("method.options", 3, "method.options: .*a table.*3"),
        ("method.seed", -1, "method.seed: .*at least 0.*-1"),
        ("executor.name", "rya", "executor.name: .*no 'rya'.*'ray'"),
        ("executor.workers", 0, "executor.workers: .*greater than 0.*0"),
        ("budget.seconds", NAN, "budget.seconds: .*finite number.*nan"),
        ("multistart.points", [{"m": INF}], r"multistart.points\[0\].m: .*finite number"),
        ("multistart.screen", 0, "multistart.screen: .*greater than 0.*0"),
        ("multistart.at_once", 0, "multistart.at_once: .*greater than 0.*0"),
        ("multistart.patience", -1, "multistart.patience: .*at least 0.*-1"),
        ("multistart.same", 0, "multistart.same: .*greater than 0.*0"),
        ("uncertainty.confidence", 0.1, "uncertainty.confidence: .*at least 0.5"),
        ("constraints", {}, r"constraints: .*a list.*\{\}"),
    ],
)
def test_a_wrong_value_is_refused_in_one_line(refuse, path, value, pattern):
    refuse({path: value}, pattern)


def test_each_problem_has_a_line(tmp_path, refused):
    write_input(tmp_path, {"model.stp": 1, "parameters.m.start": "x", "method.seed": -1})
    refused(["check", "config.toml"], "model.stp.*\n.*parameters.m.start.*\n.*method.seed", lines=3)
    step = {"signal": "y", "step_response": {}}
    write_input(tmp_path, {"constraints": [step]})
    refused(["check", "config.toml"], "final.*rise_time.*settling_time is missing", lines=3)
    write_input(tmp_path, {f"{A}.windows": [0.1, 0.2]})
    refused(["check", "config.toml"], r"windows\[0\]: .*two numbers.*0.1", lines=2)


@pytest.mark.parametrize(
    ("override", "pattern"),
    [
        ("trials", "'trials': .*KEY=VALUE"),
        ("=3", "'=3': .*KEY=VALUE"),
        ("a\udcff=1", "KEY=VALUE"),
        ("modle.fmu=x", "unknown key modle.*'model'"),
        ("method.sed=1", "unknown key method.sed.*'seed'"),
        ("parameters.m.start=zz", "parameters.m.start: .*number.*'zz'"),
        ("parameters.m.start.x=3", "parameters.m.start.x: 'start' is a value, not a table"),
        ("experiments.b.role=test", "experiments.b.role: .*no entry 'b'.*'a'"),
        ("experiments.0=3", r"experiments\[0\]: .*a table.*3"),
        ("parameters.m.bounds.2=3", "parameters.m.bounds.2: .*no entry '2'"),
        ("parameters.m.bounds.0.0=3", "parameters.m.bounds.0.0: '0' is a value, not a table"),
        ("method.seed=" + "[" * 5000, "method.seed: .*whole number"),
        ("method.seed=" + "9" * 5000, "method.seed: .*whole number"),
        ("method.seed=0x" + "f" * 5000, "method.seed: .*a number of thousands of digits"),
    ],
    ids=lambda text: text[:30],
)
def test_an_override_that_leads_nowhere_is_refused(refuse, override, pattern):
    assert ", line " not in refuse({}, pattern, more=(override,))


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"parameters.zz": {"start": 1}}, "parameters.zz: mass_spring_damper.fmu has no variable"),
        ({"parameters.m.variable": "mm"}, "parameters.m: mass_spring.* no variable 'mm'.*'m'"),
        ({"parameters.y": {"start": 1}}, "parameters.y: 'y' must be a variable whose start"),
        (
            {"parameters.der(x)": {"start": 1}},
            r"mass_spring_damper.fmu computes it \(its causality is local\)",
        ),
        ({"parameters.c": {"start": 1}}, "values.c: .*also be a parameter, but is; remove one"),
        ({"parameters.F": {"start": 1}}, "inputs.F: .*not also be estimated.*parameters.F"),
        ({"parameters.m.start": 11}, r"parameters.m.start: .*bounds \[0.1, 10\].*11; move"),
        ({"parameters.m.per": "exp"}, 'parameters.m.per.*"experiment" or "group:KEY".*\'exp\''),
        ({"parameters.m.per": "group:cell"}, "experiment 'a': .*a group.*group = { cell ="),
        ({"values.cc": 1.0}, "values: mass_spring_damper.fmu has no variable 'cc'.*did you mean"),
        ({"values.y": 1.0}, "values: 'y' must be a variable whose start value can be set"),
        ({"values.c": True}, "values.c: .*a number.*of type real"),
        ({"values.F": 1.0}, "values.F: .*not also be an input of the same experiment"),
        ({f"{A}.values": {"xx": 1.0}}, "'a'.values: mass_spring_damper.fmu has no"),
        ({f"{A}.inputs": {"f": "force"}}, "'a'.inputs: mass_spring_damper.fmu has no"),
        ({f"{A}.inputs": {"m": "force"}}, "'m' must be an input of mass_spring_damper.fmu"),
        ({f"{A}.inputs.F": "forse"}, "a.csv has no column 'forse'.*'force'"),
        ({f"{A}.outputs": {"yy": "position"}}, "no variable 'yy'.*'y'"),
        ({f"{A}.outputs": {"y": "pos"}}, "a.csv has no column 'pos'.*'position'"),
        ({f"{A}.outputs": {"m": "force"}}, "outputs.m: .*a variable that mass_spring_damper"),
        ({f"{A}.time": "tme"}, "a.csv has no column 'tme'.*'time'"),
        ({f"{A}.columns": {"forc": {}}}, "columns: .*no column 'forc'.*'force'"),
        ({f"{A}.rows": [0, 9]}, r"rows: .*within the 4 rows of.*\[0, 9\]; lower"),
        ({f"{A}.rows": [2, 3]}, "at least two rows of.*uses 1; check rows"),
        ({f"{A}.start": 0.5}, "experiment 'a'.start: .*before stop, which is 0.3 s.*0.5 s"),
        ({f"{A}.stop": -1}, "experiment 'a'.start: .*before stop, which is -1 s.*0 s"),
        ({f"{A}.windows": [[5, 6]]}, "'a'.*at least one measured value between 0 and 0.3 s"),
        ({f"{A}.warm_up": 9.0}, "'a'.*at least one measured value.*none"),
        ({f"{A}.test_windows": [[5, 6]]}, "'a'.test_windows: .*leave at least one measured"),
        ({f"{A}.role": "test"}, 'at least one must have role = "train".*none'),
        ({f"{A}.time": REMOVED, f"{A}.sample_time": 1e308}, "row 4: the time .*finite"),
        ({f"{A}.data": "b.csv"}, "data: .*no file 'b.csv'; looked for b.csv.*data_folders"),
        ({f"{A}.data": "."}, r"data: .*no file '.'; looked for.*\(a folder\)"),
        ({f"{A}.data": "x" * 300}, "data: .*no file 'xxx.*File name too long"),
        ({f"{A}.data": "$NO_SUCH/a"}, r"no file '\$NO_SUCH/a'.*\(which is not set\)"),
        ({f"{A}.data": "b", "data_folders": ["~no_such_user"]}, "no file 'b'.*home"),
        ({"model.fmu": "no.fmu"}, "model.fmu: .*no file 'no.fmu'; looked for"),
        (
            {"model.units": {"vv": "m/s"}},
            "model.units.vv: .* no variable of that name, and no experiment",
        ),
    ],
)
def test_what_does_not_fit_is_refused(refuse, changes, pattern):
    refuse(changes, pattern)


OVERFLOW = {"force": {"factor": 1e308, "demean": True}}


@pytest.mark.parametrize(
    ("changes", "old", "new", "pattern"),
    [
        ({}, "0.1,", "nan,", "a.csv, column 'time', row 3: the time .*finite number.*nan"),
        ({}, "0.1,", ",", "column 'time', row 3: the time .*finite number"),
        ({}, "0.1,", "\n\ninf,", "column 'time', row 5: the time .*finite number.*inf"),
        ({}, "0.1,", "0,", "column 'time', row 3: times must increase.* 0 repeats 0"),
        ({}, "0.2,", "0.05,", "column 'time', row 4: times must increase.*0.05 goes back from 0.1"),
        ({}, "0.1,1", "0.1,-inf", "column 'force', row 3: .*finite number.*-inf; correct"),
        ({}, "0.01", "1e999", "column 'position', row 3: .*finite number.*inf; correct"),
        ({}, ROWS, "time,force,position\n0,,1\n1,,2\n", "inputs.F: column 'force'.*is empty"),
        ({}, ROWS, "time,force,position\n0,1,\n1,2,\n", "outputs.y: column 'position'.*is empty"),
        ({}, ROWS, "time,force,position\n0,1,2\n", "at least two rows of.*uses 1; check"),
        (
            {},
            ROWS,
            "time,force,position\n",
            "rows of numbers, but has only a header; check the file",
        ),
        # rows are counted as in the file where only some are used
        ({f"{A}.rows": [1, 4]}, "0.3,0,", "0.3,inf,", "column 'force', row 5: must be"),
        # a signal that overflows in its new unit
        ({f"{A}.columns": OVERFLOW}, ",1,", ",1e9,", "column 'force', row 2: .*finite number"),
    ],
)
def test_what_is_no_measurement_is_refused(refuse, changes, old, new, pattern):
    refuse(changes, pattern, rows=ROWS.replace(old, new))


@pytest.mark.parametrize(
    ("start", "value", "pattern"),
    [
        ('<Integer start="1"/>', 1.5, "values.m: .*whole number of 32 bits.*integer.*1.5"),
        ('<Integer start="1"/>', True, r"of type integer\), but is true"),
        ('<Integer start="1"/>', 2**40, r"of type integer\), but is 1099511627776"),
        ('<Boolean start="true"/>', 2, "values.m: .*true or false.*boolean"),
        ('<Integer start="1"/>', 3, ""),
        ('<Integer start="1"/>', 3.0, ""),
        ('<Boolean start="true"/>', False, ""),
        ('<Boolean start="true"/>', 1, ""),
    ],
)
def test_a_known_value_must_suit_the_type_of_its_variable(tmp_path, refuse, start, value, pattern):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={MASS: start}))
    changes = {"model.fmu": "x.fmu", "parameters.m": REMOVED, "values.m": value}
    if pattern:
        refuse(changes, pattern)
    else:
        config = write_input(tmp_path, changes)
        assert main(["check", str(config), "--seconds", "0"]) == 0


def test_a_parameter_must_be_real(tmp_path, refuse):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={MASS: '<Integer start="1"/>'}))
    refuse({"model.fmu": "x.fmu"}, "parameters.m: 'm' .*must be a real variable.*integer")


ONLY = {
    "model_exchange": b"<CoSimulation.*</CoSimulation>",
    "co_simulation": b"<ModelExchange.*</ModelExchange>",
}


@pytest.mark.parametrize(
    ("only", "changes", "pattern"),
    [
        ("model_exchange", {"model.interface": "co_simulation"}, "but offers only model_exchange"),
        ("co_simulation", {"model.interface": "model_exchange"}, "but offers only co_simulation"),
        ("model_exchange", {"model.solver": "fmu"}, "dormand_prince, rk4 or cvode for model_exc"),
        ("co_simulation", {"model.solver": "rk4"}, "model.solver: .*fmu for co_simulation"),
    ],
)
def test_interface_and_solver_must_be_there(tmp_path, refuse, only, changes, pattern):
    def cut(entries: dict[str, bytes]) -> None:
        xml = entries["modelDescription.xml"]
        entries["modelDescription.xml"] = re.sub(ONLY[only], b"", xml, flags=re.DOTALL)

    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(cut))
    refuse({"model.fmu": "x.fmu", **changes}, pattern)
