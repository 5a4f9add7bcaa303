import io
import json
import os
import shutil
import signal
import threading
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support.problems.springs import spring_problem
from support.reported import fitted_run
from support.run_folders import change_facts, facts

from cluster_est.cli import main
from cluster_est.cli.watch_command import WatchTable, follow, rendered
from cluster_est.methods.method import Progress
from cluster_est.run_folder.run_folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.progress_line import line_of
from cluster_est.running.resources import Budget, RunSnapshot, SearchIteration, TaskOrigin
from cluster_est.studies.fit import fit
from cluster_est.watching.follower import RunFollower, RunView
from workers.messages import Outcome, Status, Task


@pytest.fixture(scope="module")
def ended(tmp_path_factory) -> Path:
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=2)


@pytest.fixture
def copy(ended, tmp_path) -> Path:
    return Path(shutil.copytree(ended, tmp_path / "run"))


@pytest.fixture
def begun(tmp_path) -> RunFolder:
    """The folder of a run that goes on."""
    problem = spring_problem(experiments=2, noise=0.01).problem
    return RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))


def text_of(view: RunView) -> str:
    """What is shown, on one line."""
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(rendered(view))
    return " ".join(console.export_text().split())


def fill(folder: RunFolder, numbers: range) -> None:
    """Log simulations, every third of which failed."""
    for number in numbers:
        good = number % 3 != 0
        origin = TaskOrigin(Task(number, 0, np.zeros(4)), "train", number, "point")
        status = Status.OK if good else Status.TIMEOUT
        message = "" if good else f"took longer than {number} s"
        folder.record(origin, Outcome(number, status, None, None, message, 0.1, "w0"))


def look_at(follower: RunFollower, simulations: int) -> RunView:
    """Look until so many have come: they are written a moment after they were recorded."""
    while (view := follower.look()).simulations < simulations:
        pass
    return view


def test_a_run_is_followed_while_it_grows(begun):
    clock = count()
    follower = RunFollower(begun.path, lambda: float(next(clock)))
    assert follower.look().simulations == 0
    fill(begun, range(9))
    begun.note(SearchIteration("start 0", Progress(0, 5.0), 3))
    begun.note(SearchIteration("start 1", Progress(0, 9.0), 3))
    begun.note(SearchIteration("start 0", Progress(1, 7.0), 6))
    begun.show(RunSnapshot("start 0", Progress(1, 7.0), 6, 9, 3, 2, 4, 12.0))
    view = look_at(follower, 9)
    assert (view.status, view.ended) == ("running", False)
    assert (view.simulations, view.failed) == (9, 3)
    assert [(each.last.search, each.best) for each in view.searches] == [
        ("start 1", 9.0),
        ("start 0", 5.0),
    ]
    for part in (
        "start 0",
        "9 simulations (3 failed)",
        "2/4 workers busy",
        "12.0 s",
        "took longer than 0 s",
    ):
        assert part in text_of(view)
    fill(begun, range(9, 12))
    later = look_at(follower, 12)
    assert later.simulations == 12
    assert later.rate > 0.0
    begun.abandon("interrupted; early", "interrupted")
    last = follower.look()
    assert last.ended
    assert "interrupted; early" in text_of(last)


def test_a_run_that_is_replaced_is_followed_anew(copy):
    follower = RunFollower(copy)
    assert follower.look().simulations > 0
    shutil.rmtree(copy / "evaluations")
    (copy / "progress.jsonl").unlink()
    change_facts(copy, started="later", status="running")
    view = follower.look()
    assert (view.simulations, view.searches, view.status) == (0, (), "running")


def test_nothing_is_written_into_the_folder_and_its_log_is_not_locked(copy):
    before = {path: path.stat().st_mtime_ns for path in copy.rglob("*")}
    seen: list[RunView] = []
    follow(copy, 0.1, seen.append, html=False)
    assert {path: path.stat().st_mtime_ns for path in copy.rglob("*")} == before
    assert len(seen) == 1


