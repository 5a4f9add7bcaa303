"""A run followed by its folder, while it is written."""

from __future__ import annotations

import io
import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from support.problems.springs import spring_problem
from support.reported import fitted_run

from cluster_est.cli import main
from cluster_est.cli.display.progress import line
from cluster_est.fit import fit
from cluster_est.methods.base import Progress
from cluster_est.report import watch as watching
from cluster_est.report.watch import RunFollower, RunView, follow
from cluster_est.report.watch_printing import WatchTable, rendered
from cluster_est.run_folder.folder import RunFolder
from cluster_est.run_folder.run_identity import RunIdentity, RunKind
from cluster_est.running.records import Budget, RunSnapshot, SearchIteration, TaskOrigin
from workers.messages import Outcome, Status, Task


@pytest.fixture(scope="module")
def ended(tmp_path_factory) -> Path:
    return fitted_run(tmp_path_factory.mktemp("fit") / "run", experiments=2)


def written(view: RunView) -> str:
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(rendered(view))
    return console.export_text()


def fill(folder: RunFolder, numbers: range, problem) -> None:
    """Log simulations, every third of which failed."""
    for number in numbers:
        good = number % 3 != 0
        origin = TaskOrigin(
            Task(number, 0, np.zeros(len(problem.parameters))), "train", number, "point"
        )
        status = Status.OK if good else Status.TIMEOUT
        message = "" if good else f"took longer than {number} s"
        folder.record(origin, Outcome(number, status, None, None, message, 0.1, "w0"))


def test_a_run_is_followed_while_it_grows(tmp_path):
    problem = spring_problem(experiments=2).problem
    run = RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    clock = iter(range(100))
    follower = RunFollower(tmp_path / "run", lambda: float(next(clock)))
    assert follower.look().simulations == 0
    fill(run, range(9), problem)
    run._log.flush()
    run.note(SearchIteration("start 0", Progress(0, 5.0), 3))
    run.note(SearchIteration("start 1", Progress(0, 9.0), 3))
    run.note(SearchIteration("start 0", Progress(1, 7.0), 6))
    run.show(RunSnapshot("start 0", Progress(1, 7.0), 6, 9, 3, 2, 4, 12.0))
    view = follower.look()
    assert (view.status, view.ended) == ("running", False)
    assert (view.simulations, view.failed) == (9, 3)
    assert [(each.last.search, each.best) for each in view.searches] == [
        ("start 1", 9.0),
        ("start 0", 5.0),
    ]
    text = written(view)
    for part in (
        "start 0",
        "9 simulations (3 failed)",
        "2/4 workers busy",
        "12.0 s",
        "took longer than 0 s",
    ):
        assert part in text
    fill(run, range(9, 12), problem)
    run._log.flush()
    later = follower.look()
    assert later.simulations == 12
    assert later.rate > 0.0
    run.abandon("interrupted; early", "interrupted")
    last = follower.look()
    assert last.ended
    assert "interrupted; early" in written(last)


def test_only_what_is_new_is_read(tmp_path, monkeypatch):
    problem = spring_problem(experiments=2).problem
    run = RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    follower = RunFollower(tmp_path / "run")
    batches = []
    added = follower.tail.counts.add
    monkeypatch.setattr(
        follower.tail.counts, "add", lambda b: (batches.append(b.num_rows), added(b))
    )
    for first in (0, 5, 10):
        fill(run, range(first, first + 5), problem)
        run._log.flush()
        follower.look()
    assert sum(batches) == 15
    run.abandon("over")


def test_a_run_that_is_replaced_is_followed_anew(ended, tmp_path):
    run = Path(shutil.copytree(ended, tmp_path / "run"))
    follower = RunFollower(run)
    before = follower.look().simulations
    assert before > 0
    facts = json.loads((run / "run.json").read_text()) | {"started": "later", "status": "running"}
    shutil.rmtree(run / "evaluations")
    (run / "progress.jsonl").unlink()
    (run / "run.json").write_text(json.dumps(facts))
    view = follower.look()
    assert (view.simulations, view.searches, view.status) == (0, (), "running")


