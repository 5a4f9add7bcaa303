"""Sweeps from the command line: what is run, what is skipped, and what is said."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
import ray
from support.problems.springs import ROOT

from cluster_est.cli import main
from cluster_est.configured_run import ConfiguredFit, ConfiguredRun, Destination, RunEnd
from cluster_est.errors import ExecutorError
from cluster_est.executors.local import LocalExecutor
from cluster_est.run_folder.folder import RunFolder
from cluster_est.run_folder.lock import locked_by_sweep
from cluster_est.running.environment import RunEnvironment
from cluster_est.sweep import run as sweep_run
from cluster_est.toml import to_toml

STARTS = {"name": "start", "key": "parameters.m.start", "values": [1.0, 3.0]}
DATA = {
    "name": "data",
    "values": {"all": {}, "some": {"only_experiments": ["exp1", "exp4"]}},
}
HASTY = {"name": "hasty", "overrides": {"method.options.max_iterations": 1}}
NAMES = ["spring-start_1.0-all", "spring-start_1.0-some", "spring-start_3.0-all",
         "spring-start_3.0-some"]  # fmt: skip

Sweep = Callable[..., tuple[int, str, str]]
Fits = list[str]


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> Fits:
    """The folders of the fits that are really done."""
    done: Fits = []
    real = sweep_run.do_run

    def counted(run: ConfiguredRun, to: Destination, *others: Any) -> RunEnd:
        done.append(to.out.name)
        return real(run, to, *others)

    monkeypatch.setattr(sweep_run, "do_run", counted)
    return done


@pytest.fixture
def sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Sweep:
    """Sweep over the embedded example in a folder of its own: exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "configs" / "mass_spring_damper.toml", "spring.toml")
    shutil.copytree(ROOT / "configs" / "data" / "mass_spring_damper", "data/mass_spring_damper")
    Path("models").mkdir()
    shutil.copy(ROOT / "configs" / "models" / "mass_spring_damper.fmu", "models")

    def call(*arguments: str, **keys: Any) -> tuple[int, str, str]:
        tree = {"configs": ["spring.toml"], "axes": [STARTS, DATA], **keys}
        Path("sweep.toml").write_text(to_toml(tree), encoding="utf-8")
        code = main(["sweep", "sweep.toml", "--out", "out", *arguments])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return code, said.out, said.err

    return call


