"""What does not fit the FMU, the data or the other parts of a config, and tables that are wrong."""

import re

import pytest
from support.spoiled import MASS, REMOVED, ROWS, spoiled_fmu, write_input

from cluster_est.cli import main

A = "experiments.0"


@pytest.mark.parametrize(
    ("changes", "pattern"),
    [
        ({"parameters.zz": {"start": 1}}, "parameters.zz: mass_spring_damper.fmu has no variable"),
        ({"parameters.m.variable": "mm"}, "parameters.m: mass_spring.* no variable 'mm'.*'m'"),
        ({"parameters.y": {"start": 1}}, "parameters.y: 'y' must be a variable whose start"),
        ({"parameters.der(x)": {"start": 1}}, r"mass_spring_damper.fmu computes it \(local\)"),
        ({"parameters.c": {"start": 1}}, "values.c: .*also a parameter; remove one"),
        ({"parameters.F": {"start": 1}}, "inputs.F: .*not be estimated too.*parameters.F"),
        ({"parameters.m.start": 11}, r"parameters.m.start: .*bounds \[0.1, 10\].*11; move"),
        ({"parameters.m.per": "exp"}, 'parameters.m.per.*"experiment" or "group:KEY".*\'exp\''),
        ({"parameters.m.per": "group:cell"}, "experiment 'a': .*a group.*group = { cell ="),
        ({"values.cc": 1.0}, "values: mass_spring_damper.fmu has no variable 'cc'.*did you mean"),
        ({"values.y": 1.0}, "values: 'y' must be a variable whose start value can be set"),
        ({"values.c": True}, "values.c: .*a number.*of type real"),
        ({"values.F": 1.0}, "values.F: .*not be an input of the same experiment"),
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
        ({f"{A}.start": 0.5}, "experiment 'a'.start: .*before stop, 0.3 s.*0.5 s"),
        ({f"{A}.stop": -1}, "experiment 'a'.start: .*before stop, -1 s.*0 s"),
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
        ({"model.units": {"vv": "m/s"}}, "model.units.vv: .* no variable and no experiment"),
    ],
)
def test_what_does_not_fit_is_refused(refuse, changes, pattern):
    refuse(changes, pattern)


@pytest.mark.parametrize(
    ("old", "new", "pattern"),
    [
        ("0.1,", "nan,", "a.csv, column 'time', row 3: the time .*finite number.*nan"),
        ("0.1,", ",", "column 'time', row 3: the time .*finite number"),
        ("0.1,", "\n\ninf,", "column 'time', row 5: the time .*finite number.*inf"),
        ("0.1,", "0,", "column 'time', row 3: times must increase.* 0 repeats 0"),
        ("0.2,", "0.05,", "column 'time', row 4: times must increase.*0.05 goes back from 0.1"),
        ("0.1,1", "0.1,-inf", "column 'force', row 3: .*finite number.*-inf; mend"),
        ("0.01", "1e999", "column 'position', row 3: .*finite number.*inf; mend"),
        (ROWS, "time,force,position\n0,,1\n1,,2\n", "inputs.F: column 'force'.*is empty"),
        (ROWS, "time,force,position\n0,1,\n1,2,\n", "outputs.y: column 'position'.*is empty"),
        (ROWS, "time,force,position\n0,1,2\n", "at least two rows of.*uses 1; it"),
        (ROWS, "time,force,position\n", "at least two rows of.*uses 0; it needs"),
    ],
)
def test_what_is_no_measurement_is_refused(refuse, old, new, pattern):
    refuse({}, pattern, rows=ROWS.replace(old, new))


def test_rows_are_counted_as_in_the_file_where_only_some_are_used(refuse):
    rows = ROWS.replace("0.3,0,", "0.3,inf,")
    refuse({f"{A}.rows": [1, 4]}, "column 'force', row 5: must be", rows=rows)


def test_a_signal_that_overflows_in_its_new_unit_is_refused(refuse):
    change = {f"{A}.columns": {"force": {"factor": 1e308, "demean": True}}}
    pattern = "column 'force', row 2: .*finite number"
    refuse(change, pattern, rows=ROWS.replace(",1,", ",1e9,"))


@pytest.mark.parametrize(
    ("start", "value", "pattern"),
    [
        ('<Integer start="1"/>', 1.5, "values.m: .*whole number of 32 bits.*integer.*1.5"),
        ('<Integer start="1"/>', True, "of type integer, but is true"),
        ('<Integer start="1"/>', 2**40, "of type integer, but is 1099511627776"),
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
    refuse({"model.fmu": "x.fmu"}, "parameters.m: 'm' must be a real variable.*integer")


ONLY = {
    "model_exchange": b"<CoSimulation.*</CoSimulation>",
    "co_simulation": b"<ModelExchange.*</ModelExchange>",
}


@pytest.mark.parametrize(
    ("only", "changes", "pattern"),
    [
        ("model_exchange", {"model.interface": "co_simulation"}, "but offers model_exchange"),
        ("co_simulation", {"model.interface": "model_exchange"}, "but offers co_simulation"),
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
