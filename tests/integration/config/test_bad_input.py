"""Whatever is wrong in the input: exit code 2, a line for each problem, and nothing written."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pyarrow import feather
from scipy.io import savemat
from support.spoiled import (
    GUID,
    LIBRARY,
    REMOVED,
    ROWS,
    XML,
    mutate,
    rename,
    spoiled_fmu,
    valid_tree,
    write_input,
)

from cluster_est import build_problem
from cluster_est.cli import main
from cluster_est.config.options import build_method
from cluster_est.config.reader import parse_config
from cluster_est.errors import ClusterEstError

A = "experiments.0"
FIT = ["fit", "config.toml", "--out", "out"]
CHECK = ["check", "config.toml"]
SIMULATE = ["simulate", "config.toml", "--out"]
COLUMNS = {"time": [0.0, 0.1, 0.2], "force": [1.0, 0.0, 0.0], "position": [0.0, 0.01, 0.02]}

Capture = pytest.CaptureFixture[str]
Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture) -> Run:
    """Run a command in the folder of the input; give its exit code and what it said."""
    monkeypatch.chdir(tmp_path)

    def call(arguments: list[str]) -> tuple[int, str]:
        code = main(arguments)
        return code, capsys.readouterr().err

    return call


def refused(run: Run, arguments: list[str], *phrases: str, lines: int = 1) -> None:
    folder = Path.cwd()
    before = sorted(folder.rglob("*"))
    code, said = run(arguments)
    assert code == 2
    assert said.startswith("cluster-est: ")
    assert "Traceback" not in said
    assert said.count("\n") == lines
    for phrase in phrases:
        assert phrase in said
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize(
    ("changes", "phrases"),
    [
        ({"model.fmuu": "x"}, [", line 3: unknown key model.fmuu; did you mean 'fmu'?"]),
        ({f"{A}.outputs": REMOVED}, ["experiments['a'].outputs is missing; add it"]),
        ({"parameters.m.start": "1"}, ["must be a number but is '1'; remove the quotes"]),
        ({"parameters.m.start": 20}, ["parameters.m.start: must lie in its bounds"]),
        (
            {"parameters.m.per": "group:cell"},
            ["experiment 'a': must belong to a group", "group = { cell ="],
        ),
        ({"parameters.mm": {"start": 1.0}}, ["has no variable 'mm'; did you mean 'm'?"]),
        ({f"{A}.time": "tme"}, ["a.csv has no column 'tme'; did you mean 'time'?"]),
        ({f"{A}.data": "b.csv"}, ["there is no file 'b.csv'; looked for b.csv; check the name"]),
        ({f"{A}.data": "out.txt"}, ["there is no file 'out.txt'"]),
        ({f"{A}.windows": [[2, 1]]}, ["must be [from, to] with from before to"]),
        ({f"{A}.sigma": {"y": 0}}, ["sigma.y: must be greater than 0 but is 0"]),
        ({"method.options": {"trails": 3}}, ["has no such option; did you mean 'trials'?"]),
        (
            {"method": {"name": "scipy_least_squares", "options": {"algorithm": "lm"}}},
            ["method.options.algorithm", "cannot keep bounds"],
        ),
        ({"parameters": {}}, ["parameters: at least one must be free to be estimated"]),
        ({"parameters.m.fixed": True, "parameters.k.fixed": True}, ["at least one must be free"]),
    ],
)
@pytest.mark.parametrize("command", [FIT, CHECK])
def test_a_bad_config(tmp_path, run, changes, phrases, command):
    write_input(tmp_path, changes)
    refused(run, command, *phrases)


def test_each_problem_has_a_line(tmp_path, run):
    write_input(tmp_path, {"model.stp": 1, "parameters.m.start": "x", "method.seed": -1})
    refused(run, FIT, "model.stp", "parameters.m.start", "method.seed", lines=3)


@pytest.mark.parametrize(
    ("old", "new", "phrase"),
    [
        ("0.1,", "nan,", "a.csv, column 'time', row 3: the time must be a finite number"),
        ("0.2,", "0.1,", "a.csv, column 'time', row 4: times must increase but 0.1 repeats 0.1"),
        ("0.01", "inf", "a.csv, column 'position', row 3: must be a finite number but is inf"),
        ("0.01", "x", "a.csv, column 'position', row 3: must be a number but is 'x'"),
        ("0.1,1,", "0.1,", "as many cells in each row as in its header, 3, but row 3 has 2"),
        (ROWS, "", "must have a header and rows of numbers but has nothing in it"),
    ],
)
def test_bad_measurements(tmp_path, run, old, new, phrase):
    write_input(tmp_path, rows=ROWS.replace(old, new))
    refused(run, FIT, phrase)


def pop_library(entries: dict[str, bytes]) -> None:
    del entries[LIBRARY]


@pytest.mark.parametrize(
    ("content", "phrases"),
    [
        (b"", ["x.fmu: must be an FMU, which is a zip file, but is not"]),
        (spoiled_fmu()[:9000], ["must be an FMU, which is a zip file, but is not"]),
        (spoiled_fmu(lambda e: e.pop(XML)), ["must hold a modelDescription.xml"]),
        (spoiled_fmu(lambda e: e.update({"../x": b""})), ["the path '../x' in it must stay"]),
        (spoiled_fmu(xml={'fmiVersion="2.0"': 'fmiVersion="3.0"'}), ["variable", "none at all"]),
        (spoiled_fmu(xml={'fmiVersion="2.0"': 'fmiVersion="1.0"'}), ["or 3.0 but is of 1.0"]),
        (
            spoiled_fmu(rename("binaries/linux64", "binaries/linux32")),
            ["must have a binary for linux64, this machine's platform, but has one for darwin64"],
        ),
        (spoiled_fmu(pop_library), ["x.fmu: "]),
        (spoiled_fmu(lambda e: e.update({LIBRARY: b""})), ["cannot be loaded and instantiated"]),
        (
            spoiled_fmu(lambda e: e.update({LIBRARY: random.Random(1).randbytes(9000)})),
            ["x.fmu: cannot be loaded and instantiated", "mass_spring_damper.so"],
        ),
        (
            spoiled_fmu(lambda e: e.update({LIBRARY: e[LIBRARY].replace(b"fmi2DeS", b"xmi2DeS")})),
            ["lacks fmi2DeSerializeFMUstate", "demands of every FMU", "another version"],
        ),
        (spoiled_fmu(xml={GUID: "{0}"}), ["cannot be loaded and instantiated", "GUID differs"]),
    ],
)
def test_a_bad_fmu(tmp_path, run, content, phrases):
    (tmp_path / "x.fmu").write_bytes(content)
    write_input(tmp_path, {"model.fmu": "x.fmu"})
    refused(run, FIT, *phrases)


def test_faults_that_do_no_harm_are_said_by_check(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={'nominal="0.1"': 'nominal="much"'}))
    write_input(tmp_path, {"model.fmu": "x.fmu"})
    assert main(["check", "config.toml"]) == 0
    said = capsys.readouterr()
    assert "x.fmu: attributes nominal that are no number are ignored: 'x'\n" in said.out
    assert said.err == ""


def test_an_out_folder_that_is_not_free(tmp_path, run):
    write_input(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    fit = FIT[:-1]
    refused(run, [*fit, "a.csv"], "a.csv: must be a folder but is a file; choose another --out")
    refused(run, [*fit, "a.csv/x"], "a.csv/x: ", "choose another")
    refused(run, [*fit, "other"], "other: must be new or empty but holds other files")
    refused(run, [*fit, "other", "--overwrite"], "must be new or empty but holds other files")
    assert run([*fit, "run"])[0] in (0, 1)
    refused(run, [*fit, "run"], "run: holds a run already", "--overwrite")
    assert run([*fit, "run", "--overwrite"])[0] in (0, 1)


@pytest.mark.parametrize(
    ("arguments", "phrases"),
    [
        (["fit", "no.toml", "--out", "out"], ["there is no config file no.toml; check the path"]),
        (["check", "."], [".: must be a file that can be read but cannot be (Is a directory)"]),
        (["check", "a.csv"], ["a.csv: must be TOML but is not"]),
        ([*SIMULATE, "out.txt"], ["must end in one of .parquet, .feather, .csv but is 'out.txt'"]),
        ([*SIMULATE, "out.csv", "--run", "."], [".: must be the folder of a finished run"]),
        (["show", "."], ["must be the folder of a run but has no run.json"]),
        ([*CHECK, "trials"], ["'trials': must be key=value"]),
        ([*FIT, "method.sed=1"], ["unknown key method.sed; did you mean 'seed'?"]),
        ([*FIT, "experiments.b.role=test"], ["there is no 'b' in that list; it has 'a'"]),
    ],
)
def test_bad_arguments(tmp_path, run, arguments, phrases):
    write_input(tmp_path)
    refused(run, arguments, *phrases)


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", "config.toml", "--no-such"],
        ["check", "config.toml", "--out", "o", "x=1"],
        [*FIT, "trials"],
        ["fit", "config.toml"],
        ["solve", "config.toml"],
        [],
    ],
)
def test_bad_options(tmp_path, run, capsys, arguments):
    write_input(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as ended:
        run(arguments)
    assert ended.value.code == 2
    assert "cluster-est" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("changes", "rows", "phrase"),
    [
        ({"modle": {}}, ROWS, ": unknown key modle; did you mean 'model'?"),
        ({}, "time,force,position\n0,,\n1,,\n", "experiment 'a'.outputs.y: column 'position' of"),
        ({"model.fmu": "x.fmu"}, ROWS, "x.fmu: must have a binary for linux64"),
    ],
)
def test_a_process_of_its_own_says_no_more(tmp_path, changes, rows, phrase):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(rename("binaries/linux64", "binaries/linux32")))
    write_input(tmp_path, changes, rows)
    before = sorted(tmp_path.rglob("*"))
    command = [sys.executable, "-m", "cluster_est.cli", *FIT]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert phrase in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


def as_mat(path: Path) -> None:
    savemat(path, {name: np.array(values) for name, values in COLUMNS.items()})


def as_mat_columns(path: Path) -> None:
    savemat(path, {name: np.array(values)[:, None] for name, values in COLUMNS.items()})


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("b.csv", lambda path: path.write_text("\ufeff" + ROWS, encoding="utf-8")),
        ("b.csv", lambda path: path.write_text(ROWS.replace(",", ";").replace(".", ","))),
        ("b.csv", lambda path: path.write_text(ROWS.replace("\n", ",\n"))),
        ("b.csv", lambda path: path.write_text(ROWS.replace("0.1,1,0.01", "0.1,,NaN"))),
        ("b.mat", as_mat),
        ("b.mat", as_mat_columns),
        ("b.parquet", lambda path: pq.write_table(pa.table(COLUMNS), path)),
        ("b.feather", lambda path: feather.write_feather(pa.table(COLUMNS), path)),
    ],
)
def test_what_looks_unusual_works(tmp_path, run, name, make: Callable[[Path], Any]):
    make(tmp_path / name)
    write_input(tmp_path, {f"{A}.data": name})
    assert run(CHECK) == (0, "")


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data(), st.randoms(use_true_random=False))
def test_any_config_is_built_or_refused_with_a_sentence(tmp_path, data, chance):
    write_input(tmp_path)
    tree = valid_tree()
    mutate(tree, chance, data)
    try:
        config = parse_config(tree, "c.toml")
        build_method(config)
        build_problem(config, tmp_path)
    except ClusterEstError as error:
        assert str(error)  # noqa: PT017
