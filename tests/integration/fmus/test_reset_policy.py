"""What every simulation begins with is found out, and the estimates do not suffer from it.

The truth is the solution of x' = -k x, x(0) = 1, by hand.
"""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.decay_fits import RATE, K, decay_table, estimate, fit_decay, run_of
from support.run_folders import change_facts, facts
from support.thinning import thinned
from typing_extensions import override

from cluster_est.executors import EXECUTORS
from cluster_est.executors.local import LocalExecutor
from cluster_est.preflight.subject import bare_problem
from cluster_est.running import reset_policy as renewal
from cluster_est.running.resources import Resources
from workers.messages import Outcome, Status, Task

SLOW_IN_3 = pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])
KINDS, EXECUTOR_PAIRS = (
    pytest.mark.parametrize(
        ("fmi", what), thinned([*product((2, 3), of)], lambda fmi, _: fmi, lambda _, each: each)
    )
    for what, of in (
        ("interface", ("model_exchange", "co_simulation")),
        ("executor", ("local", "processes")),
    )
)
DIED = "An FMU that runs in this process crashed or ended it"


@pytest.fixture
def fitted(own_fmu, tmp_path):
    """Fits k, or what else is said, to a decay; the run is in `run`."""

    def fit(name: str, fmi: int, *overrides: str, **options: str) -> int:
        return fit_decay(tmp_path, own_fmu(name, fmi), *overrides, **options)

    return fit


def chosen(folder: Path) -> str:
    found = facts(folder / "run")
    return str(found["reset_policy"]["policy"])


@KINDS
def test_a_state_that_survives_a_reset(fitted, tmp_path, fmi, interface, capsys):
    assert fitted("reset_keeps_state", fmi, f"model.interface={interface}") == 0

    assert chosen(tmp_path) == "instance"
    assert "keeps data through a reset" in capsys.readouterr().err
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


@pytest.mark.parametrize(("fmi", "solver"), [(3, "dormand_prince"), (2, "cvode")])
def test_what_a_solver_asks_beforehand_does_not_use_up_the_new_instance(
    fitted, tmp_path, fmi, solver
):
    """CVODE looks at the directional derivatives first; after that, all began with a reset."""
    name = "reset_spoils_directional"
    assert fitted(name, fmi, f"model.solver={solver}", "model.rtol=1e-8") == 0

    assert chosen(tmp_path) == "instance"
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


def test_it_spoils_the_estimate_if_one_insists(fitted, tmp_path):
    fitted("reset_keeps_state", 2, "model.reset=reset")

    assert chosen(tmp_path) == "reset"
    assert estimate(tmp_path) != pytest.approx(RATE, rel=1e-2)


@pytest.mark.parametrize("reset", ["process", pytest.param("instance", marks=pytest.mark.slow)])
def test_a_new_process_for_each_simulation(fitted, tmp_path, reset):
    wanted = ["executor.name=processes", f"model.reset={reset}"]
    assert fitted("reset_keeps_state", 2, *wanted) == 0

    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


def test_one_process_cannot_be_new_each_time(fitted, capsys):
    assert fitted("dahlquist", 2, "model.reset=process") == 2
    assert 'set executor.name to "processes" or "ray"' in capsys.readouterr().err


def test_values_of_another_experiment_that_survive_a_reset(fitted, tmp_path):
    config = "parameters.x = { start = 0.5, bounds = [0.1, 5.0] }"
    with_rate = f"[experiments.values]\nk = {RATE}\n"
    # where k is not set it is the FMU's own, which is 1
    (tmp_path / "b.csv").write_text(decay_table(1.0), encoding="utf-8")

    assert fitted("fails_to_reset", 2, config=config, more=with_rate + run_of("b")) == 0

    assert chosen(tmp_path) == "instance"
    assert estimate(tmp_path, "x") == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("name", ["fails_to_reset", "dahlquist", "once_undeclared"])
def test_what_can_be_reset_is_reset(fitted, tmp_path, name, capsys):
    if name == "dahlquist":
        fitted(name, 2)
    else:
        assert fitted(name, 2) == 0
        assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-6)

    assert chosen(tmp_path) == "reset"
    assert not capsys.readouterr().err.count("cluster-est:")


