"""A run that was killed and taken up again gives the bits of one that was not."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.cut_logs import cut, write_log
from support.observed_executor import Observer, observe
from support.run_folders import SPRING, change_facts, facts, facts_without_clocks, leave_as_killed
from support.run_folders import rows as rows_of
from support.thinning import thinned

from cluster_est.cli import main
from cluster_est.run_folder.lock import RunLock
from cluster_est.run_folder.log_segment import read_log

SMALL = ["budget.evaluations=120"]
METHODS = {
    "least_squares": [],
    "sqp": ["method.name=sqp"],
    "nelder_mead": ["method.name=nelder_mead", "method.options.bounds=enforce", *SMALL],
    "pattern_search": ["method.name=pattern_search", *SMALL],
    "de": ["method.name=de", *SMALL],
    "de, early end": [
        "method.name=de",
        "method.options.early_end=true",
        "method.options.population=10",
        *SMALL,
    ],
    "multistart": ["multistart.n=2", "uncertainty.profiles=['m']"],
    "without residuals": ["log.residuals=false"],
    "reduced, without residuals": ["method.name=de", "log.residuals=false", *SMALL],
}
QUICK_LOOP = ["closed_loop.trials=4", "closed_loop.refits=2", "closed_loop.draws=200"]
WIND = (
    'effects=[{name="wind",site="input F",form="coloured_noise",parameters={q={start=0.05,'
    'bounds=[1e-4,10.0],scale="log"},tau={start=0.2,bounds=[0.01,10.0],scale="log"}}}]'
)
PROCESS_NOISE = [
    *QUICK_LOOP,
    'closed_loop.sites=["der(v)"]',
    'closed_loop.effects=["coulomb","cubic"]',
    "closed_loop.pairs=false",
    "experiment_defaults.sigma={y=0.002}",
    WIND,
]
KEPT = "log.keep_residuals=true"
CUTS = ((0.4, 3000), (0.02, 300), (0.8, 0), (0.0, 0), (0.0, 50), (1.0, 0))
"""Shares of the rows that are left, and bytes of what follows."""

Finished = Callable[..., tuple[int, Path]]


@pytest.fixture
def observer(monkeypatch: pytest.MonkeyPatch) -> Observer:
    """Sees what the workers simulate."""
    return observe(monkeypatch)


def run(out: Path, *arguments: str, command: str = "fit") -> int:
    return main([command, SPRING, "--out", str(out), "--no-report", *arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Give the exit code and the folder of a run, which is done once and stays as it is."""

    @cache
    def give(*arguments: str, command: str = "fit") -> tuple[int, Path]:
        out = tmp_path_factory.mktemp("finished") / "run"
        return run(out, *arguments, command=command), out

    return give


@pytest.fixture
def killed(finished: Finished, tmp_path: Path) -> Path:
    """A copy of a fit, as a kill at its end leaves it."""
    copy = Path(shutil.copytree(finished()[1], tmp_path / "run"))
    leave_as_killed(copy)
    return copy


def contents(folder: Path) -> dict[str, bytes]:
    """Every table whose content is not about time, as bytes."""
    tables = sorted(folder.glob("*.parquet"))
    return {each.stem: each.read_bytes() for each in tables if each.stem != "workers"}


def work(folder: Path) -> int:
    return sum(row["simulations"] for row in rows_of(folder, "workers"))


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("evaluations/*.arrows"))


def check_same(found: Path, expected: Path) -> None:
    assert contents(found) == contents(expected)
    assert facts_without_clocks(found) == facts_without_clocks(expected)


@pytest.mark.parametrize(
    ("name", "left"), thinned([*product(METHODS, CUTS)], lambda name, _: name, lambda _, cut: cut)
)
def test_every_method_goes_on_where_it_was(name, left, finished, tmp_path, observer):
    keeps = "without residuals" not in name
    arguments = [*METHODS[name], KEPT] if keeps else METHODS[name]
    code, whole = finished(*arguments)
    again = Path(shutil.copytree(whole, tmp_path / "run"))
    leave_as_killed(again)
    log, (share, torn) = read_log(whole / "evaluations"), left
    rows = int(share * log.num_rows)
    cut(again / "evaluations", rows, torn if rows < log.num_rows else 0)
    observer.simulated.clear()
    assert run(again, "--resume", *arguments) == code
    if keeps:
        assert len(observer.simulated) == log.num_rows - rows
    check_same(again, whole)
    assert work(again) == work(whole)
    resumed = read_log(again / "evaluations")
    for column in ("key", "residuals", "search", "evaluation", "experiment"):
        assert resumed[column].slice(0, rows).equals(log[column].slice(0, rows))
    order = [(column, "ascending") for column in ("key", "want", "evaluation")]
    compared = ["key", "want", "search", "evaluation", "status", "cost"]
    now, then = (each.sort_by(order).select(compared).to_pylist() for each in (resumed, log))
    assert repr(now) == repr(then)  # the text, in which NaN is the same as NaN