def test_it_ends_with_the_run_and_keeps_the_report_fresh(begun):
    problem = spring_problem(experiments=2, noise=0.01).problem
    path = begun.path
    seen: list[RunView] = []
    pages: list[str] = []

    def show(view: RunView) -> None:
        seen.append(view)
        pages.append((path / "report.html").read_text(encoding="utf-8"))

    watcher = threading.Thread(target=lambda: follow(path, 0.05, show, html=True))
    watcher.start()
    while not seen:  # the first look is at a run that goes on
        watcher.join(0.01)
    begun.write(fit(problem, record=begun.record, progress=begun.show, callback=begun.note))
    watcher.join(60.0)
    assert not watcher.is_alive()
    assert (seen[0].status, seen[-1].status) == ("running", "done")
    assert "The run is in progress" in pages[0]
    assert "<body data-reload" in pages[0]
    assert "Fitted to the noise: error " in pages[-1]
    assert "<body data-reload" not in pages[-1]
    assert [p.name for p in path.iterdir() if p.name.startswith(".")] == []


def test_a_report_that_cannot_be_written_is_said_and_nothing_ends(copy):
    (copy / "report.html").unlink(missing_ok=True)
    (copy / "report.html").mkdir()
    seen: list[RunView] = []
    follow(copy, 0.1, seen.append, html=True)
    assert "is a folder" in seen[-1].problem
    assert "the report could not be written" in text_of(seen[-1])


def test_the_command_ends_with_0_and_refuses_what_is_no_run(ended, tmp_path, capsys):
    assert main(["watch", str(ended)]) == 0
    assert "done" in capsys.readouterr().out
    assert main(["watch", str(tmp_path)]) == 2
    assert "has no run.json" in capsys.readouterr().err


def test_ctrl_c_is_130(copy):
    change_facts(copy, status="running")
    report = copy / "report.html"
    report.unlink(missing_ok=True)

    def interrupt_once_there_is_a_report() -> None:
        while not report.is_file():
            main_thread.join(0.01)
        os.kill(os.getpid(), signal.SIGINT)

    main_thread = threading.main_thread()
    threading.Thread(target=interrupt_once_there_is_a_report, daemon=True).start()
    assert main(["watch", str(copy), "--html"]) == 130


def test_names_of_files_are_no_markup(ended):
    view = RunFollower(ended).look()
    hostile = RunView(**{**vars(view), "message": "[red]x[/nothing]"})
    assert "[red]x[/nothing]" in text_of(hostile)


def test_a_terminal_sees_the_table_renewed(ended):
    console = Console(force_terminal=True, width=100, record=True, file=io.StringIO())
    with WatchTable(console) as table:
        table.show(RunFollower(ended).look())
        assert "simulations" in console.export_text()


AT_MOST = RunSnapshot(
    "candidate", Progress(1, 7.0), 6, 9, 3, 2, 4, 12.0,
    "looking for effect 1 of at most 3", 5, 12, 90.0,
)  # fmt: skip


def test_a_watcher_reads_what_the_terminal_of_the_run_says(begun):
    begun.show(AT_MOST)
    said = (
        "looking for effect 1 of at most 3: refitting candidates, 5 of 12 done | "
        "this step: at most about 2 min left"
    )
    assert said in text_of(RunFollower(begun.path).look())
    assert said in line_of(AT_MOST, Budget())


def test_a_folder_of_runs_is_one_document(ended, tmp_path, capsys):
    for name in "ab":
        shutil.copytree(ended, tmp_path / name)
    change_facts(tmp_path / "b", status="running")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "run.json").write_text("{")
    assert main(["watch", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    a, b, broken = told["runs"]
    assert told["run"] == str(tmp_path)
    assert (a["name"], a["status"], b["name"], b["status"]) == ("a", "done", "b", "running")
    assert a["cost"] == facts(ended)["cost"]
    assert a["data"] == b["data"]
    assert (broken["name"], broken["status"]) == ("broken", "unreadable")
    assert [said.partition(":")[0] for said in told["sentences"]] == ["a", "b", "broken"]
    assert main(["watch", str(ended), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["runs"] is None
    (tmp_path / "empty").mkdir()
    assert main(["watch", str(tmp_path / "empty"), "--json"]) == 2
