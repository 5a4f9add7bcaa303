"""From config to problem: what does not fit the FMU, the data or the method is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.problems.springs import FMU
from support.spoiled import MASS, REMOVED, ROWS, spoiled_fmu, write_input

from cluster_est import Problem, build_problem, read_config
from cluster_est.config.options import build_method
from cluster_est.errors import ClusterEstError

A = "experiments.0"


def build(folder: Path, changes: dict[str, Any], rows: str = ROWS) -> Problem:
    config = read_config(write_input(folder, changes, rows))
    build_method(config)
    return build_problem(config, folder)


def refusal(folder: Path, changes: dict[str, Any], rows: str = ROWS) -> str:
    with pytest.raises(ClusterEstError) as error:
        build(folder, changes, rows)
    message = str(error.value)
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"parameters.zz": {"start": 1}}, "parameters.zz: mass_spring_damper.fmu has no variable"),
        ({"parameters.m.variable": "mm"}, "parameters.m: mass_spring_damper.fmu has no variable"),
        ({"parameters.m.variable": "kk"}, "has no variable 'kk'; did you mean 'k'?"),
        ({"parameters.y": {"start": 1}}, "parameters.y: 'y' must be a variable whose start"),
        ({"parameters.der(x)": {"start": 1}}, "mass_spring_damper.fmu computes it (local)"),
        ({"parameters.c": {"start": 1}}, "values.c: is also a parameter; remove one of the two"),
        ({"parameters.F": {"start": 1}}, "inputs.F: must not be estimated too but is parameters.F"),
        ({"parameters.m.start": 11}, "must lie in its bounds [0.1, 10] but is 11; move the start"),
        ({"parameters.m.bounds": [9, 1]}, "parameters.m.bounds: the lower bound must be below"),
        ({"parameters.m.bounds": [np.nan, 9.0]}, "parameters.m.bounds: the lower bound must be"),
        ({"parameters.m": {"start": 0, "scale": "log"}}, "a log scale needs a positive start"),
        ({"parameters.m.per": "exp"}, 'must be "experiment" or "group:KEY" but is \'exp\''),
        ({"values.cc": 1.0}, "values: mass_spring_damper.fmu has no variable 'cc'; did you mean"),
        ({"values.y": 1.0}, "values: 'y' must be a variable whose start value can be set"),
        ({"values.c": True}, "values.c: must be a number, because the variable is of type real"),
        ({"values.F": 1.0}, "values.F: must not be an input of the same experiment"),
        ({f"{A}.values": {"xx": 1.0}}, "experiment 'a'.values: mass_spring_damper.fmu has no"),
        ({f"{A}.inputs": {"f": "force"}}, "experiment 'a'.inputs: mass_spring_damper.fmu has no"),
        ({f"{A}.inputs": {"m": "force"}}, "'m' must be an input of mass_spring_damper.fmu but is"),
        ({f"{A}.inputs.F": "forse"}, "a.csv has no column 'forse'; did you mean 'force'?"),
        ({f"{A}.outputs": {"yy": "position"}}, "has no variable 'yy'; did you mean 'y'?"),
        ({f"{A}.outputs": {"y": "pos"}}, "a.csv has no column 'pos'; did you mean 'position'?"),
        ({f"{A}.outputs": {"m": "force"}}, "outputs.m: must be a variable that mass_spring_damper"),
        ({f"{A}.time": "tme"}, "a.csv has no column 'tme'; did you mean 'time'?"),
        (
            {f"{A}.columns": {"forc": {}}},
            ["columns: ", "has no column 'forc'; did you mean 'force'"],
        ),
        (
            {f"{A}.rows": [0, 9]},
            ["rows: must lie within the 4 rows of", "is [0, 9]; lower"],
        ),
        ({f"{A}.rows": [2, 3]}, ["must use at least two rows of", "but uses 1; check rows"]),
        ({f"{A}.start": 0.5}, "experiment 'a'.start: must be before stop, 0.3 s, but is 0.5 s"),
        ({f"{A}.stop": -1}, "experiment 'a'.start: must be before stop, -1 s, but is 0 s"),
        ({f"{A}.windows": [[5, 6]]}, "must have at least one measured value between 0 and 0.3 s"),
        (
            {f"{A}.test_windows": [[5, 6]]},
            "'a'.test_windows: must leave at least one measured value",
        ),
        ({f"{A}.role": "test"}, 'at least one must have role = "train" but none has'),
        ({f"{A}.time": REMOVED, f"{A}.sample_time": 1e308}, "row 4: the time must be a finite"),
        ({"method.options": {"trails": 3}}, "least_squares has no such option; did you mean 'tri"),
        ({"method.options": {"trials": 2.5}}, "trials: must be a whole number but is 2.5"),
        ({"method.options": {"trials": 0}}, "method.options.trials: must be at least 1 but is 0"),
        ({"method.options": {"ftol": "x"}}, "method.options.ftol: must be a number but is 'x'"),
        ({"method.options": {"ftol": np.inf}}, "ftol: must be finite and of a usual size but is"),
        ({"method.options": {"differences": "fwd"}}, "'central', 'sensitivities' but is 'fwd'"),
        ({"method.options": {"differences": []}}, "'central', 'sensitivities' but is []"),
        (
            {"model.solver": "fmu", "model.interface": "model_exchange"},
            "must be dormand_prince, rk4",
        ),
        ({"model.solver": "rk4", "model.interface": "co_simulation"}, "must be fmu for co_simul"),
        ({f"{A}.data": "b.csv"}, ["data: there is no file 'b.csv'; looked for", "data_folders"]),
        ({f"{A}.data": "."}, ["data: there is no file '.'; looked for", "(a folder)"]),
        ({f"{A}.data": "x" * 999}, ["data: there is no file 'xxx", "File name too long"]),
        ({f"{A}.data": "$NO_SUCH/a"}, ["there is no file '$NO_SUCH/a'", "(which is not set)"]),
        ({f"{A}.data": "b", "data_folders": ["~no_such_user"]}, ["there is no file 'b'", "home"]),
        ({"model.fmu": "no.fmu"}, "model.fmu: there is no file 'no.fmu'; looked for"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_does_not_fit_is_refused(tmp_path, changes, sentence):
    message = refusal(tmp_path, changes)
    for part in [sentence] if isinstance(sentence, str) else sentence:
        assert part in message


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("0.1,", "nan,", "column 'time', row 3: the time must be a finite number but is nan"),
        ("0.1,", ",", "column 'time', row 3: the time must be a finite number"),
        ("0.1,", "\n\ninf,", "column 'time', row 5: the time must be a finite number but is inf"),
        ("0.1,", "0,", "column 'time', row 3: times must increase but 0 repeats 0 of the row"),
        ("0.2,", "0.05,", "column 'time', row 4: times must increase but 0.05 goes back from 0.1"),
        ("0.1,1", "0.1,-inf", "column 'force', row 3: must be a finite number but is -inf; mend"),
        ("0.01", "inf", "column 'position', row 3: must be a finite number but is inf; mend it"),
        ("0.01", "1e999", "column 'position', row 3: must be a finite number but is inf"),
        ("0.01", "high", "column 'position', row 3: must be a number but is 'high'; mend it"),
        (ROWS, "time,force,position\n0,,1\n1,,2\n", ["inputs.F: column 'force'", "but is empty"]),
        (ROWS, "time,force,position\n0,1,\n1,2,\n", ["outputs.y: column 'position'", "is empty"]),
        (ROWS, "time,force,position\n0,1,2\n", ["must use at least two rows of", "but uses 1; it"]),
        (ROWS, "time,force,position\n", ["must use at least two rows of", "but uses 0; it needs"]),
    ],
)
def test_what_is_no_measurement_is_refused(tmp_path, old, new, sentence):
    message = refusal(tmp_path, {}, ROWS.replace(old, new))
    for part in [sentence] if isinstance(sentence, str) else sentence:
        assert part in message


def test_rows_are_counted_as_in_the_file_where_only_some_are_used(tmp_path):
    rows = ROWS.replace("0.3,0,", "0.3,inf,")
    assert "column 'force', row 5: must be" in refusal(tmp_path, {f"{A}.rows": [1, 4]}, rows)
    assert build(tmp_path, {f"{A}.rows": [0, 3]}, rows).experiments[0].stop == 0.2


def test_a_signal_that_overflows_in_its_new_unit_is_refused(tmp_path):
    change = {f"{A}.columns": {"force": {"factor": 1e308, "demean": True}}}
    rows = ROWS.replace(",1,", ",1e9,")
    assert "column 'force', row 2: must be a finite number" in refusal(tmp_path, change, rows)


def test_demeaning_takes_the_measured_rows_alone(tmp_path):
    change = {f"{A}.columns": {"position": {"demean": True, "factor": 10.0, "offset": 1.0}}}
    problem = build(tmp_path, change, "time,force,position\n0,1,2\n1,1,\n2,1,4\n")
    np.testing.assert_array_equal(problem.experiments[0].outputs[0].values, [-9.0, 11.0])


def test_windows_that_are_held_out_are_an_experiment_of_their_own(tmp_path):
    train, test = build(tmp_path, {f"{A}.test_windows": [[0.15, 0.25]]}).experiments
    assert (train.id, train.role, test.id, test.role) == ("a", "train", "a (held out)", "test")
    assert train.outputs[0].times.tolist() == [0.0, 0.1, 0.3]
    assert test.outputs[0].times.tolist() == [0.2]
    assert test.record_id == train.record_id == "a"


def test_data_is_looked_for_in_the_folders_in_turn(tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "b.csv").write_text(ROWS)
    monkeypatch.setenv("DATA_OF_TEST", str(tmp_path / "there"))
    folders = ["$NO_SUCH", "nowhere", "$DATA_OF_TEST"]
    assert build(tmp_path, {f"{A}.data": "b.csv", "data_folders": folders}).experiments[0].size == 4


@pytest.mark.parametrize(
    ("start", "value", "sentence"),
    [
        ('<Integer start="1"/>', 1.5, "values.m: must be a whole number of 32 bits, because the"),
        ('<Integer start="1"/>', True, "of type integer, but is true"),
        ('<Integer start="1"/>', 2**40, "of type integer, but is 1099511627776"),
        ('<Boolean start="true"/>', 2, "must be true or false, because the variable is of type"),
        ('<Integer start="1"/>', 3, ""),
        ('<Integer start="1"/>', 3.0, ""),
        ('<Boolean start="true"/>', False, ""),
        ('<Boolean start="true"/>', 1, ""),
    ],
)
def test_a_known_value_must_suit_the_type_of_its_variable(tmp_path, start, value, sentence):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={MASS: start}))
    changes = {"model.fmu": "x.fmu", "parameters.m": REMOVED, "values.m": value}
    if sentence:
        assert sentence in refusal(tmp_path, changes)
    else:
        assert dict(build(tmp_path, changes).experiments[0].values)["m"] == value


def test_a_parameter_must_be_real(tmp_path):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={MASS: '<Integer start="1"/>'}))
    message = refusal(tmp_path, {"model.fmu": "x.fmu"})
    assert "parameters.m: 'm' must be a real variable to be estimated but is of type int" in message


ONLY = {
    "model_exchange": ("<CoSimulation", "</CoSimulation>"),
    "co_simulation": ("<ModelExchange", "</ModelExchange>"),
}


@pytest.mark.parametrize(
    ("only", "changes", "sentence"),
    [
        ("model_exchange", {"model.interface": "co_simulation"}, "but offers model_exchange"),
        ("co_simulation", {"model.interface": "model_exchange"}, "but offers co_simulation"),
        (
            "model_exchange",
            {"model.solver": "fmu"},
            "be dormand_prince, rk4 or cvode for model_exc",
        ),
        ("co_simulation", {"model.solver": "rk4"}, "model.solver: must be fmu for co_simulation"),
    ],
)
def test_interface_and_solver_must_be_there(tmp_path, only, changes, sentence):
    def cut(entries: dict[str, bytes]) -> None:
        first, last = ONLY[only]
        pattern = f"{first}.*{last}".encode()
        xml = entries["modelDescription.xml"]
        entries["modelDescription.xml"] = re.sub(pattern, b"", xml, flags=re.DOTALL)

    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(cut))
    assert sentence in refusal(tmp_path, {"model.fmu": "x.fmu", **changes})


def test_an_interface_that_cannot_be_used_is_said_to_be_left_out(tmp_path):
    twice = '<Unknown index="8" />\n      <Unknown index="9" />\n    </Derivatives>'
    spoiled = spoiled_fmu(xml={twice: twice.replace("9", "8")})
    (tmp_path / "x.fmu").write_bytes(spoiled)
    assert build(tmp_path, {"model.fmu": "x.fmu"}).model.interface == "co_simulation"
    changes = {"model.fmu": "x.fmu", "model.interface": "model_exchange"}
    said = refusal(tmp_path, changes)
    assert "because it lists the derivative of one state twice, and is left out); choose" in said


def test_an_fmu_with_events_is_integrated_like_any_other(tmp_path):
    events = spoiled_fmu(xml={'numberOfEventIndicators="0"': 'numberOfEventIndicators="2"'})
    (tmp_path / "x.fmu").write_bytes(events)
    assert build(tmp_path, {"model.fmu": "x.fmu"}).model.interface == "model_exchange"


def test_the_fmu_may_be_given_by_its_full_path(tmp_path):
    assert build(tmp_path, {"model.fmu": str(FMU)}).model.name == FMU.name