@pytest.mark.parametrize(
    "shares", [(0.3,), pytest.param((1.0, 0.7, 0.3, 0.0), marks=pytest.mark.slow)]
)
def test_an_asynchronous_search_goes_the_same_way_as_far_as_it_was(shares, tmp_path, observer):
    arguments = ["method.name=asynchronous_pattern_search", "executor.workers=3", KEPT, *SMALL]
    first, again = tmp_path / "run", tmp_path / "again"
    code = run(first, *arguments)
    for share in shares:
        shutil.copytree(first, again)
        leave_as_killed(again)
        observer.simulated.clear()
        assert run(again, "--resume", *arguments, "executor.workers=1") == code
        assert not observer.simulated
        assert contents(again) == contents(first)
        shutil.rmtree(again)
        keys = read_log(first / "evaluations")["key"].to_pylist()
        rows = int(share * len(keys))
        leave_as_killed(first)
        cut(first / "evaluations", rows)
        code = run(first, "--resume", *arguments)
        assert read_log(first / "evaluations")["key"].to_pylist()[:rows] == keys[:rows]


def test_a_log_that_was_shrunk_is_enough(tmp_path, observer, monkeypatch, capsys):
    monkeypatch.setattr("cluster_est.run_folder.evaluation_log.ROWS_PER_WRITE", 20)
    again, limit = tmp_path / "run", ["log.max_megabytes=0.3", KEPT]
    assert run(again, *limit) == 0
    assert " ".join(capsys.readouterr().err.split()).count("0.3 MB (log.max_megabytes)") == 1
    tables, log = contents(again), read_log(again / "evaluations")
    assert size(again) <= 0.3 * 2**20
    gone = log["residuals"].null_count
    assert 0 < gone < log.num_rows
    leave_as_killed(again)
    observer.simulated.clear()
    assert run(again, "--resume", *limit) == 0
    assert len(observer.simulated) == gone
    assert contents(again) == tables
    assert read_log(again / "evaluations").num_rows == log.num_rows


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("fit", []),
        pytest.param("close-loop", QUICK_LOOP, marks=pytest.mark.slow),
        pytest.param("sensitivity", [], marks=pytest.mark.slow),
    ],
)
def test_a_run_whose_residuals_have_left_gives_the_same_bits_again(
    command, arguments, finished, tmp_path, observer, capsys
):
    code, whole = finished(*arguments, command=command)
    assert code == 0
    log = read_log(whole / "evaluations")
    for column in ("residuals", "trajectory"):
        assert log[column].null_count == log.num_rows
    failed = log.num_rows - log["status"].to_pylist().count("ok")
    assert log["residuals_hash"].null_count == failed
    again = Path(shutil.copytree(whole, tmp_path / "run"))
    leave_as_killed(again)
    observer.simulated.clear()
    assert run(again, "--resume", *arguments, command=command) == 0
    assert len(observer.simulated) == log.num_rows - failed
    check_same(again, whole)
    resumed = read_log(again / "evaluations")
    for column in ("key", "residuals_hash", "cost"):
        assert resumed[column].equals(log[column])
    assert "gave residuals that differ" not in capsys.readouterr().err


def test_residuals_that_are_others_when_simulated_again_are_said(killed, capsys):
    table = read_log(killed / "evaluations")
    place = table.schema.get_field_index("residuals_hash")
    hashes = ["0" * 32, *table["residuals_hash"].to_pylist()[1:]]
    table = table.set_column(place, table.schema.field(place), [hashes])
    write_log(killed / "evaluations", table)
    assert run(killed, "--resume") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "1 of the repeated simulations gave residuals that differ" in said


