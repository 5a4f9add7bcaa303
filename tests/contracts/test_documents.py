"""The JSON document of every command: its fields, and every sentence that is printed without it."""

import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
from rich.text import Text
from support.problems.springs import ROOT
from support.run_folders import SPRING, leave_as_killed

from cluster_est.cli import entry_point, main, watch_command
from cluster_est.cli.answer import PrintedAnswer
from cluster_est.cli.document import COMMON_FIELDS, FIELDS, fields_of
from cluster_est.cli.entry_point import COMMANDS
from cluster_est.toml import to_toml

LIMITS = """
criterion = "d"
duration = 10.0
sample_time = 0.05
candidates = 10
[inputs.F]
lower = -8.0
upper = 8.0
"""
FMU = str(ROOT / "configs" / "models" / "mass_spring_damper.fmu")
DATA = sorted((ROOT / "configs" / "data" / "mass_spring_damper").glob("*"))
QUICK = ("--no-report", "executor.name=local", "executor.workers=1")
FEW = "closed_loop.max_effects=1"

CASES = {
    "init": ["init", FMU, str(DATA[0]), "--out", "OUT/first.toml"],
    "check": ["check", SPRING, "--seconds", "0"],
    "fit": ["fit", SPRING, "--out", "OUT/fit", *QUICK],
    "close-loop": ["close-loop", SPRING, "--out", "OUT/loop", *QUICK, FEW],
    "sensitivity": ["sensitivity", SPRING, "--out", "OUT/sensitivity", *QUICK],
    "design": ["design", "RUN", "--limits", "OUT/limits.toml", "--out", "OUT/next.csv", *QUICK],
    "simulate": ["simulate", SPRING, "--out", "OUT/curves.csv"],
    "show": ["show", "RUN"],
    "show iterations": ["show", "RUN", "--iterations"],
    "show failures": ["show", "RUN", "--failures"],
    "show a killed run": ["show", "KILLED"],
    "report": ["report", "RUN", "--out", "OUT/report.html"],
    "watch": ["watch", "RUN"],
    "export": ["export", "RUN", "--text", "--modelica", "--csv", "OUT/found.csv"],
    "sweep": ["sweep", "OUT/sweep.toml", "--out", "OUT/sweep"],
    "replay": ["replay", "RUN", "3"],
    "forms": ["forms"],
    "one form": ["forms", "stribeck"],
}
"""Each command as it succeeds; those that write a run are done a second time with --resume."""
AGAIN = {"init": "--overwrite", **dict.fromkeys(("fit", "close-loop", "sensitivity"), "--resume")}
AGAIN["design"] = "--resume"
FAILING = {
    "init": ["init", "none.fmu", "none.csv"],
    "check": ["check", "none.toml"],
    "fit": ["fit", "none.toml", "--out", "OUT/none"],
    "close-loop": ["close-loop", "none.toml", "--out", "OUT/none"],
    "sensitivity": ["sensitivity", "none.toml", "--out", "OUT/none"],
    "design": ["design", "none", "--limits", "none.toml", "--out", "OUT/none.csv"],
    "simulate": ["simulate", "none.toml", "--out", "OUT/none.csv"],
    "show": ["show", "none"],
    "report": ["report", "none"],
    "watch": ["watch", "none"],
    "export": ["export", "none", "--text"],
    "sweep": ["sweep", "none.toml", "--out", "OUT/none"],
    "replay": ["replay", "none", "0"],
    "forms": ["forms", "none"],
}
KINDS = {
    "text": str,
    "number": (int, float),
    "whole number": int,
    "true or false": bool,
    "list": list,
    "object": dict,
}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Puts folders into the arguments of a command."""
    out = tmp_path_factory.mktemp("documents")
    assert main(["fit", SPRING, "--out", str(out / "run"), "experiment_defaults.sigma.y=0.02"]) == 0
    leave_as_killed(Path(shutil.copytree(out / "run", out / "killed")))
    (out / "limits.toml").write_text(LIMITS, encoding="utf-8")
    axis = {"name": "start", "key": "parameters.m.start", "values": [1.0, 3.0]}
    (out / "sweep.toml").write_text(to_toml({"configs": [SPRING], "axes": [axis]}))
    words = {"RUN": str(out / "run"), "KILLED": str(out / "killed"), "OUT": str(out)}

    def put(arguments):
        return [re.sub("RUN|KILLED|OUT", lambda found: words[found[0]], a) for a in arguments]

    return put


def masked(text):
    """A text without its numbers, on one line: some are of clocks."""
    return re.sub(r"[\d.]+(e[+-]?\d+)?", "#", " ".join(text.split()))


def test_there_is_a_case_of_each_command():
    assert {arguments[0] for arguments in CASES.values()} == set(COMMANDS) == set(FIELDS)
    assert set(FAILING) == set(COMMANDS)


@pytest.mark.parametrize("case", CASES)
def test_a_document_has_its_fields_and_every_sentence(place, case, capsys, monkeypatch):
    arguments = place(CASES[case])
    command = arguments[0]
    assert main([*arguments, "--json"]) == 0
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert said.out == f"{json.dumps(document)}\n"
    assert list(document) == [*dict.fromkeys(fields_of(command))]
    for name, field in fields_of(command).items():
        assert document[name] is None or isinstance(document[name], KINDS[field.kind]), name
        words = field.words()
        assert not words or document[name] is None or document[name] in words
    assert (document["command"], document["status"], document["exit_code"]) == (command, "done", 0)

    monkeypatch.setattr(PrintedAnswer, "table", lambda *_, **__: None)
    for name in ("_searches", "_failures"):
        monkeypatch.setattr(watch_command, name, lambda _: Text(""))
    monkeypatch.setenv("COLUMNS", "1000")
    again = [AGAIN[command]] if command in AGAIN else []
    assert main([*arguments, *again]) == 0
    printed = capsys.readouterr()
    sentences = masked(" ".join(document["sentences"]))
    lines = [masked(line) for line in printed.out.splitlines() if line.strip()]
    assert lines or case in ("show iterations",)
    assert [line for line in lines if line not in sentences] == []


@pytest.mark.parametrize("command", FAILING)
def test_an_error_is_a_document_too(place, command, capsys):
    assert main([*place(FAILING[command]), "--json"]) == 2
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["command"], document["status"], document["exit_code"]) == (
        command,
        "bad input",
        2,
    )
    assert document["message"]
    assert f"cluster-est: {document['message']}" in said.err
    assert list(document) == [*dict.fromkeys(fields_of(command))]


@pytest.mark.parametrize(
    ("arguments", "command", "message"),
    [
        (["fit", "x.toml"], "fit", "the following arguments are required: --out"),
        (["fti", "x.toml"], None, "there is no command 'fti'; did you mean 'fit'?"),
    ],
)
def test_so_are_arguments_that_cannot_be_understood(arguments, command, message, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--json"])
    said = capsys.readouterr()
    document = json.loads(said.out)
    assert (document["command"], document["exit_code"]) == (command, 2)
    assert document["message"] == message
    assert message in said.err
    fields = {field.name for field in COMMON_FIELDS} if command is None else fields_of(command)
    assert document.keys() == set(fields)


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (KeyboardInterrupt(), "interrupted", "interrupted"),
        (MemoryError("of an array"), "no solution", "there was not enough memory (MemoryError"),
        (PermissionError(13, "not allowed", "x"), "bad input", "x: the operating system reports"),
        (ZeroDivisionError("of a fault"), "no solution", "ZeroDivisionError: of a fault"),
    ],
    ids=lambda each: type(each).__name__ if isinstance(each, BaseException) else "",
)
def test_so_is_whatever_ends_a_command(error, status, message, capsys, monkeypatch):
    def command(options, answer):
        answer.add(forms=[])
        raise error

    monkeypatch.setattr(entry_point, "run_command", command)
    with (
        pytest.raises(ZeroDivisionError) if isinstance(error, ZeroDivisionError) else nullcontext()
    ):
        main(["forms", "--json"])
    document = json.loads(capsys.readouterr().out)
    assert (document["status"], document["forms"]) == (status, [])
    assert document["message"].startswith(message)


NOISY = """
import os, sys
from cluster_est.cli import entry_point
def command(options, answer):
    os.write(1, b"of an FMU\\n")
    print("of Python")
    answer.say("said")
    return 0