@pytest.mark.parametrize("can_fork", [True, False])
def test_chance_is_named(fitted, tmp_path, capsys, monkeypatch, can_fork):
    """Also where there are no processes to be copied."""
    monkeypatch.setattr(renewal, "CAN_FORK", can_fork and renewal.CAN_FORK)
    fitted("random_output", 2, "budget.evaluations=3")

    assert chosen(tmp_path) == "reset"
    assert "is not repeatable" in (said := capsys.readouterr().err)
    assert can_fork or "even in a new instance" in said


def test_a_run_that_is_resumed_goes_on_as_it_began(fitted, tmp_path):
    """Even where nobody would choose that now."""
    fitted("dahlquist", 2, "budget.evaluations=2")
    (tmp_path / "run" / "parameters.parquet").unlink()
    run = tmp_path / "run"
    change_facts(run, reset_policy=facts(run)["reset_policy"] | {"policy": "instance"})

    assert fitted("dahlquist", 2, "--resume") == 0
    assert chosen(tmp_path) == "instance"
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


class Worker:
    """A first worker that keeps something, or what else is said, and takes an hour each time."""

    def __init__(self, *answers: float | Status) -> None:
        self.answers = iter(answers)

    def one_worker(self, tasks: Sequence[Task]) -> list[Outcome]:
        return [
            Outcome(task.id, answer, message="it ended")
            if isinstance(answer, Status)
            else Outcome(task.id, Status.OK, np.full(3, answer), seconds=3600.0)
            for task in tasks
            for answer in [next(self.answers)]
        ]


LOST = [Status.LOST_WORKER, Status.TIMEOUT, Status.OUT_OF_MEMORY]


@pytest.mark.parametrize(
    ("answers", "same"),
    [
        ((1.0, 2.0), False),  # however long it takes
        *(((1.0, lost), None) for lost in LOST),
        # the one between may have left a new instance: the last one is tried again, after a reset
        *(((1.0, ended, 1.0, 2.0), False) for ended in [*LOST[1:], Status.SOLVER_FAILURE]),
    ],
)
def test_a_reset_is_judged_by_answers_that_come_after_one(answers, same):
    points = (0, 1, 0) if len(answers) > 2 else (0, 0)
    tasks = tuple(Task(i, e, np.zeros(1)) for i, e in enumerate(points))
    question = renewal.RepeatabilityTest(tasks)
    assert question.ask(Worker(*answers)).same is same  # type: ignore[arg-type]


@EXECUTOR_PAIRS
def test_a_reset_that_crashes_is_found_out_in_another_process(
    fitted, tmp_path, fmi, executor, capsys
):
    assert fitted("reset_crashes", fmi, f"executor.name={executor}") == 0

    assert chosen(tmp_path) == "instance"
    said = capsys.readouterr().err
    assert "crashes in a simulation after a reset" in said
    assert "each simulation begins with a new instance" in said
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


def test_an_fmu_that_crashes_at_once_does_not_take_the_fit_along(fitted, capsys):
    assert fitted("crashes_at_start", 2) == 2
    said = capsys.readouterr().err
    assert re.search(r"crashes_at_start_fmi2.fmu cannot be run .*SIGSEGV.*choose.*processes", said)


@pytest.mark.parametrize("workers", [1, 2])
def test_what_was_found_out_once_is_not_tried_again(fitted, tmp_path, monkeypatch, workers):
    """That the FMU survives, and is undisturbed by others, is tried in another process at first."""
    monkeypatch.setenv("INSTANCES_COUNTED_IN", str(tmp_path))
    below = "parameters.k = { start = 0.7, bounds = [0.01, 1.9] }\n"
    used = []
    for _ in range(2):
        several = f"executor.workers={workers}"
        assert fitted("counts_instances", 2, several, "--overwrite", config=below) in (0, 1)
        lines = (tmp_path / "log").read_text(encoding="ascii").splitlines()
        used.append({int(line.split()[1]) for line in lines if line.startswith("MADE")})
        (tmp_path / "log").unlink()
    first, again = used
    assert os.getpid() in again
    assert len(again) == 2  # with the one that records the states at the end
    assert workers == 1 or len(first) > len(again)


@KINDS
def test_instances_that_share_a_static_variable_are_refused_for_several_threads(
    fitted, tmp_path, fmi, interface, capsys
):
    several = [f"model.interface={interface}", "executor.workers=3"]
    assert fitted("shares_static", fmi, *several) == 2
    said = capsys.readouterr().err
    assert re.search(r"executor.workers: .*instances of shares_static.*executor.workers = 1", said)

    assert fitted("shares_static", fmi, *several, "executor.name=processes") == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


