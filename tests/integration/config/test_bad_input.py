import random
import subprocess
import sys

import pytest
from support.spoiled import GUID, LIBRARY, XML, rename, spoiled_fmu, write_input

from cluster_est.cli import main

FIT = ["fit", "config.toml", "--out", "out"]
CHECK = ["check", "config.toml"]
SIMULATE = ["simulate", "config.toml", "--out"]


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (b"[model", "must be TOML, but is not: Expected ']' at the end of a table declaration"),
        (b"a = 1\na = 2\n", "must be TOML, but is not: Cannot overwrite a value"),
        (b"a = " + b"[" * 5000, "must be TOML, but is not: maximum recursion"),
        (b"a = " + b"9" * 5000, "must be TOML, but is not"),
        ("# é".encode("latin-1"), "must be text in UTF-8, but is not"),
    ],
    ids=range(5),
)
def test_a_file_that_is_no_config(tmp_path, refused, content, pattern):
    (tmp_path / "config.toml").write_bytes(content)
    refused(CHECK, f"config.toml.*{pattern}")


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    path = write_input(tmp_path)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert main(["check", str(path), "--seconds", "0"]) == 0


def test_what_is_said_is_made_fit_for_a_terminal(refuse):
    """Names of a config may hold what moves a cursor, and be as long as they like."""
    said = refuse({"parameters.a\x1b[1mb\u202eü": 3}, "parameters.'a.*: .*a table.*3")
    assert "\x1b" not in said
    assert "\u202e" not in said
    assert "ü" in said
    assert len(refuse({"model.interface": "a" * 5000}, "'aaa.*aaa")) < 2000


CONFIG = """# a comment
[model]
fmu = "tank.fmu"
[parameters]
UA = { start = 1.0, bounds = [9.0, 1.0] }
"rate.in" = { start = 2.0 }
[parameters.C]
start = 3.0
[experiment_defaults]
columns."Hot flow (kg/min)" = { factor = 60.0 }

[[experiments]]
id = "monday"
outputs = { T = "T_out" }
[[experiments]]
id = 'tuesday'
outputs.T = "T_out"
role = "test"
"""


@pytest.mark.parametrize(
    ("old", "new", "line", "key"),
    [
        ('"tank.fmu"', "3", 3, "model.fmu"),
        ("[9.0, 1.0]", "3", 5, "parameters.UA.bounds"),
        ("start = 2.0", "start = '2'", 6, "parameters.rate.in.start"),
        ("start = 3.0", "scal = 3.0", 8, "unknown key parameters.C.scal"),
        ("start = 3.0", "fixed = false", 7, "parameters.C.start is missing"),
        ("factor = 60.0", "factor = 'x'", 10, "experiment_defaults.columns.Hot flow"),
        ('{ T = "T_out" }', "3", 14, "experiments['monday'].outputs"),
        ('"test"', "3", 18, "experiments['tuesday'].role"),
        ('role = "test"', "", 15, "experiments['tuesday'].data is missing"),
    ],
)
def test_the_line_of_a_key_is_named(tmp_path, capsys, old, new, line, key):
    path = tmp_path / "config.toml"
    path.write_text(CONFIG.replace(old, new), encoding="utf-8")
    assert main(["check", str(path)]) == 2
    assert f"config.toml, line {line}: {key}" in capsys.readouterr().err


