"""Files as loggers write them: read right, or refused with a sentence that says what to do."""

import re
from pathlib import Path

import numpy as np
import pytest
from support.logger_files import CASES, F, T, Y, fmu_with_references, petab_folder, table
from support.odd_logger_files import ODD_CASES
from support.problems.springs import FMU

import cluster_est as ce
from cluster_est.cli import main
from cluster_est.errors import DataError

CHECK = ["check", "first.toml", "--seconds", "0"]


def init(case, path, *more):
    given = [*(("--read", each) for each in case.read), *(("--map", each) for each in case.map)]
    flat = [text for pair in given for text in pair]
    return main(["init", str(FMU), str(path), *flat, "--out", "first.toml", *more])


def assert_signals(experiment, case):
    (force,), (position,) = experiment.inputs, experiment.outputs
    known = np.isfinite(case.y)
    np.testing.assert_allclose(force.times, case.t, rtol=1e-12, atol=2e-7)
    np.testing.assert_allclose(force.values, case.f, rtol=1e-7, atol=1e-12)
    times = (case.t if case.ty is None else case.ty)[known]
    np.testing.assert_allclose(position.times, times, rtol=1e-12, atol=2e-7)
    np.testing.assert_allclose(position.values, case.y[known], rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("case", CASES, ids=lambda each: each.name)
def test_a_file_is_read_right_or_the_way_out_is_said(case, tmp_path, monkeypatch, capsys):
    """`init` writes a config that runs as it is, with the values that were written."""
    monkeypatch.chdir(tmp_path)
    code = init(case, case.make(tmp_path))
    out, err = (" ".join(text.split()) for text in capsys.readouterr())
    if case.refused:
        assert code == 2
        assert re.search(case.refused, err), err
        assert "Traceback" not in err
        return
    assert code == 0, err
    assert re.search(case.notes, out), out
    text = Path("first.toml").read_text(encoding="utf-8")
    for old, new in case.edit:
        assert old in text
        text = text.replace(old, new)
    Path("first.toml").write_text(text, encoding="utf-8")
    assert "FILL IN" not in "\n".join(x for x in text.split("\n") if not x.startswith("#")), text
    assert main(CHECK) == 0, capsys.readouterr().err
    assert_signals(ce.read_problem("first.toml").experiments[0], case)


@pytest.mark.parametrize("case", ODD_CASES, ids=lambda each: each.name)
def test_a_file_that_is_met_less_often_is_read_right_or_the_way_out_is_said(
    case, tmp_path, monkeypatch, capsys
):
    """No config needs an edit where the numbers can be read."""
    monkeypatch.chdir(tmp_path)
    code = init(case, case.make(tmp_path))
    config = Path("first.toml")
    text = config.read_text(encoding="utf-8") if config.exists() else ""
    needs = any("FILL IN" in line for line in text.split("\n") if not line.startswith("#"))
    if not code and not needs:
        code = main(CHECK)
    said = " ".join(" ".join([*capsys.readouterr(), text]).split())
    assert "Traceback" not in said
    if case.said:
        assert re.search(case.said, said), said
        return
    assert (code, needs) == (0, False), said
    assert re.search(case.notes, said), said
    assert_signals(ce.read_problem("first.toml").experiments[0], case)


def test_most_files_need_no_edit():
    good = [case for case in CASES if not case.refused]
    assert len(CASES) >= 60
    assert sum(not case.edit for case in good) >= 50


def test_an_fmu_with_reference_results_is_a_table_of_its_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    fmu = fmu_with_references(tmp_path)
    assert main(["init", str(fmu), "--out", "first.toml"]) == 0
    assert "experiment 'smoke'" in " ".join(capsys.readouterr().out.split())
    assert main(CHECK) == 0
    (found,) = ce.read_problem("first.toml").experiments
    assert (found.id, found.start, found.stop) == ("smoke", 0.0, 1.0)
    np.testing.assert_array_equal(found.inputs[0].values, F)
    np.testing.assert_array_equal(found.outputs[0].times, T[::2][T[::2] <= 1.0])
    np.testing.assert_array_equal(found.outputs[0].values, Y[::2][T[::2] <= 1.0])
    assert main(["init", str(FMU), "--out", "other.toml"]) == 2
    assert "contain reference results (FMI-LS-REF)" in " ".join(capsys.readouterr().err.split())


def test_a_folder_of_tables_is_drafted_with_its_conditions_and_parameters(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "petab"
    folder.mkdir()
    assert main(["init", str(FMU), str(petab_folder(folder)), "--out", "first.toml"]) == 0
    assert main(CHECK) == 0, capsys.readouterr().err
    problem = ce.read_problem("first.toml")
    soft, stiff = problem.experiments
    assert [(e.id, e.role, dict(e.values)) for e in (soft, stiff)] == [
        ("soft", "train", {"c": 0.7, "k": 20.0}),
        ("stiff", "test", {"c": 0.7, "k": 40.0}),
    ]
    for each in (soft, stiff):
        np.testing.assert_array_equal(each.inputs[0].values, F)
        np.testing.assert_array_equal(each.outputs[0].values, Y)
        assert each.outputs[0].sigma == 0.002
    (mass,) = problem.parameters
    assert (mass.name, mass.start, mass.lower, mass.upper, mass.scale) == ("m", 1.5, 0.2, 5, "log")


def write(folder, name, factor):
    (folder / name).write_text(table(f=factor * F), encoding="utf-8")


PATTERN = """[model]
fmu = {fmu!r}
[parameters]
m = {{ start = 1.0, bounds = [0.1, 10.0] }}
[experiment_defaults]
time = "time"
inputs = {{ F = "F" }}
outputs = {{ y = "y" }}
"""


def config(text):
    Path("first.toml").write_text(PATTERN.format(fmu=str(FMU)) + text, encoding="utf-8")


def test_a_pattern_of_files_is_an_experiment_each(tmp_path, monkeypatch):
    """But for those that another entry names; a key of one can be changed as that of any other."""
    monkeypatch.chdir(tmp_path)
    for number in (1, 2, 10):
        write(tmp_path, f"run{number}.csv", number)
    config('[[experiments]]\nid = "bench *"\ndata = "run*.csv"\n'
           '[[experiments]]\nid = "last"\ndata = "run10.csv"\nrole = "test"\n')  # fmt: skip
    runs = ce.read_problem("first.toml", ["experiments.bench run2.weight=4.0"]).experiments
    assert [e.id for e in runs] == ["bench run1", "bench run2", "last"]
    for each, number in zip(runs, (1, 2, 10), strict=True):
        np.testing.assert_allclose(each.inputs[0].values, number * F)
    assert runs[1].outputs[0].sigma == 0.5
    config('[[experiments]]\nid = "*"\ndata = "no*.csv"\n')
    assert main(CHECK) == 2


def test_tests_in_a_file_are_an_experiment_each_and_read_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [f"{run},{t},{run * f},{y}" for run in (3, 7) for t, f, y in zip(T, F, Y, strict=True)]
    Path("all.csv").write_text("\n".join(["test,time,F,y", *rows]), encoding="utf-8")
    config('[[experiments]]\nid = "*"\ndata = "all.csv"\nsplit_by = "test"\n')
    runs = ce.read_problem("first.toml").experiments
    assert [e.id for e in runs] == ["3", "7"]
    for each, number in zip(runs, (3, 7), strict=True):
        np.testing.assert_allclose(each.inputs[0].values, number * F)
    config('[[experiments]]\nid = "a"\ndata = "all.csv"\nsplit_by = "test"\nsplit_value = "8"\n')
    refused = r"split_value: .*all.csv, column 'test': has no value '8'; available: '3', '7'"
    with pytest.raises(DataError, match=refused):
        ce.read_problem("first.toml")


def test_a_column_may_be_named_by_a_part_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content = table(head=("time", "CAN1.F [N]", "CAN1.y [m]"))
    Path("a.csv").write_text(content, encoding="utf-8")
    config('[[experiments]]\nid = "a"\ndata = "a.csv"\ninputs.F = "*.F*"\noutputs.y = "CAN1.y*"\n')
    np.testing.assert_array_equal(ce.read_problem("first.toml").experiments[0].inputs[0].values, F)
    with pytest.raises(
        DataError, match=r"'CAN1\*': must match one column, but matches 'CAN1.F \[N"
    ):
        ce.read_problem("first.toml", ["experiments.a.inputs.F=CAN1*"])


def test_what_was_found_out_is_said_by_check(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_bytes(("by Jürgen\n" + table()).encode("cp1252"))
    config('[[experiments]]\nid = "a"\ndata = "a.csv"\n')
    assert main(["check", "first.toml"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "reading a: its text is not UTF-8 and is read as cp1252, which is a guess" in said
    assert "its header is in row 2" in said


def test_units_below_the_header_are_compared_with_those_of_the_model(tmp_path, monkeypatch, capsys):
    """As `init` does, which writes the factor."""
    monkeypatch.chdir(tmp_path)
    rows = table(y=1e3 * Y, number=lambda x: f"{x:.10g}").replace("time,F,y", "time,F,y\ns,N,mm")
    Path("a.csv").write_text(rows, encoding="utf-8")
    config('[[experiments]]\nid = "a"\ndata = "a.csv"\n')
    assert main(["check", "first.toml"]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "column 'y' in mm is used for y, which is in m, without a conversion" in said
    assert "columns.y = { factor = 0.001, offset = 0 }" in said
    config('[[experiments]]\nid = "a"\ndata = "a.csv"\ncolumns.y = { factor = 0.001 }\n')
    main(["check", "first.toml"])
    assert "as it is" not in capsys.readouterr().out


def test_a_key_that_a_format_has_no_use_for_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "a.csv", 1)
    config('[[experiments]]\nid = "a"\ndata = "a.csv"\n')
    for key, value in (("sheet", "A"), ("time_format", "%H:%M")):
        with pytest.raises(DataError, match=f"{key}: has no meaning for"):
            ce.read_problem("first.toml", [f"experiments.a.{key}={value}"])