class Wide(LocalExecutor):
    """One that takes two workers where nothing is said."""

    @classmethod
    @override
    def open(cls, model, experiments, workers, address, limits=None):  # type: ignore[no-untyped-def]
        return super().open(model, experiments, workers or 2, address, limits)


@pytest.mark.parametrize(("name", "workers"), [("shares_static", 1), ("dahlquist", 2)])
def test_fewer_workers_by_default_where_instances_share_something(
    own_fmu, monkeypatch, name, workers
):
    monkeypatch.setitem(EXECUTORS, "wide", f"{__name__}:Wide")
    problem = bare_problem(own_fmu(name, 2))
    with renewal.open_with_reset(problem, Resources(executor="wide"))[0] as pool:
        assert pool.workers == workers


@SLOW_IN_3
def test_an_fmu_that_has_survived_is_tried_apart_again_with_other_start_values(fitted, fmi, capsys):
    below = "parameters.k = { start = 0.7, bounds = [0.01, 2.0] }\n"
    assert fitted("crashes_when_fast", fmi, config=below) == 0

    crashing = "parameters.k = { start = 3.0, bounds = [0.01, 10.0] }\n"
    assert fitted("crashes_when_fast", fmi, "--overwrite", config=crashing) == 2
    assert "because its first simulation crashed" in capsys.readouterr().err


def command(*arguments):
    """What the program says in a process of its own, and how that ends."""
    program = [sys.executable, "-c", "from cluster_est.cli import run; run()"]
    return subprocess.run([*program, *arguments], capture_output=True, text=True, check=False)


def fit_apart(folder, out, *overrides):
    return command("fit", str(folder / "config.toml"), "--out", str(folder / out), *overrides)


def test_a_process_that_dies_leaves_a_sentence(fitted, tmp_path):
    """One insists on the reset that crashes, in the process of the command."""
    fitted("reset_crashes", 2)
    ended = fit_apart(tmp_path, "dies", "model.reset=reset")
    assert ended.returncode == 128 + signal.SIGSEGV
    assert DIED in ended.stderr.strip().splitlines()[-1]


@pytest.mark.slow
def test_what_was_found_is_written_before_the_fmu_is_let_go(built_fmu, tmp_path):
    """It crashes in the process of the command, at the very end."""
    (tmp_path / "a.csv").write_text(decay_table(), encoding="utf-8")
    (tmp_path / "decay.fmu").write_bytes(built_fmu("crashes_when_unloaded"))
    (tmp_path / "config.toml").write_text(
        'model.fmu = "decay.fmu"\n' + K.replace(".k ", ".rate ") + run_of("a"), encoding="utf-8"
    )
    ended = fit_apart(tmp_path, "run", "--no-report")
    assert ended.returncode == 128 + signal.SIGSEGV
    assert DIED in ended.stderr
    assert estimate(tmp_path, "rate") == pytest.approx(RATE, rel=1e-5)


def test_a_result_that_does_not_come_out_again_is_noted(fitted, capsys, monkeypatch):
    fitted("random_output", 2, "executor.name=local", "model.reset=reset")
    assert "depends on more than its inputs" in " ".join(capsys.readouterr().out.split())
    fitted("dahlquist", 2, "executor.name=local", "model.reset=reset", "--overwrite")
    assert "depends on more than its inputs" not in " ".join(capsys.readouterr().out.split())


def test_a_program_ends_with_the_exit_code_of_its_command(tmp_path):
    for arguments, code in ((["--help"], 0), (["show", str(tmp_path)], 2)):
        ended = command(*arguments)
        assert ended.returncode == code
        assert ended.stdout or ended.stderr
        assert DIED not in ended.stderr


@EXECUTOR_PAIRS
def test_a_file_that_is_opened_by_a_relative_path_lies_in_the_working_folder(
    fitted, tmp_path, fmi, executor, monkeypatch, capsys
):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert fitted("reads_file", fmi, f"executor.name={executor}") == 1
    assert "the file gain.txt cannot be read" in " ".join(capsys.readouterr().out.split())
    (folder / "gain.txt").write_text("1.0\n", encoding="ascii")
    assert fitted("reads_file", fmi, f"executor.name={executor}", "--overwrite") == 0
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


@SLOW_IN_3
def test_what_an_fmu_writes_into_its_folder_and_reads_again_is_found_out(fitted, fmi, capsys):
    fitted("writes_folder", fmi, "executor.name=processes", "budget.evaluations=3")
    assert "is not repeatable" in capsys.readouterr().err
