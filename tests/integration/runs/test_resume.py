"""A run that was killed and taken up again gives the bits of one that was not."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support.cut_logs import cut
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.executors.local import LocalExecutor
from cluster_est.run_folder.evaluation_log import read_log
from cluster_est.run_folder.lock import locked
from cluster_est.toml import to_toml
from workers.messages import Outcome

CONFIG = str(ROOT / "configs" / "mass_spring_damper.toml")
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
    "multistart": ["multistart.n=4", "uncertainty.profiles=['m']"],
    "without residuals": ["log.residuals=false"],
    "reduced, without residuals": ["method.name=de", "log.residuals=false", *SMALL],
}
QUICK_LOOP = ["closed_loop.trials=4", "closed_loop.refits=2", "closed_loop.draws=200"]
WIND = (
    'effects=[{name="wind",site="input F",form="coloured_noise",parameters={q={start=0.05,'
    'bounds=[1e-4,10.0],scale="log"},tau={start=0.2,bounds=[0.01,10.0],scale="log"}}}]'
)
LOOPS = {
    "plain": QUICK_LOOP,
    "process noise": [
        *QUICK_LOOP,
        'closed_loop.sites=["der(v)"]',
        'closed_loop.effects=["coulomb","cubic"]',
        "closed_loop.pairs=false",
        "experiment_defaults.sigma={y=0.002}",
        WIND,
    ],
}
KEPT = "log.keep_residuals=true"
CUTS = ((0.0, 0), (0.0, 50), (0.02, 300), (0.4, 3000), (0.8, 0), (1.0, 0))
"""Shares of the rows that are left, and bytes of what follows."""


@pytest.fixture
def simulated(monkeypatch: pytest.MonkeyPatch) -> list[Outcome]:
    """What the workers simulate."""
    done: list[Outcome] = []
    real = LocalExecutor.completed

    def counted(executor: LocalExecutor) -> list[Outcome]:
        found = real(executor)
        done.extend(found)
        return found

    monkeypatch.setattr(LocalExecutor, "completed", counted)
    return done


def fit(out: Path, *arguments: str, command: str = "fit") -> int:
    return main([command, CONFIG, "--out", str(out), *arguments])


def interrupt(run: Path) -> None:
    """Leave of a finished run what a kill leaves of it."""
    facts = read_facts(run)
    kept = ("format", "seed", "started", "config_hash", "fmu", "experiments", "versions")
    running = {"status": "running", "verdict": None, **{key: facts[key] for key in kept}}
    (run / "run.json").write_text(json.dumps(running), encoding="utf-8")
    for table in run.glob("*.parquet"):
        table.unlink()


def read_facts(run: Path) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads((run / "run.json").read_text(encoding="utf-8"))
    return facts


def contents(run: Path) -> dict[str, bytes]:
    """Every table whose content is not about time, as bytes."""
    tables = sorted(run.glob("*.parquet"))
    return {each.stem: each.read_bytes() for each in tables if each.stem != "workers"}


def untimed(run: Path) -> dict[str, Any]:
    facts = read_facts(run)
    return {key: value for key, value in facts.items() if key not in ("seconds", "started")}


def work(run: Path) -> int:
    return sum(row["simulations"] for row in pq.read_table(run / "workers.parquet").to_pylist())


@pytest.mark.parametrize("name", METHODS)
def test_every_method_goes_on_where_it_was(
    name: str, tmp_path: Path, simulated: list[Outcome]
) -> None:
    whole, run, arguments = tmp_path / "whole", tmp_path / "run", METHODS[name]
    arguments = [*arguments, KEPT] if "without residuals" not in name else arguments
    code = fit(whole, *arguments)
    total = len(simulated)
    log = read_log(whole / "evaluations")
    assert log.num_rows == total
    for share, torn in CUTS:
        shutil.copytree(whole, run)
        interrupt(run)
        rows = int(share * total)
        cut(run / "evaluations", rows, torn if rows < total else 0)
        simulated.clear()
        assert fit(run, "--resume", *arguments) == code
        if "without residuals" not in name:
            assert len(simulated) == total - rows
        assert contents(run) == contents(whole)
        assert untimed(run) == untimed(whole)
        assert work(run) == work(whole)
        again = read_log(run / "evaluations")
        for column in ("key", "residuals", "search", "evaluation", "experiment"):
            assert again[column].slice(0, rows).equals(log[column].slice(0, rows))
        columns = [(column, "ascending") for column in ("key", "want", "evaluation")]
        compared = ["key", "want", "search", "evaluation", "status", "cost"]
        now, then = (each.sort_by(columns).select(compared).to_pylist() for each in (again, log))
        assert repr(now) == repr(then)  # the text, in which NaN is the same as NaN
        shutil.rmtree(run)


def test_an_asynchronous_search_goes_the_same_way_as_far_as_it_was(
    tmp_path: Path, simulated: list[Outcome]
) -> None:
    arguments = ["method.name=asynchronous_pattern_search", "executor.workers=3", KEPT, *SMALL]
    run, again = tmp_path / "run", tmp_path / "again"
    code = fit(run, *arguments)
    for share in (1.0, 0.7, 0.3, 0.0):
        shutil.copytree(run, again)
        interrupt(again)
        simulated.clear()
        assert fit(again, "--resume", *arguments, "executor.workers=1") == code
        assert not simulated
        assert contents(again) == contents(run)
        shutil.rmtree(again)
        keys = read_log(run / "evaluations")["key"].to_pylist()
        rows = int(share * len(keys))
        interrupt(run)
        cut(run / "evaluations", rows)
        code = fit(run, "--resume", *arguments)
        assert read_log(run / "evaluations")["key"].to_pylist()[:rows] == keys[:rows]


def test_a_run_of_threads_can_be_resumed_by_one(tmp_path: Path, simulated: list[Outcome]) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    assert fit(whole) == 0
    assert fit(run, "executor.workers=3", KEPT) == 0
    interrupt(run)
    total = read_log(run / "evaluations").num_rows
    cut(run / "evaluations", total // 2)
    simulated.clear()
    assert fit(run, "--resume") == 0
    assert len(simulated) == total - total // 2
    assert contents(run) == contents(whole)


def test_a_log_that_was_shrunk_is_enough(
    tmp_path: Path,
    simulated: list[Outcome],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("cluster_est.run_folder.evaluation_log.ROWS_PER_WRITE", 20)
    run, limit = tmp_path / "run", ["log.max_megabytes=0.3", KEPT]
    assert fit(run, *limit) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("the log has reached 0.3 MB (log.max_megabytes)") == 1
    tables, log = contents(run), read_log(run / "evaluations")
    size = sum(path.stat().st_size for path in (run / "evaluations").iterdir())
    assert size <= 0.3 * 2**20
    gone = log["residuals"].null_count
    assert 0 < gone < log.num_rows
    interrupt(run)
    simulated.clear()
    assert fit(run, "--resume", *limit) == 0
    assert len(simulated) == gone
    assert contents(run) == tables
    assert read_log(run / "evaluations").num_rows == log.num_rows


@pytest.mark.parametrize("command", ["fit", "close-loop", "sensitivity"])
def test_a_run_whose_residuals_have_left_gives_the_same_bits_again(
    command: str,
    tmp_path: Path,
    simulated: list[Outcome],
    capsys: pytest.CaptureFixture[str],
) -> None:
    run, arguments = tmp_path / "run", QUICK_LOOP if command == "close-loop" else []
    assert fit(run, *arguments, command=command) == 0
    before, tables, facts = len(simulated), contents(run), untimed(run)
    log = read_log(run / "evaluations")
    for column in ("residuals", "trajectory"):
        assert log[column].null_count == log.num_rows
    failed = log["status"].to_pylist().count("ok") - log.num_rows
    assert log["residuals_hash"].null_count == -failed
    interrupt(run)
    simulated.clear()
    assert fit(run, "--resume", *arguments, command=command) == 0
    assert len(simulated) == before + failed
    assert contents(run) == tables
    assert untimed(run) == facts
    again = read_log(run / "evaluations")
    for column in ("key", "residuals_hash", "cost"):
        assert again[column].equals(log[column])
    assert "other residuals" not in capsys.readouterr().err


def test_residuals_that_are_others_when_simulated_again_are_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert fit(run) == 0
    interrupt(run)
    segment = run / "evaluations" / "00000.arrows"
    table = read_log(run / "evaluations")
    place = table.schema.get_field_index("residuals_hash")
    hashes = ["0" * 32, *table["residuals_hash"].to_pylist()[1:]]
    table = table.set_column(place, table.schema.field(place), [hashes])
    with pa.ipc.new_stream(segment, table.schema) as writer:
        writer.write_table(table)
    capsys.readouterr()
    assert fit(run, "--resume") == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "1 of the simulations that were done again gave other residuals" in said


@pytest.mark.parametrize("name", LOOPS)
def test_a_closed_loop_is_resumed(name: str, tmp_path: Path, simulated: list[Outcome]) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    arguments = [*LOOPS[name], KEPT]
    assert fit(whole, *arguments, command="close-loop") == 0
    total = len(simulated)
    log = read_log(whole / "evaluations")
    for share in (0.3, 0.9):
        shutil.copytree(whole, run)
        interrupt(run)
        rows = int(share * total)
        cut(run / "evaluations", rows)
        linear = log.slice(0, rows)["want"].to_pylist().count("linearisation")
        simulated.clear()
        assert fit(run, "--resume", *arguments, command="close-loop") == 0
        assert len(simulated) == total - rows + linear
        assert contents(run) == contents(whole)
        assert untimed(run) == untimed(whole)
        shutil.rmtree(run)


def test_an_interrupted_run_is_resumed(
    tmp_path: Path, simulated: list[Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, run = tmp_path / "whole", tmp_path / "run"
    assert fit(whole) == 0
    simulated.clear()
    real = LocalExecutor.completed

    def stopped(executor: LocalExecutor) -> list[Outcome]:
        if len(simulated) > 60:
            monkeypatch.setattr(LocalExecutor, "completed", real)
            raise KeyboardInterrupt
        return real(executor)

    monkeypatch.setattr(LocalExecutor, "completed", stopped)
    assert fit(run) == 130
    assert read_facts(run)["status"] == "interrupted"
    assert fit(run, "--resume") == 0
    assert contents(run) == contents(whole)
    asked = read_log(run / "evaluations").select(["key", "want"]).to_pylist()
    assert len(asked) == len({tuple(row.values()) for row in asked})


def test_a_sweep_resumes_the_run_that_was_under_way(
    tmp_path: Path, simulated: list[Outcome]
) -> None:
    axis = {"name": "start", "key": "parameters.m.start", "values": [1.0, 2.0]}
    sweep, out = tmp_path / "sweep.toml", tmp_path / "out"
    kept = {"log.keep_residuals": True}
    tree = {"configs": [CONFIG], "axes": [axis], "overrides": kept}
    sweep.write_text(to_toml(tree), encoding="utf-8")
    assert main(["sweep", str(sweep), "--out", str(out)]) == 0
    run = out / "mass_spring_damper-start_2.0"
    before = contents(run)
    interrupt(run)
    total = read_log(run / "evaluations").num_rows
    cut(run / "evaluations", 100, 2000)
    simulated.clear()
    assert main(["sweep", str(sweep), "--out", str(out)]) == 0
    assert len(simulated) == total - 100
    assert contents(run) == before


def test_a_finished_run_is_shown(
    tmp_path: Path, simulated: list[Outcome], capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert fit(run, "--resume") == 0  # there is nothing to resume: it begins
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    first = capsys.readouterr()
    simulated.clear()
    assert fit(run, "--resume") == 0
    again = capsys.readouterr()
    assert not simulated
    assert again.out == first.out
    assert "holds a finished run" in again.err
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before


def test_a_run_that_goes_on_is_not_resumed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert fit(run) == 0
    interrupt(run)
    before = size(run)
    with locked(run / "evaluations"):
        assert fit(run, "--resume") == 2
    assert "another process is at work here" in capsys.readouterr().err
    assert size(run) == before
    assert fit(run, "--resume") == 0


def test_a_run_that_was_killed_before_it_began_is_begun(tmp_path: Path) -> None:
    run = tmp_path / "run"
    (run / "evaluations").mkdir(parents=True)
    (run / ".config.toml").write_text("half", encoding="utf-8")
    assert fit(run, "--resume") == 0


def test_a_larger_budget_takes_a_run_further(tmp_path: Path, simulated: list[Outcome]) -> None:
    run, whole = tmp_path / "run", tmp_path / "whole"
    assert fit(whole) == 0
    total = len(simulated)
    assert fit(run, "budget.evaluations=20") == 1
    simulated.clear()
    assert fit(run, "--resume") == 0
    assert len(simulated) < total
    assert contents(run) == contents(whole)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (["parameters.m.start=1.5"], "parameters.m.start was 1.0 and is 1.5"),
        (["method.options.trials=2"], "method.options.trials was not there and is 2"),
        (["close-loop"], "begun by another command"),
        (["numpy"], "numpy was 0.1 and is "),
        (["python"], "python was 2.7.1 and is "),
        (["fmu"], "mass_spring_damper.fmu was another FMU"),
        (["exp2"], "the data of experiment 'exp2' were others"),
        (["format"], "its format is 1 and this version writes 2"),
    ],
)
def test_a_run_of_something_else_is_refused(
    change: list[str],
    said: str,
    tmp_path: Path,
    simulated: list[Outcome],
    capsys: pytest.CaptureFixture[str],
) -> None:
    run = tmp_path / "run"
    assert fit(run) == 0
    facts, (name,) = read_facts(run), change
    facts["versions"] |= {name: "2.7.1" if name == "python" else "0.1"}
    facts["fmu"] |= {"sha256": ""} if name == "fmu" else {}
    facts["experiments"] |= {name: ""}
    facts |= {"format": "1"} if name == "format" else {}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    simulated.clear()
    capsys.readouterr()
    command = "close-loop" if name == "close-loop" else "fit"
    assert fit(run, "--resume", *(change if "=" in name else []), command=command) == 2
    assert said in capsys.readouterr().err
    assert not simulated


def test_another_patch_of_python_or_library_that_computes_nothing_is_no_matter(
    tmp_path: Path,
) -> None:
    run = tmp_path / "run"
    assert fit(run) == 0
    interrupt(run)
    facts = read_facts(run)
    major, minor, _ = facts["versions"]["python"].split(".")
    facts["versions"] |= {"python": f"{major}.{minor}.99", "ray": "0.1"}
    (run / "run.json").write_text(json.dumps(facts), encoding="utf-8")
    assert fit(run, "--resume") == 0


def test_resume_and_overwrite_exclude_each_other(tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as error:
        fit(tmp_path / "run", "--resume", "--overwrite")
    assert error.value.code == 2


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_kills_at_any_instant_change_no_bit(tmp_path: Path) -> None:
    arguments = ["method.name=de", "budget.evaluations=800"]
    whole, run = tmp_path / "whole", tmp_path / "run"
    code = fit(whole, *arguments)
    command = [sys.executable, "-m", "cluster_est.cli", "fit", CONFIG, "--resume", *arguments]
    generator = np.random.default_rng(5)
    statuses = []
    for _ in range(3):
        process = subprocess.Popen(
            [*command, "--out", str(run)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        before = size(run)
        while process.poll() is None and size(run) == before:
            time.sleep(0.01)
        time.sleep(generator.uniform(0.0, 0.3))
        process.kill()
        process.wait()
        statuses.append(read_facts(run)["status"])
    assert statuses[0] == "running"
    assert fit(run, "--resume", *arguments) == code
    assert contents(run) == contents(whole)
    assert untimed(run) == untimed(whole)
    ends = [read_log(folder / "evaluations").num_rows for folder in (run, whole)]
    assert ends[0] == ends[1]


def size(run: Path) -> int:
    return sum(path.stat().st_size for path in run.glob("evaluations/*.arrows"))
