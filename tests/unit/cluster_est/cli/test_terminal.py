import io
import subprocess
import sys
import threading
import tomllib
from dataclasses import replace
from functools import partial

import pytest
from rich.console import Console
from support.problems.springs import ROOT

from cluster_est.cli import main, terminal
from cluster_est.cli.answer import PrintedAnswer
from cluster_est.cli.terminal import PrintedPlace, WorkerHint
from cluster_est.methods.method import Progress
from cluster_est.running.heartbeat import beating
from cluster_est.running.resources import RunSnapshot


@pytest.mark.parametrize("there", [True, False])
def test_building_the_core_is_announced_where_it_is_not_there(monkeypatch, capsys, there):
    built = []
    monkeypatch.setattr(terminal, "is_built", lambda: there)
    monkeypatch.setattr(terminal, "built", lambda: built.append(capsys.readouterr().err))
    terminal.build_core(PrintedAnswer())
    expected = [] if there else [f"cluster-est: {terminal.BUILDS_CORE}"]
    assert [said.strip() for said in built] == expected
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("installed", [True, False])
def test_the_version_is_that_of_the_project_where_it_is_installed(capsys, monkeypatch, installed):
    if not installed:
        monkeypatch.setattr(sys, "path", [])
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    printed = capsys.readouterr().out
    assert (printed == f"cluster-est {project['version']}\n") is installed
    assert ("not installed" in printed) is not installed


STARTED = """
import sys
from cluster_est.cli import main
import cluster_est.html_report.page
assert "sympy" not in sys.modules, "sympy was imported"
main(["show", sys.argv[1]])
main(["check", sys.argv[2], "--seconds", "0"])
assert "pandas" not in sys.modules, "pandas was imported"
import pandas as pd
import pyarrow as pa
import cluster_est as ce
frame = pd.DataFrame({"t": [0.0, 1.0, 2.0], "y": [1.0, None, 3.0]})
run = ce.Experiment.from_table(frame, id="e", time="t", outputs=["y"])
assert run.outputs[0].values.tolist() == [1.0, 3.0]
assert pa.table({"a": [1]}).to_pandas().a.tolist() == [1]
print("as before")
"""


@pytest.mark.slow
def test_no_command_imports_pandas_and_python_users_lose_nothing(tmp_path):
    config = ROOT / "configs" / "mass_spring_damper.toml"
    command = [sys.executable, "-c", STARTED, str(tmp_path), str(config)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines()[-1:] == ["as before"], done.stderr


def test_without_a_terminal_a_line_is_printed_now_and_then():
    out, now = io.StringIO(), [0.0]
    place = PrintedPlace(Console(file=out, width=80), lambda: now[0])
    for _ in range(2000):
        now[0] += 1.0
        place.put("refitting candidates")
        if now[0] < 30.0:
            assert out.getvalue() == ""
    lines = out.getvalue().splitlines()
    assert 30 < len(lines) < 55
    assert set(lines) == {"cluster-est: refitting candidates"}


def test_more_workers_are_proposed_once_where_they_would_help():
    def said(workers, waiting, cores, most=None):
        hint = WorkerHint(cores, most)
        busy = RunSnapshot(
            "train", Progress(1, 1.0), 9, 9, 0, workers, workers, 0.0, waiting=waiting
        )
        return [
            text for seconds in range(100) if (text := hint.look(replace(busy, seconds=seconds)))
        ]

    (sentence,) = said(1, 30, 8)
    assert "1 of this machine's 8 cores simulates, while 30 simulations wait" in sentence
    assert "faster with executor.workers=8" in sentence
    (sentence,) = said(1, 30, 8, 3)
    assert "1 of this machine's 8 cores simulates" in sentence
    assert "faster with executor.workers=3" in sentence
    assert said(3, 30, 8, 3) == [], "no more than executor.instances are started"
    assert said(8, 30, 8) == said(4, 3, 8) == []


class _Written(io.StringIO):
    """Text that says when a part of it is there."""

    def __init__(self, wanted: str) -> None:
        super().__init__()
        self._wanted, self.there = wanted, threading.Event()

    def write(self, text: str) -> int:
        count = super().write(text)
        if self._wanted in self.getvalue():
            self.there.set()
        return count


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_terminal_alone_sees_that_reading_goes_on(monkeypatch, is_terminal):
    written = _Written("reading config.toml, 0 s")
    console = Console(file=written, force_terminal=is_terminal, width=80)
    monkeypatch.setattr(terminal, "Console", lambda **_: console)
    monkeypatch.setattr(terminal, "beating", partial(beating, seconds=0.01))
    with terminal.alive("reading config.toml"):
        if is_terminal:
            assert written.there.wait(60.0)
    assert bool(written.getvalue()) is is_terminal
