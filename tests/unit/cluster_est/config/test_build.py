"""From config to problem. What is refused on the way: `tests/integration/config`."""

import tomllib

import numpy as np
import pytest
from support.problems.springs import FMU
from support.spoiled import ROWS, spoiled_fmu, spoiled_tree, write_input

from cluster_est import read_config, read_problem
from cluster_est.config.reader import parse_config
from cluster_est.errors import ClusterEstError
from cluster_est.results.fit_tables import coefficient_units
from cluster_est.toml import to_toml

A = "experiments.0"


def build(folder, changes, rows=ROWS):
    return read_problem(write_input(folder, changes, rows))


def test_only_the_rows_that_are_named_are_used(tmp_path):
    rows = ROWS.replace("0.3,0,", "0.3,inf,")
    assert build(tmp_path, {f"{A}.rows": [0, 3]}, rows).experiments[0].stop == 0.2


def test_demeaning_takes_the_measured_rows_alone(tmp_path):
    change = {f"{A}.columns": {"position": {"demean": True, "factor": 10.0, "offset": 1.0}}}
    problem = build(tmp_path, change, "time,force,position\n0,1,2\n1,1,\n2,1,4\n")
    np.testing.assert_array_equal(problem.experiments[0].outputs[0].values, [-9.0, 11.0])


def test_a_late_column_was_measured_earlier_than_it_says(tmp_path):
    change = {f"{A}.columns": {"position": {"late": 0.1}, "force": {"late": -0.1}}}
    (run,) = build(tmp_path, change).experiments
    assert run.outputs[0].times == pytest.approx([0.0, 0.1, 0.2])
    assert run.inputs[0].times == pytest.approx([0.1, 0.2, 0.3, 0.4])


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


def test_an_interface_that_cannot_be_used_is_said_to_be_left_out(tmp_path):
    twice = '<Unknown index="8" />\n      <Unknown index="9" />\n    </Derivatives>'
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={twice: twice.replace("9", "8")}))
    assert build(tmp_path, {"model.fmu": "x.fmu"}).model.interface == "co_simulation"
    with pytest.raises(
        ClusterEstError, match=r"derivative of a state twice.*left out.*set model.interface"
    ):
        build(tmp_path, {"model.fmu": "x.fmu", "model.interface": "model_exchange"})


def test_units_of_the_config_take_the_place_of_the_fmus(tmp_path):
    assert build(tmp_path, {}).describe().variables["v"].unit == "m/s"
    changes = {"model.units": {"v": "km/h", "wind": "m/s"}, f"{A}.signals": {"wind": "force"}}
    problem = build(tmp_path, changes)
    described = problem.describe()
    assert (described.variables["v"].unit, described.variables["x"].unit) == ("km/h", "m")
    assert described.file == FMU.name
    assert dict(problem.units) == {"v": "km/h", "wind": "m/s"}


@pytest.mark.parametrize(
    ("header", "changes", "unit"),
    [
        ("time,force,position,sun\ns,N,m,W/m²\n", {}, "W/m2"),
        ("time,force,position,sun [W/m2]\n", {f"{A}.signals": {"sun": "sun [W/m2]"}}, "W/m2"),
        ("time,force,position,sun\n", {"model.units": {"sun": "lx"}}, "lx"),
        ("time,force,position,sun\ns,N,m,W/m2\n", {"model.units": {"sun": "lx"}}, "lx"),
        ("time,force,position,sun\n", {}, ""),
        # the numbers are in another unit then
        ("time,force,position,sun\ns,N,m,W/m2\n", {f"{A}.columns": {"sun": {"factor": 2.0}}}, ""),
    ],
)
def test_a_coefficient_of_a_signal_has_the_unit_of_the_table_or_config(
    tmp_path, header, changes, unit
):
    effect = {"name": "sunny", "site": "der(v)", "form": "linear", "variables": ["sun"]}
    effect["parameters"] = {"k": {"start": 0.1}}
    rows = header + "0,1,2,3\n1,2,3,5\n2,1,2,4\n3,1,3,6\n"
    changes = {f"{A}.signals": {"sun": "sun"}, "effects": [effect], **changes}
    problem = build(tmp_path, changes, rows)
    assert problem.signal_units == {"sun": unit}
    expected = f"m/s^2/({unit})" if "/" in unit else f"m/s^2/{unit}" if unit else ""
    assert coefficient_units(problem) == {"sunny.k": expected}


def test_unused_columns_of_a_file_are_read_with_their_times(tmp_path):
    """For what the model may lack: a closed loop compares residuals with them."""
    (source,) = build(tmp_path, {}).tables
    assert source.experiment == "a"
    assert {"force", "position"} <= set(source.used)
    assert not source.unused().values
    lines = source.path.read_text().splitlines()
    wider = [f"{lines[0]},extra,words"]
    wider += [f"{line},{i * i},ab" for i, line in enumerate(lines[1:])]
    source.path.write_text("\n".join(wider) + "\n")
    unused = source.unused()
    assert list(unused.values) == ["extra"]
    assert unused.values["extra"].tolist() == [0.0, 1.0, 4.0, 9.0]
    middle = 0.5 * (unused.times[:-1] + unused.times[1:])
    assert unused.at("extra", middle) == pytest.approx([0.5, 2.5, 6.5])
    assert unused.at("extra", unused.times + 1e6) is None


def test_short_forms_are_the_long_ones(tmp_path):
    changes = {f"{A}.group": "cell 1", f"{A}.windows": [[0, 1]]}
    (experiment,) = read_config(write_input(tmp_path, changes)).experiments
    assert experiment.inputs["F"].column == "force"
    assert experiment.group == {"": "cell 1"}
    assert experiment.windows == [(0.0, 1.0)]


def test_the_resolved_config_is_the_config():
    changes = {f"{A}.windows": [[0.0, 1.0]], f"{A}.rows": [0, 3], f"{A}.group": "g", "values.n": 3}
    config = parse_config(spoiled_tree(changes), "")
    assert parse_config(tomllib.loads(to_toml(config.model_dump())), "") == config


def test_overrides_reach_into_lists_and_quoted_keys(tmp_path):
    overrides = [
        "parameters.m.bounds.0=0.5",
        "experiments.a.role=test",
        'values."body.m"=2.0',
        "values.der(x)=1",
        "model.solver=rk4",
    ]
    config = read_config(write_input(tmp_path), overrides)
    assert config.parameters["m"].bounds == (0.5, 10.0)
    assert config.experiments[0].role == "test"
    assert config.values == {"c": 0.6, "body.m": 2.0, "der(x)": 1}
    assert config.model.solver == "rk4"