def test_nothing_is_written_into_the_folder_and_its_log_is_not_locked(ended, tmp_path):
    run = Path(shutil.copytree(ended, tmp_path / "run"))
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    seen: list[RunView] = []
    follow(run, 0.1, seen.append, html=False)
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    assert len(seen) == 1


def test_it_ends_with_the_run_and_keeps_the_report_fresh(tmp_path, monkeypatch):
    monkeypatch.setattr(watching, "HTML_SECONDS", 0.05)
    problem = spring_problem(experiments=2, noise=0.01).problem
    path = tmp_path / "run"
    run = RunFolder(path, RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    seen: list[RunView] = []
    pages: list[str] = []

    def show(view: RunView) -> None:
        seen.append(view)
        pages.append((path / "report.html").read_text(encoding="utf-8"))

    watcher = threading.Thread(target=lambda: follow(path, 0.05, show, html=True))
    watcher.start()
    while not seen:  # the first look is at a run that goes on
        watcher.join(0.01)
    result = fit(problem, record=run.record, show=run.show, note=run.note)
    run.write(result)
    watcher.join(60.0)
    assert not watcher.is_alive()
    assert (seen[0].status, seen[-1].status) == ("running", "done")
    assert "The run goes on" in pages[0]
    assert "<body data-reload" in pages[0]
    assert "The fit reached a solution" in pages[-1]
    assert "<body data-reload" not in pages[-1]
    assert [p.name for p in path.iterdir() if p.name.startswith(".")] == []


def test_a_report_that_cannot_be_written_is_said_and_nothing_ends(ended, tmp_path):
    run = Path(shutil.copytree(ended, tmp_path / "run"))
    (run / "report.html").unlink(missing_ok=True)
    (run / "report.html").mkdir()
    seen: list[RunView] = []
    follow(run, 0.1, seen.append, html=True)
    assert "is a folder" in seen[-1].problem
    assert "the report could not be written" in written(seen[-1])


def test_the_command_ends_with_0_and_refuses_what_is_no_run(ended, tmp_path, capsys):
    assert main(["watch", str(ended)]) == 0
    assert "done" in capsys.readouterr().out
    assert main(["watch", str(tmp_path)]) == 2
    assert "has no run.json" in capsys.readouterr().err


def test_ctrl_c_is_130(ended, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(watching, "follow", interrupt)
    assert main(["watch", str(ended)]) == 130


def test_names_of_files_are_no_markup(ended):
    view = RunFollower(ended).look()
    hostile = RunView(**{**vars(view), "message": "[red]x[/nothing]"})
    assert "[red]x[/nothing]" in written(hostile)


def test_a_terminal_sees_the_table_renewed(ended):
    console = Console(force_terminal=True, width=100, record=True, file=io.StringIO())
    with WatchTable(console) as table:
        table.show(RunFollower(ended).look())
        assert "simulations" in console.export_text()


def test_a_watcher_reads_what_the_terminal_of_the_run_says(tmp_path):
    problem = spring_problem(experiments=2).problem
    run = RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    now = RunSnapshot(
        "candidate", Progress(1, 7.0), 6, 9, 3, 2, 4, 12.0,
        "looking for effect 1 of at most 3", 5, 12, 90.0,
    )  # fmt: skip
    run.show(now)
    said = "looking for effect 1 of at most 3: refitting candidates, 5 of 12 done"
    left = "this step: at most about 2 min left"
    assert f"{said} | {left}" in " ".join(written(RunFollower(tmp_path / "run").look()).split())
    assert line(now, Budget()).startswith(f"{said} | {left} | ")


def test_a_watcher_tells_a_limit_from_what_is_expected(tmp_path):
    problem = spring_problem(experiments=2).problem
    run = RunFolder(tmp_path / "run", RunIdentity(RunKind.FIT, problem, "", "hash", 0))
    run.show(
        RunSnapshot(
            "start 3", Progress(1, 7.0), 6, 9, 3, 2, 4, 12.0,
            ended=5, searches=12, left=90.0, at_most=False, pace=30.0,
        )
    )  # fmt: skip
    said = "5 of 12 done | this step: about 2 min left | an iteration takes about 30 s"
    assert said in " ".join(written(RunFollower(tmp_path / "run").look()).split())