entry_point.run_command = command
sys.argv = ["cluster-est", "forms", *sys.argv[1:]]
entry_point.run()
"""


def test_nothing_else_comes_to_standard_output():
    program = [sys.executable, "-c", NOISY]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run([*program, "--json"], capture_output=True, text=True, env=environment)
    assert json.loads(done.stdout)["sentences"] == ["said"]
    assert done.stdout.count("\n") == 1
    assert {"of an FMU", "of Python"} <= set(done.stderr.splitlines())
    usual = subprocess.run(program, capture_output=True, text=True, env=environment)
    assert usual.stdout.splitlines() == ["of an FMU", "of Python", "said"]


@pytest.mark.parametrize(
    ("criterion", "code"),
    [
        ("parameters.k.value > 40", 0),
        ("parameters.k.value > 20", 3),
        ("run_status != done or failures > 0", 0),
        ("rmse_test < 100", 3),
        ("verdict == found", 3),  # a fit has none
        ("verdict != null and verdict == found", 0),
    ],
)
def test_a_criterion_has_its_exit_code(place, criterion, code, capsys):
    assert main([*place(CASES["show"]), "--json", "--fail-if", criterion]) == code
    said = capsys.readouterr()
    document = json.loads(said.out)
    (judged,) = document["criteria"]
    assert (judged["expression"], judged["met"]) == (criterion, code == 3)
    assert document["exit_code"] == code
    assert document["status"] == ("criterion met" if code == 3 else "done")
    assert (criterion in said.err) is (code == 3)
    assert main([*place(CASES["show"]), "--fail-if", criterion]) == code


def test_an_unknown_name_is_refused_before_the_command_begins(place, capsys):
    out = Path(place(["OUT/never"])[0])
    assert main(["fit", SPRING, "--out", str(out), "--fail-if", "rmse_tst > 1"]) == 2
    assert "did you mean 'rmse_test'?" in capsys.readouterr().err
    assert not out.exists()


def test_a_command_that_fails_keeps_its_own_exit_code(place, capsys):
    arguments = ["fit", SPRING, "--out", *place(["OUT/few"]), *QUICK, "budget.evaluations=6"]
    assert main([*arguments, "--json", "--fail-if", "cost > 0"]) == 1
    document = json.loads(capsys.readouterr().out)
    assert (document["status"], document["exit_code"]) == ("no solution", 1)
    assert document["criteria"][0]["met"]