def test_a_value_of_the_command_line_is_in_no_line(refuse):
    said = refuse({}, "parameters.m.bounds", more=("parameters.m.bounds=[9, 1]",))
    assert ", line " not in said
    said = refuse({"parameters.m.bounds": [9, 1]}, "m.bounds", more=("parameters.k.start=2",))
    assert ", line " in said


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (b"", "x.fmu: must be an FMU, which is a zip file, but is not"),
        (spoiled_fmu()[:9000], "must be an FMU, which is a zip file, but is not"),
        (spoiled_fmu(lambda e: e.pop(XML)), "must contain a modelDescription.xml"),
        (spoiled_fmu(lambda e: e.update({"../x": b""})), "the path '../x' in it must stay"),
        (
            spoiled_fmu(xml={'fmiVersion="2.0"': 'fmiVersion="3.0"'}),
            "variable.*none to choose from",
        ),
        (spoiled_fmu(xml={'fmiVersion="2.0"': 'fmiVersion="1.0"'}), "or 3.0, but is of 1.0"),
        (
            spoiled_fmu(rename("binaries/linux64", "binaries/linux32")),
            r"a binary for this machine's platform \(linux64\), but has one for darwin64",
        ),
        (spoiled_fmu(lambda e: e.pop(LIBRARY)), "x.fmu: "),
        (
            spoiled_fmu(lambda e: e.update({LIBRARY: random.Random(1).randbytes(9000)})),
            "x.fmu: cannot be loaded and instantiated.*mass_spring_damper.so",
        ),
        (
            spoiled_fmu(lambda e: e.update({LIBRARY: e[LIBRARY].replace(b"fmi2DeS", b"xmi2DeS")})),
            "lacks fmi2DeSerializeFMUstate.*every FMU must have.*another version",
        ),
        (spoiled_fmu(xml={GUID: "{0}"}), "cannot be loaded and instantiated.*GUID differs"),
    ],
    ids=range(11),
)
def test_a_bad_fmu(tmp_path, refused, content, pattern):
    (tmp_path / "x.fmu").write_bytes(content)
    write_input(tmp_path, {"model.fmu": "x.fmu"})
    refused(FIT, pattern)


def test_faults_that_do_no_harm_are_said_by_check(tmp_path, capsys):
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(xml={'nominal="0.1"': 'nominal="much"'}))
    path = write_input(tmp_path, {"model.fmu": "x.fmu"})
    assert main(["check", str(path), "--seconds", "0"]) == 0
    out, error = capsys.readouterr()
    assert "x.fmu: attributes nominal that are not numbers are ignored: 'x'\n" in out
    assert error == ""


def test_an_out_folder_that_is_not_free(tmp_path, refused, capsys):
    write_input(tmp_path)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tex").touch()
    fit = ["fit", "config.toml", "--no-report", "--out"]
    refused([*fit, "a.csv"], "a.csv: must be a folder, but is a file; choose another --out")
    refused([*fit, "a.csv/x"], "a.csv/x: .*choose another")
    refused([*fit, "other"], "other: must be a new or empty folder, but holds other files")
    refused([*fit, "other", "--overwrite"], "must be a new or empty folder, but holds other files")
    assert main([*fit, "run"]) in (0, 1)
    capsys.readouterr()
    refused([*fit, "run"], "run: holds a run already.*--overwrite")
    assert main([*fit, "run", "--overwrite"]) in (0, 1)


@pytest.mark.parametrize(
    ("arguments", "pattern"),
    [
        (["fit", "no.toml", "--out", "out"], "there is no config file no.toml; check the path"),
        (["check", "."], r".: must be a readable file, but is not.*\(Is a directory\)"),
        (["check", "a.csv"], "a.csv: must be TOML, but is not"),
        ([*SIMULATE, "out.txt"], "must end in one of .parquet, .feather, .csv.*'out.txt'"),
        ([*SIMULATE, "out.csv", "--run", "."], ".: must be the folder of a finished run"),
        (["show", "."], "must be the folder of a run, but has no run.json"),
    ],
)
def test_bad_arguments(tmp_path, refused, arguments, pattern):
    write_input(tmp_path)
    refused(arguments, pattern)


NO_SUCH = ["check", "config.toml", "--no-such"]
NO_OUT = ["check", "config.toml", "--out", "o", "x=1"]


@pytest.mark.parametrize(
    "arguments",
    [NO_SUCH, NO_OUT, [*FIT, "trials"], ["fit", "config.toml"], ["solve", "config.toml"], []],
)
def test_bad_options(tmp_path, monkeypatch, capsys, arguments):
    monkeypatch.chdir(tmp_path)
    write_input(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "cluster-est" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_process_of_its_own_says_no_more(tmp_path):
    """What a library would print on its way is not seen in this process."""
    (tmp_path / "x.fmu").write_bytes(spoiled_fmu(rename("binaries/linux64", "binaries/linux32")))
    write_input(tmp_path, {"model.fmu": "x.fmu"})
    before = sorted(tmp_path.rglob("*"))
    command = [sys.executable, "-m", "cluster_est", *FIT]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert "x.fmu: must have a binary for this machine's platform (linux64)" in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before
