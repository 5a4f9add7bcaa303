import json
import re
import shutil
import tempfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import pytest
import ray
from support.observed_executor import observe
from support.problems.springs import ROOT
from support.run_folders import change_facts, copy_spring, facts, facts_without_clocks, rows
from support.run_folders import tables as tables_of
from support.thinning import thinned

from cluster_est.cli import main
from cluster_est.errors import ExecutorError
from cluster_est.run_folder.lock import locked_by_sweep
from cluster_est.run_folder.log_segment import read_log
from cluster_est.toml import to_toml

STARTS = {"name": "start", "key": "parameters.m.start", "values": [1.0, 3.0]}
DATA = {"name": "data", "values": {"all": {}, "some": {"only_experiments": ["exp1", "exp4"]}}}
HASTY = {"name": "hasty", "overrides": {"method.options.max_iterations": 1}}
NAMES = ["spring-start_1.0-all", "spring-start_1.0-some", "spring-start_3.0-all",
         "spring-start_3.0-some"]  # fmt: skip
OUT = Path("out")
NOISE = 0.0018
"""m, of the example's data."""

Sweep = Callable[..., tuple[int, str, str]]
Done = Callable[[], list[str]]


@pytest.fixture
def sweep(tmp_path, monkeypatch, capsys) -> Sweep:
    """Sweep over the embedded example in a folder of its own: exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    copy_spring(tmp_path)

    def call(*arguments: str, **keys: Any) -> tuple[int, str, str]:
        tree = {"configs": ["spring.toml"], "axes": [STARTS, DATA], **keys}
        Path("sweep.toml").write_text(to_toml(tree), encoding="utf-8")
        code = main(["sweep", "sweep.toml", "--out", "out", *arguments])
        said = capsys.readouterr()
        assert "Traceback" not in said.err
        return code, said.out, said.err

    return call


@pytest.fixture
def done() -> Done:
    """Gives the runs that were done since it was asked last, by what their folders hold."""
    known: dict[str, tuple[int, int]] = {}

    def give() -> list[str]:
        files = {path.parent.name: path.stat() for path in OUT.glob("*/run.json")}
        # a new file may get the number of the one that it replaces
        now = {name: (file.st_ino, file.st_mtime_ns) for name, file in files.items()}
        changed = sorted(name for name in now if now[name] != known.get(name))
        known.update(now)
        return changed

    return give


def logged(run: Path) -> list[tuple[Any, ...]]:
    """What was simulated, in its order."""
    table = read_log(run / "evaluations")
    columns = ("search", "evaluation", "purpose", "experiment", "values", "status", "cost")
    return list(zip(*(map(repr, table[name].to_pylist()) for name in columns), strict=True))


@pytest.mark.slow
def test_a_sweep_gives_what_single_fits_give(sweep, done):
    code, printed, _ = sweep()
    assert code == 0
    assert done() == NAMES
    summary = rows(OUT, "summary")
    assert [row["run"] for row in summary] == NAMES
    assert [(row["config"], row["start"], row["data"]) for row in summary[1:3]] == [
        ("spring", "1.0", "some"),
        ("spring", "3.0", "all"),
    ]
    assert main(["fit", "spring.toml", "--out", "alone", "parameters.m.start=3.0"]) == 0
    # A pool that stayed must change no bit.
    assert tables_of(OUT / NAMES[2]) == tables_of(Path("alone"))
    assert summary[2]["parameter m"] == rows(Path("alone"), "parameters")[0]["value"]
    assert summary[2]["cost"] == facts(OUT / NAMES[2])["cost"]
    assert list(facts(OUT / NAMES[1])["experiments"]) == ["exp1", "exp4"]
    for name in NAMES:
        assert name in printed


@pytest.mark.parametrize("study", ["sensitivity", "close-loop"])
def test_other_studies_are_swept_as_well(sweep, study):
    """What they find is what the command finds, and a row of the summary."""
    seeds = {"name": "seed", "key": f"{study.replace('close-', 'closed_')}.seed", "values": [0, 1]}
    quick = {"closed_loop.max_effects": 1, "sensitivity.groups": 10}
    code, printed, _ = sweep(study=study, axes=[seeds], overrides=quick)
    assert code == 0
    assert f"for one page about all runs, run: cluster-est report {OUT}" in printed
    first, second = rows(OUT, "summary")
    assert (first["seed"], second["seed"]) == (0, 1)
    given = [f"{key}={value}" for key, value in quick.items()]
    assert main([study, "spring.toml", "--out", "alone", *given]) == 0
    assert tables_of(OUT / first["run"]) == tables_of(Path("alone"))
    if study == "sensitivity":
        assert set(first["together"].split(", ")) <= {"m", "k", "c", "x0[exp5]"}
        assert first["together"] in printed
    else:
        assert first["verdict"] == facts(Path("alone"))["verdict"]
        assert first["verdict"] in printed


def test_a_sweep_of_doubtful_fits_does_not_end_as_if_all_were_well(sweep):
    """With four times the stiffness held, no damping and no mass follow the data."""
    wrong = {"parameters.k.start": 120.0, "parameters.k.fixed": True}
    code, printed, _ = sweep(axes=[], overrides=wrong)
    assert code == 1
    (row,) = rows(OUT, "summary")
    assert row["status"] == "done"
    found = re.search(
        "intervals are too narrow, because the error of y is (.*) times its", row["doubts"]
    )
    assert found is not None
    assert float(found[1]) == pytest.approx(row["rmse_train"] / NOISE, rel=0.2)
    assert row["doubts"] in " ".join(printed.split())


@pytest.mark.parametrize(
    ("method", "executor"),
    thinned(
        [*product(["least_squares", "sqp"], ["local", "processes"])],
        lambda method, _: method,
        lambda _, executor: executor,
    ),
)
def test_a_fit_and_a_sweep_of_one_run_are_one_recipe(sweep, method, executor):
    chosen = {"method.name": method, "executor.name": executor, "multistart.n": 2}
    assert sweep(axes=[], overrides=chosen)[0] == 0
    overrides = [f"{key}={value}" for key, value in chosen.items()]
    assert main(["fit", "spring.toml", *overrides, "--out", "alone", "--no-report"]) == 0
    swept, alone = OUT / "spring", Path("alone")
    assert tables_of(swept) == tables_of(alone)
    assert {"errors", "parameters", "residuals"} <= tables_of(alone).keys()
    assert facts_without_clocks(swept) == facts_without_clocks(alone)
    assert facts(alone)["reset_policy"]["policy"] == "reset"
    assert logged(swept) == logged(alone)
    assert (swept / "config.toml").read_bytes() == (alone / "config.toml").read_bytes()


def test_what_is_done_is_skipped_until_it_changes(sweep, done):
    assert sweep()[0] == 0
    assert done() == NAMES
    code, printed, _ = sweep()
    assert (code, done()) == (0, [])
    assert "4 runs: 4 done; 0 of them in this call" in printed
    # Where and for how long does not matter; a third start does not touch the others.
    sweep(overrides={"executor.workers": 2, "budget.evaluations": 9000})
    assert done() == []
    sweep(axes=[STARTS | {"values": [1.0, 3.0, 2.0]}, DATA])
    assert done() == ["spring-start_2.0-all", "spring-start_2.0-some"]
    table = Path("data/mass_spring_damper/exp2.csv")
    table.write_text("\n".join(table.read_text().splitlines()[:-1]) + "\n")
    sweep()
    assert done() == ["spring-start_1.0-all", "spring-start_3.0-all"]
    sweep(axes=[STARTS | {"values": [1.0]}, DATA], overrides={"method.seed": 1})
    assert done() == NAMES[:2]


@pytest.mark.slow
def test_what_other_versions_did_and_what_was_killed_is_done_again(sweep, done):
    run = OUT / "spring"
    assert sweep(axes=[])[0] == 0
    for change in ({"versions": facts(run)["versions"] | {"numpy": "1.0"}}, {"status": "running"}):
        change_facts(run, **change)
        done()
        assert sweep(axes=[])[0] == 0
        assert done() == ["spring"]
    (run / "run.json").write_text("{")
    done()
    assert sweep(axes=[])[0] == 0
    assert done() == ["spring"]
    shutil.rmtree(run)
    (run / "evaluations").mkdir(parents=True)
    (run / "config.toml").touch()
    assert sweep(axes=[])[0] == 0
    assert done() == ["spring"]


def test_a_failed_run_is_not_tried_again_unless_asked(sweep, done):
    some = {"axes": [STARTS | {"values": [1.0]}]}
    code, printed, _ = sweep(**some, runs=[HASTY])
    assert code == 1
    assert "1 done, 1 not converged; 2 of them" in printed
    (row,) = [row for row in rows(OUT, "summary") if row["run"] == "hasty"]
    assert row["message"] == facts(OUT / "hasty")["message"] != ""
    done()
    assert sweep(**some, runs=[HASTY])[0] == 1
    assert done() == []
    assert sweep("--retry-failed", **some, runs=[HASTY])[0] == 1
    assert done() == ["hasty"]
    patient = HASTY | {"overrides": {"method.options.max_iterations": 50}}
    assert sweep(**some, runs=[patient])[0] == 0
    assert done() == ["hasty"]


def test_a_larger_budget_tries_again(sweep, done):
    for budget, code, again in ((10, 1, ["spring"]), (10, 1, []), (1000, 0, ["spring"])):
        assert sweep(axes=[], overrides={"budget.evaluations": budget})[0] == code
        assert done() == again


def test_whatever_goes_wrong_in_a_run_is_its_own(sweep, monkeypatch):
    observe(monkeypatch).disturb(1, FloatingPointError("out of luck"))
    code, printed, _ = sweep(axes=[STARTS])
    assert code == 1
    assert "2 runs: 1 failed, 1 done" in printed
    said = facts(OUT / "spring-start_1.0")["message"]
    assert said == "FloatingPointError: out of luck; stopped before the first simulation"


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (KeyboardInterrupt(), 130),
        pytest.param(ExecutorError("no workers"), 2, marks=pytest.mark.slow),
    ],
)
def test_the_next_call_goes_on_where_one_stopped(sweep, done, monkeypatch, error, expected):
    """In the midst of the second run, what was simulated is not simulated again."""
    observer = observe(monkeypatch)

    def fail_in_the_second_run(_: int) -> None:
        log = OUT / "spring-start_3.0" / "evaluations"
        if not stopped and len(list(log.glob("*.arrows"))) > 0:
            stopped.append(len(observer.simulated))
            raise error

    stopped: list[int] = []
    observer.before = fail_in_the_second_run
    kept = {"axes": [STARTS], "overrides": {"log.keep_residuals": True}}
    assert sweep(**kept)[0] == expected
    assert [row["status"] for row in rows(OUT, "summary")] == ["done", "not run"]
    assert facts(OUT / "spring-start_3.0")["status"] == "interrupted"
    done()
    assert sweep(**kept)[0] == 0
    assert done() == ["spring-start_3.0"]
    logs = [read_log(OUT / f"spring-start_{start}" / "evaluations") for start in (1.0, 3.0)]
    assert len(observer.simulated) == sum(log.num_rows for log in logs)


@pytest.mark.slow
def test_an_interrupt_among_many_starts_ends_the_sweep(sweep, done, monkeypatch):
    """Some starts have ended then: the fit could give the best of them, but it is not done."""
    observer = observe(monkeypatch)
    progress = OUT / "spring-start_1.0" / "progress.jsonl"
    stopped: list[int] = []

    def when_two_starts_have_ended(_: int) -> None:
        if stopped or not progress.is_file():
            return
        lines = [json.loads(line) for line in progress.read_text().splitlines()]
        if sum(bool(line.get("ending")) for line in lines) >= 2:
            stopped.append(1)
            raise KeyboardInterrupt

    observer.before = when_two_starts_have_ended
    many = {"multistart.n": 3, "multistart.at_once": 2}
    assert sweep(axes=[STARTS], overrides=many)[0] == 130
    assert done() == ["spring-start_1.0"]
    assert facts(OUT / "spring-start_1.0")["status"] == "interrupted"
    assert sweep(axes=[STARTS], overrides=many)[0] == 0
    assert done() == ["spring-start_1.0", "spring-start_3.0"]


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
    assert not OUT.exists()


def test_runs_with_ray_must_share_it(sweep):
    workers = {"name": "workers", "key": "executor.workers", "values": [1, 2]}
    code, _, errors = sweep(axes=[workers], overrides={"executor.name": "ray"})
    assert code == 2
    assert "run spring-workers_2: executor: workers and address must be the same" in errors


SLEEPY = """
data_folders = []
[model]
fmu = "misbehaves.fmu"
[parameters]
rate = { start = 1.0, bounds = [0.5, 2.0] }
share = { start = 1.0, fixed = true }
kind = { start = 4.0, fixed = true }
[[experiments]]
id = "e"
data = "decay.csv"
time = "time"
outputs = { x = "x" }
[executor]
name = "processes"
"""


@pytest.mark.slow
def test_a_sweep_over_the_timeout_uses_what_each_run_says(sweep, built_fmu):
    """Every simulation hangs: how long that is waited for is what its run says."""
    Path("misbehaves.fmu").write_bytes(built_fmu("misbehaves"))
    Path("decay.csv").write_text("time,x\n0,1\n1,0.4\n2,0.1\n", encoding="utf-8")
    Path("sleepy.toml").write_text(SLEEPY, encoding="utf-8")
    axis = {"name": "timeout", "key": "executor.timeout", "values": [0.2, 0.4]}
    assert sweep(configs=["sleepy.toml"], axes=[axis])[0] == 1
    for limit in ("0.2", "0.4"):
        said = facts(OUT / f"sleepy-timeout_{limit}")["message"]
        assert f"did not end within {limit} s" in said


def test_a_folder_that_cannot_be_written_ends_a_sweep_with_the_reason(sweep):
    """A log that is a file in its place stands for a full disk: nothing can be written to it."""
    (OUT / "spring").mkdir(parents=True)
    (OUT / "sweep.json").touch()
    (OUT / "spring" / "run.json").write_text("{")
    (OUT / "spring" / "evaluations").touch()
    code, _, errors = sweep(axes=[])
    assert code == 2
    assert "evaluations" in errors
    assert [row["status"] for row in rows(OUT, "summary")] == ["not run"]


def test_two_sweeps_do_not_clash(sweep):
    OUT.mkdir()
    with locked_by_sweep(OUT):
        code, _, errors = sweep()
    assert code == 2
    assert errors.startswith("cluster-est: out: another sweep is running here (process ")


def test_a_sweep_that_was_killed_before_its_first_run_goes_on(sweep):
    OUT.mkdir()
    (OUT / ".sweep.json").touch()  # half of its first sweep.json
    assert sweep(axes=[])[0] == 0


def test_folders_of_others_are_left_alone(sweep):
    OUT.mkdir()
    (OUT / "thesis.tex").touch()
    code, _, errors = sweep()
    assert code == 2
    assert (
        "out: must be a new or empty folder, or the folder of a sweep, but holds other files"
        in errors
    )
    (OUT / "thesis.tex").rename(OUT / "sweep.json")
    strange = OUT / "new/thesis.tex"
    strange.parent.mkdir()
    strange.touch()
    code, _, errors = sweep(axes=[], runs=[{"name": "new"}])
    assert code == 2
    assert (
        "out/new: must be the folder of a run, but holds other files, such as 'thesis.tex'"
        in errors
    )
    assert strange.exists()


@pytest.mark.slow
def test_ray_is_started_once_and_stopped_in_the_end(sweep, done, monkeypatch):
    before = ray.is_initialized()
    with tempfile.TemporaryDirectory(prefix="ray") as folder:  # of a short name, for its sockets
        monkeypatch.setenv("RAY_TMPDIR", folder)
        code, _, errors = sweep(overrides={"executor.name": "ray", "executor.workers": 1})
        sessions = [each for each in Path(folder, "ray").glob("session_2*") if each.is_dir()]
    assert code == 0, errors
    assert done() == NAMES
    assert len(sessions) == (0 if before else 1)
    assert ray.is_initialized() is before


@pytest.mark.slow
def test_the_example(tmp_path, capsys):
    example = str(ROOT / "configs" / "sweep.toml")
    assert main(["sweep", example, "--out", str(tmp_path / "out")]) == 0
    assert "10 runs: 10 done; 10 of them in this call" in capsys.readouterr().out
