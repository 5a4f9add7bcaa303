import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.run_folders import SPRING, facts, facts_without_clocks, tables

from cluster_est.cli import main
from cluster_est.run_folder.context import RunContext

resource = pytest.importorskip("resource", reason="files can be limited on Unix alone")
QUICK = ["--no-report", "budget.evaluations=60"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "run"
    assert run(out) == 0
    return out


def run(out: Path, *arguments: str) -> int:
    return main(["fit", SPRING, "--out", str(out), *QUICK, *arguments])


@contextmanager
def files_up_to(size: int) -> Iterator[None]:
    """No file may grow beyond so many bytes: to who writes it that is a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    bytecode, sys.dont_write_bytecode = sys.dont_write_bytecode, True  # it would be cut, unnoticed
    try:
        yield
    finally:
        sys.dont_write_bytecode = bytecode
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def check_one_sentence(said: str, file: Path) -> None:
    assert said.count("\n") == 1
    assert f"{file}: cannot be written" in said
    assert "space" in said


@pytest.mark.parametrize(
    ("size", "more", "file"),
    [
        (100, [], "config.toml"),
        (6000, [], "evaluations"),
        (60_000, [], "evaluations"),
        (80_000, ["log.residuals=false"], "residuals.parquet"),
    ],
)
def test_a_full_disk_is_said_and_the_run_goes_on_when_there_is_room(
    size: int, more: list[str], file: str, whole: Path, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "run"
    with files_up_to(size):
        assert run(out, *more) == 2
    said = capsys.readouterr().err
    check_one_sentence(said, out / file)
    if file != "config.toml":
        assert "--resume" in said
        assert facts(out)["status"] == "interrupted"
    assert run(out, "--resume") == 0
    assert tables(out) == tables(whole)
    assert facts_without_clocks(out) == facts_without_clocks(whole)


def test_a_table_that_cannot_be_written_leaves_the_one_that_was_there(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    out = tmp_path / "simulated.csv"
    out.write_text("before")
    with files_up_to(1000):
        assert main(["simulate", SPRING, "--run", str(whole), "--out", str(out)]) == 2
    check_one_sentence(capsys.readouterr().err, out)
    assert out.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["simulated.csv"]


def test_a_folder_that_is_gone_at_the_end_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    finish, out = RunContext.finish, tmp_path / "run"

    def removed(context, result):
        shutil.rmtree(out)
        return finish(context, result)

    monkeypatch.setattr(RunContext, "finish", removed)
    assert run(out) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert str(out) in said
    assert "No such file" in said


def command(stdout: int, *arguments: str) -> tuple[int, str]:
    """The exit code of a program that prints there, and what it says on standard error."""
    program = [sys.executable, "-m", "cluster_est", *arguments]
    ended = subprocess.run(program, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)
    os.close(stdout)
    return ended.returncode, ended.stderr


def closed_pipe() -> int:
    reader, writer = os.pipe()
    os.close(reader)
    return writer


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no such device")
def test_standard_output_that_is_full_is_said(whole: Path) -> None:
    code, said = command(os.open("/dev/full", os.O_WRONLY), "show", str(whole))
    assert code == 2
    assert said.startswith("cluster-est: standard output: cannot be written")
    assert said.count("\n") == 1


def test_standard_output_that_nobody_reads_is_no_matter(whole: Path) -> None:
    assert command(closed_pipe(), "show", str(whole)) == (0, "")


@pytest.mark.slow
def test_a_run_whose_output_nobody_reads_reaches_its_end(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert command(closed_pipe(), "fit", SPRING, "--out", str(out), *QUICK) == (0, "")
    assert tables(out) == tables(whole)