@pytest.mark.parametrize(
    ("arguments", "share"),
    [
        (QUICK_LOOP, 0.3),
        pytest.param(QUICK_LOOP, 0.9, marks=pytest.mark.slow),
        pytest.param(PROCESS_NOISE, 0.3, marks=pytest.mark.slow),
        pytest.param(PROCESS_NOISE, 0.9, marks=pytest.mark.slow),
    ],
    ids=["plain, early", "plain, late", "process noise, early", "process noise, late"],
)
def test_a_closed_loop_is_resumed(arguments, share, finished, tmp_path, observer):
    code, whole = finished(*arguments, KEPT, command="close-loop")
    assert code == 0
    again = Path(shutil.copytree(whole, tmp_path / "run"))
    leave_as_killed(again)
    log = read_log(whole / "evaluations")
    rows = int(share * log.num_rows)
    cut(again / "evaluations", rows)
    linear = log.slice(0, rows)["want"].to_pylist().count("linearisation")
    observer.simulated.clear()
    assert run(again, "--resume", *arguments, KEPT, command="close-loop") == 0
    assert len(observer.simulated) == log.num_rows - rows + linear
    check_same(again, whole)


def test_a_finished_run_is_shown(tmp_path, observer, capsys):
    folder = tmp_path / "run"
    assert run(folder, "--resume") == 0  # there is nothing to resume: it begins
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    first = capsys.readouterr()
    observer.simulated.clear()
    assert run(folder, "--resume") == 0
    again = capsys.readouterr()
    assert not observer.simulated
    assert again.out == first.out
    assert "is already finished" in again.err
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_run_that_goes_on_has_no_second_writer(how, killed, capsys):
    def files() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in killed.rglob("*") if path.is_file()}

    with RunLock(killed / "evaluations"):
        before = files()
        assert run(killed, how) == 2
        assert files() == before
    said = capsys.readouterr().err
    who = f"process {os.getpid()} on {socket.gethostname()}"
    assert f"another process is running here ({who}); wait for it, or end it" in said
    assert run(killed, how) == 0
    with RunLock(killed / "evaluations"):  # the run has let it go
        pass


def test_a_run_that_was_killed_before_it_began_is_begun(tmp_path):
    (tmp_path / "run" / "evaluations").mkdir(parents=True)
    (tmp_path / "run" / ".config.toml").write_text("half", encoding="utf-8")
    assert run(tmp_path / "run", "--resume") == 0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("parameters.m.start=1.5", "parameters.m.start was 1.0 then and is 1.5 now"),
        ("method.options.trials=2", "method.options.trials was not there then and is 2 now"),
        ("close-loop", "started by another command"),
        ("numpy", "numpy was 0.1 then and is "),
        ("python", "python was 2.7.1 then and is "),
        ("fmu", "the FMU mass_spring_damper.fmu had other contents"),
        ("exp2", "the data of experiment 'exp2' were different"),
        ("format", "its format is 1, and this version of cluster-est writes 2"),
    ],
)
def test_a_run_of_something_else_is_refused(change, said, killed, observer, capsys):
    known = facts(killed)
    known["versions"] |= {change: "2.7.1" if change == "python" else "0.1"}
    known["fmu"] |= {"sha256": ""} if change == "fmu" else {}
    known["experiments"] |= {change: ""}
    known |= {"format": "1"} if change == "format" else {}
    change_facts(killed, **known)
    command = "close-loop" if change == "close-loop" else "fit"
    assert run(killed, "--resume", *([change] if "=" in change else []), command=command) == 2
    assert said in capsys.readouterr().err
    assert not observer.simulated


def test_another_patch_of_python_or_library_that_computes_nothing_is_no_matter(killed):
    versions = facts(killed)["versions"]
    major, minor, _ = versions["python"].split(".")
    change_facts(killed, versions=versions | {"python": f"{major}.{minor}.99", "ray": "0.1"})
    assert run(killed, "--resume") == 0


def test_resume_and_overwrite_exclude_each_other(tmp_path):
    with pytest.raises(SystemExit, match="2"):
        run(tmp_path / "run", "--resume", "--overwrite")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_kills_at_any_instant_change_no_bit(finished, tmp_path):
    arguments = ["method.name=de", "budget.evaluations=800"]
    (code, whole), again = finished(*arguments), tmp_path / "run"
    how = ["--resume", "--no-report", *arguments]
    command = [sys.executable, "-m", "cluster_est", "fit", SPRING, *how]
    generator = np.random.default_rng(5)
    statuses = []
    for _ in range(3):
        process = subprocess.Popen(
            [*command, "--out", str(again)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        before = size(again)
        while process.poll() is None and size(again) == before:
            time.sleep(0.01)
        time.sleep(generator.uniform(0.0, 0.3))
        process.kill()
        process.wait()
        statuses.append(facts(again)["status"])
    assert statuses[0] == "running"
    assert run(again, "--resume", *arguments) == code
    check_same(again, whole)
    ends = [read_log(folder / "evaluations").num_rows for folder in (again, whole)]
    assert ends[0] == ends[1]