def facts(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(Path("out", name, "run.json").read_text(encoding="utf-8"))
    return found


def test_a_sweep_gives_what_single_fits_give(sweep, fits):
    code, printed, _ = sweep()
    assert code == 0
    assert sorted(fits) == NAMES
    rows = pq.read_table("out/summary.parquet").to_pylist()
    assert [row["run"] for row in rows] == NAMES
    assert [(row["config"], row["start"], row["data"]) for row in rows[1:3]] == [
        ("spring", "1.0", "some"),
        ("spring", "3.0", "all"),
    ]
    assert main(["fit", "spring.toml", "--out", "alone", "parameters.m.start=3.0"]) == 0
    alone = pq.read_table("alone/parameters.parquet").to_pylist()
    swept = pq.read_table("out/spring-start_3.0-all/parameters.parquet").to_pylist()
    # As text: NaN is not equal to itself. A pool that stayed must change no bit.
    assert repr(swept) == repr(alone)
    assert rows[2]["parameter m"] == alone[0]["value"]
    assert rows[2]["cost"] == facts(NAMES[2])["cost"]
    assert list(facts(NAMES[1])["experiments"]) == ["exp1", "exp4"]
    for name in NAMES:
        assert name in printed


def test_what_is_done_is_skipped_until_it_changes(sweep, fits):
    assert sweep()[0] == 0
    fits.clear()
    code, printed, _ = sweep()
    assert (code, fits) == (0, [])
    assert "4 runs: 4 done; 0 of them in this call" in printed
    # Where and for how long does not matter; a third start does not touch the others.
    sweep(overrides={"executor.workers": 2, "budget.evaluations": 9000})
    assert fits == []
    sweep(axes=[STARTS | {"values": [1.0, 3.0, 2.0]}, DATA])
    assert sorted(fits) == ["spring-start_2.0-all", "spring-start_2.0-some"]
    fits.clear()
    table = Path("data/mass_spring_damper/exp2.csv")
    table.write_text("\n".join(table.read_text().splitlines()[:-1]) + "\n")
    sweep()
    assert sorted(fits) == ["spring-start_1.0-all", "spring-start_3.0-all"]
    fits.clear()
    sweep(overrides={"method.seed": 1})
    assert sorted(fits) == NAMES


def test_other_versions_run_again(sweep, fits):
    sweep(axes=[])
    path = Path("out/spring/run.json")
    old = facts("spring")
    old["versions"]["numpy"] = "1.0"
    path.write_text(json.dumps(old))
    sweep(axes=[])
    assert fits == ["spring", "spring"]


def test_a_failed_run_is_not_tried_again_unless_asked(sweep, fits):
    code, printed, _ = sweep(axes=[STARTS], runs=[HASTY])
    assert code == 1
    assert "2 done, 1 not converged; 3 of them" in printed
    (row,) = [r for r in pq.read_table("out/summary.parquet").to_pylist() if r["run"] == "hasty"]
    assert row["message"] == facts("hasty")["message"] != ""
    fits.clear()
    assert sweep(axes=[STARTS], runs=[HASTY])[0] == 1
    assert fits == []
    assert sweep("--retry-failed", axes=[STARTS], runs=[HASTY])[0] == 1
    assert fits == ["hasty"]
    patient = HASTY | {"overrides": {"method.options.max_iterations": 50}}
    assert sweep(axes=[STARTS], runs=[patient])[0] == 0
    assert fits == ["hasty", "hasty"]


def test_a_larger_budget_tries_again(sweep, fits):
    assert sweep(axes=[], overrides={"budget.evaluations": 10})[0] == 1
    assert sweep(axes=[], overrides={"budget.evaluations": 10})[0] == 1
    assert fits == ["spring"]
    assert sweep(axes=[], overrides={"budget.evaluations": 1000})[0] == 0
    assert fits == ["spring", "spring"]


def test_whatever_goes_wrong_in_a_run_is_its_own(sweep, fits, monkeypatch):
    real = ConfiguredFit.compute

    def broken(run: ConfiguredFit, environment: RunEnvironment) -> Any:
        if fits[-1] == NAMES[0]:
            raise FloatingPointError("out of luck")
        return real(run, environment)

    monkeypatch.setattr(ConfiguredFit, "compute", broken)
    code, printed, _ = sweep()
    assert code == 1
    assert "4 runs: 1 failed, 3 done" in printed
    said = facts(NAMES[0])["message"]
    assert said == "FloatingPointError: out of luck; stopped before the first simulation"


@pytest.mark.parametrize(
    ("error", "expected"), [(KeyboardInterrupt(), 130), (ExecutorError("no workers"), 2)]
)
def test_the_next_call_goes_on_where_one_stopped(sweep, fits, monkeypatch, error, expected):
    real = ConfiguredFit.compute

    def stopping(run: ConfiguredFit, environment: RunEnvironment) -> Any:
        if len(fits) == 3:
            raise error
        return real(run, environment)

    monkeypatch.setattr(ConfiguredFit, "compute", stopping)
    assert sweep()[0] == expected
    rows = pq.read_table("out/summary.parquet").to_pylist()
    assert sorted(row["status"] for row in rows) == ["done", "done", "not run", "not run"]
    monkeypatch.setattr(ConfiguredFit, "compute", real)
    first, stopped = fits[:2], fits[2]
    fits.clear()
    assert sweep()[0] == 0
    assert sorted(first + fits) == NAMES  # each once
    assert fits[0] == stopped


def test_an_interrupt_among_many_starts_ends_the_sweep(sweep, fits, monkeypatch):
    # Some starts have ended then: the fit could give the best of them, but it is not done.
    completed, note = LocalExecutor.completed, RunFolder.note
    ended: list[str] = []

    def interrupted(executor: LocalExecutor) -> Any:
        if len(ended) == 2:
            ended.append("and no more interrupts")
            raise KeyboardInterrupt
        return completed(executor)

    def noted(folder: RunFolder, iteration: Any) -> None:
        note(folder, iteration)
        if iteration.progress.ending:
            ended.append(iteration.search)

    monkeypatch.setattr(LocalExecutor, "completed", interrupted)
    monkeypatch.setattr(RunFolder, "note", noted)
    many = {"multistart.n": 5, "multistart.at_once": 2}
    assert sweep(axes=[STARTS], overrides=many)[0] == 130
    assert len(fits) == 1
    assert facts(fits[0])["status"] == "interrupted"
    assert sweep(axes=[STARTS], overrides=many)[0] == 0
    assert len(fits) == 3


def test_a_run_that_was_killed_is_done_again(sweep, fits):
    sweep(axes=[])
    running = facts("spring") | {"status": "running"}
    Path("out/spring/run.json").write_text(json.dumps(running))
    assert sweep(axes=[])[0] == 0
    Path("out/spring/run.json").write_text("{")
    assert sweep(axes=[])[0] == 0
    shutil.rmtree("out/spring")
    Path("out/spring/evaluations").mkdir(parents=True)
    Path("out/spring/config.toml").touch()
    assert sweep(axes=[])[0] == 0
    assert fits == ["spring"] * 4


def test_every_mistake_is_said_before_anything_runs(sweep):
    axis = {
        "name": "try",
        "values": {
            "good": {},
            "subset": {"only_experiments": ["exp9"]},
            "method": {"method.name": "lest_squares"},
            "local": {"parameters.q": {"start": 1.0}},
        },
    }
    code, printed, errors = sweep(axes=[STARTS, axis])
    assert (code, printed) == (2, "")
    lines = errors.splitlines()
    assert len(lines) == 3
    assert "runs spring-start_1.0-subset, spring-start_3.0-subset: only_exp" in lines[0]
    assert "no experiment 'exp9'; did you mean" in lines[0]
    assert "spring-start_1.0-method" in lines[1]
    assert "did you mean 'least_squares'?" in lines[1]
    assert "spring-start_3.0-local: " in lines[2]
    assert not Path("out").exists()


def test_runs_with_ray_must_share_it(sweep):
    workers = {"name": "workers", "key": "executor.workers", "values": [1, 2]}
    code, _, errors = sweep(axes=[workers], overrides={"executor.name": "ray"})
    assert code == 2
    assert "run spring-workers_2: executor: workers and address must be the same" in errors


def test_two_sweeps_do_not_clash(sweep):
    Path("out").mkdir()
    with locked_by_sweep(Path("out")):
        code, _, errors = sweep()
    assert code == 2
    assert errors.startswith("cluster-est: out: another sweep is at work here (process ")
    assert sweep(axes=[])[0] == 0


def test_a_sweep_that_was_killed_before_its_first_run_goes_on(sweep):
    Path("out").mkdir()
    Path("out/.sweep.json").touch()  # half of its first sweep.json
    assert sweep(axes=[])[0] == 0


def test_folders_of_others_are_left_alone(sweep):
    Path("out").mkdir()
    Path("out/thesis.tex").touch()
    code, _, errors = sweep()
    assert code == 2
    assert "out: must be new, empty or a sweep's own but holds other files" in errors
    Path("out/thesis.tex").unlink()
    sweep(axes=[])
    strange = Path("out/new/thesis.tex")
    strange.parent.mkdir()
    strange.touch()
    code, _, errors = sweep(axes=[], runs=[{"name": "new"}])
    assert code == 2
    assert "out/new: must be a run's folder but holds other files, such as 'thesis.tex'" in errors
    assert strange.exists()


def test_ray_is_started_once_and_stopped_in_the_end(sweep, fits, monkeypatch):
    connected, real = [], ray.init

    def counted(*arguments: Any, **keys: Any) -> Any:
        connected.append(keys)
        return real(*arguments, **keys)

    monkeypatch.setattr(ray, "init", counted)
    before = ray.is_initialized()
    with_ray = {"executor.name": "ray", "executor.workers": 1}
    code, _, errors = sweep(axes=[STARTS, DATA], overrides=with_ray)
    assert code == 0, errors
    assert len(fits) == 4
    assert len(connected) == (0 if before else 1)
    assert ray.is_initialized() is before


def test_the_example(tmp_path, capsys):
    example = str(ROOT / "configs" / "sweep.toml")
    assert main(["sweep", example, "--out", str(tmp_path / "out")]) == 0
    assert "10 runs: 10 done; 10 of them in this call" in capsys.readouterr().out
