"""Never more instances of an FMU than `executor.instances` allows, and few in all.

The FMU counts its instances itself. The truth of the fits is the solution by hand.
"""

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.decays import (
    RATE,
    VARIABLE,
    CountedInstances,
    answered,
    check_decays,
    decay_problem,
    write_decay,
)
from support.descendants import descendants
from support.run_folders import facts, rows

from cluster_est import Problem, fit
from cluster_est.cli import main
from cluster_est.errors import ProblemError, UnsuitableExecutorError
from cluster_est.preflight.subject import bare_problem
from cluster_est.running.reset_policy import open_with_reset
from cluster_est.running.resources import Resources
from workers.evaluate import Evaluator
from workers.fmu.description import describe_model
from workers.fmu.instance import FmuInstance
from workers.messages import Status, Task
from workers.wire import TaskBatch

CRASHES, FATAL = 2.7, 2.2
"""Rates at which the FMU does that."""
slow = pytest.mark.slow


@pytest.fixture
def counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CountedInstances:
    """Count in a folder; FMUs that other tests have tried out are new here."""
    folder = tmp_path / "counted"
    folder.mkdir()
    monkeypatch.setenv(VARIABLE, str(folder))
    monkeypatch.setenv("CLUSTER_EST_CACHE", str(tmp_path / "cache"))
    return CountedInstances(folder)


@pytest.fixture
def asked(own_fmu) -> Problem:
    return decay_problem(own_fmu("counts_instances", 2))


@pytest.fixture
def run(own_fmu, tmp_path: Path) -> Callable[..., int]:
    """Runs a command on four records of a decay; the run is in `run`."""

    def do(command: str, *overrides: str, noise: float = 0.0) -> int:
        config = write_decay(tmp_path, own_fmu("counts_instances", 2), noise)
        out = ["--out", str(tmp_path / "run"), "--overwrite", "--no-report"]
        return main([command, str(config), *(out if command != "check" else []), *overrides])

    return do


def estimate(folder: Path) -> float:
    found = rows(folder / "run", "parameters")
    return next(float(row["value"]) for row in found if row["parameter"] == "k")


def simulations(folder: Path) -> int:
    return int(facts(folder / "run")["simulations"])


@pytest.mark.parametrize(
    ("given", "most"),
    [
        (["executor.workers=5"], 5 + 1),  # one records the states at the end, where none is limited
        (["executor.workers=2", "executor.instances=2"], 2),
    ],
)
def test_as_many_as_workers_are_made_and_a_limit_that_changes_nothing_is_not_mentioned(
    run, counted, capsys, given, most
):
    """The FMU can count to more than any of the limits below."""
    assert run("fit", "executor.name=processes", *given) == 0
    assert "executor.instances" not in capsys.readouterr().err
    assert counted.most == most


@pytest.mark.parametrize("executor", ["processes", pytest.param("local", marks=slow)])
def test_eight_workers_share_three_instances(run, counted, executor, tmp_path, capsys):
    wanted = "executor.workers=8", "executor.instances=3", f"executor.name={executor}"
    assert run("fit", *wanted) == 0
    assert counted.most == 3
    assert capsys.readouterr().err.count("3 of the 8 workers in executor.workers") == 1

    counted.forget()  # the second time the FMU is known, and no more than simulated
    assert run("fit", *wanted) == 0
    assert (counted.most, counted.made) == (3, 3)
    assert simulations(tmp_path) > 20
    assert estimate(tmp_path) == pytest.approx(RATE, rel=1e-5)


@pytest.mark.parametrize(
    ("executor", "instances"),
    [
        ("local", 1),
        ("processes", 3),
        pytest.param("local", 3, marks=slow),
        pytest.param("processes", 1, marks=slow),
    ],
)
def test_the_error_of_the_solver_is_measured_in_the_place_of_a_worker(
    run, counted, tmp_path, executor, instances
):
    """The workers stay until the run is written, and the measurement is in a further process."""
    limit = f"executor.instances={instances}", "executor.workers=3", f"executor.name={executor}"
    assert run("fit", "model.solver=rk4", *limit) == 0
    assert counted.most == instances
    assert facts(tmp_path / "run")["solver_error"]["experiments"] == 4

    workers = 1 if executor == "local" else instances
    counted.forget()
    assert run("fit", "model.solver=rk4", *limit) == 0
    assert len(counted.processes) == workers + 1
    assert counted.made == instances + 1, "the measurement keeps its instance for all simulations"


@pytest.mark.parametrize("executor", ["processes", pytest.param("local", marks=slow)])
def test_a_closed_loop_keeps_to_it(run, counted, tmp_path, executor):
    limit = "executor.instances=2", "executor.workers=4", f"executor.name={executor}"
    assert run("close-loop", *limit, noise=1e-3) == 0
    assert counted.most == 2
    assert counted.made < 20 < simulations(tmp_path)
    said = json.dumps(facts(tmp_path / "run"))
    assert "finer solver setting fails" not in said, "the error of the solver was measured"


@pytest.mark.parametrize(
    ("instances", "solver"),
    [
        (1, "dormand_prince"),
        (2, "cvode"),
        pytest.param(3, "dormand_prince", marks=slow),
    ],
)
def test_a_check_keeps_to_it(run, counted, capsys, instances, solver):
    limit = f"executor.instances={instances}", f"model.solver={solver}"
    assert run("check", *limit, "--seconds", "60") == 0
    assert counted.most == instances
    page = " ".join(capsys.readouterr().out.split())
    tried = "not tested, because executor.instances = 1 allows only one at a time"
    several = (
        f"{instances} instances at the same time in one process, which do not disturb each other"
    )
    assert (tried if instances == 1 else several) in page


def test_a_check_of_an_fmu_that_fails_keeps_to_it(run, counted):
    wider = f"parameters.k.start={FATAL}", "parameters.k.bounds=[0.01,3.0]"
    run("check", "executor.instances=1", *wider, "model.interface=co_simulation")
    assert counted.most == 1


@pytest.mark.parametrize("executor", ["processes", pytest.param("local", marks=slow)])
def test_cvode_finds_the_same_with_one_instance(run, counted, tmp_path, executor):
    """The FMU's derivatives are tried beforehand, in an instance of their own."""
    given = "model.solver=cvode", "model.rtol=1e-7", f"executor.name={executor}"
    assert run("fit", *given) == 0
    expected = estimate(tmp_path)
    counted.forget()
    assert run("fit", *given, "executor.instances=1") == 0
    assert counted.most == 1
    assert estimate(tmp_path) == expected

    counted.forget()
    assert main(["replay", str(tmp_path / "run"), "0"]) == 0
    assert counted.most == 1


def test_cvode_uses_the_derivatives_with_one_instance_too(own_fmu, counted):
    asked = decay_problem(own_fmu("counts_instances", 2), "cvode")
    model = Resources(instances=3).limited(asked.model).of_worker(0)
    rates = [1.0, 1.1, 1.2, 1.3]
    batch = TaskBatch.of([Task(i, i, np.array([rate])) for i, rate in enumerate(rates)])
    with closing(Evaluator(model, asked.experiments, "one of three")) as evaluator:
        check_decays(evaluator.evaluate(batch), rates)
        assert evaluator.simulator.gives_jacobian
    assert counted.most == 1, "the seats of other workers are theirs"


def test_sensitivities_take_no_further_instances(asked, counted):
    """Without a limit two more are made for k, by which the FMU has no directional derivative."""
    batch = TaskBatch.of([Task(0, 0, np.array([1.0]), "sensitivities")])
    limited = Resources(instances=5).limited(asked.model)
    most = []
    for model in (asked.model, limited, limited.of_worker(0)):
        with closing(Evaluator(model, asked.experiments, "alone")) as evaluator:
            check_decays(evaluator.evaluate(batch), [1.0])
        most.append(counted.most)
        counted.forget()
    assert most == [3, 1, 1]


@pytest.mark.parametrize("turns", [2, pytest.param(6, marks=slow)])
def test_crashes_and_kills_never_make_one_too_many(asked, counted, turns):
    rates = [CRASHES if i % 9 == 4 else 1.0 + 0.01 * i for i in range(60)]
    with open_with_reset(asked, Resources("processes", 8, instances=3))[0] as pool:
        assert pool.workers == 3
        for turn in range(turns):
            outcomes = answered(pool, rates, 100 * turn)
            check_decays(outcomes, rates)
            crashed = [i for i, outcome in enumerate(outcomes) if outcome.status is Status.CRASH]
            assert crashed == [i for i, rate in enumerate(rates) if rate == CRASHES]
            assert sum(outcome.ok for outcome in outcomes) == len(rates) - len(crashed)
            servers = descendants(2)  # those that would have seen the FMU's process end
            assert len(servers) in (2, 3)  # one that ended with the last crash waits for a task
            for server in servers:
                os.kill(server, signal.SIGKILL)
    assert counted.made > 6 * turns
    assert counted.most == 3


def test_an_instance_that_was_let_go_is_followed_by_a_new_one(asked):
    """A new one is not reset: were it taken for the old one, nor would be all others of a batch."""
    instance = FmuInstance(asked.model, describe_model(asked.model))
    first, second = instance.begin(), instance.begin()
    assert first.reset != second.reset
    assert not instance.is_new
    instance.free()
    assert instance.is_new
    assert instance.begin().reset == first.reset
    assert not instance.is_new
    instance.free()


def test_instances_that_disturb_each_other_are_found_out_within_the_limit(own_fmu):
    """Two are tried at once, for which two workers let theirs go."""
    shared = bare_problem(own_fmu("shares_static", 2))
    with pytest.raises(UnsuitableExecutorError, match="do not disturb each other"):
        open_with_reset(shared, Resources("local", 2, instances=2))


def test_after_a_fatal_error_the_process_is_ended_and_its_neighbours_are_answered(asked, counted):
    rates = [FATAL if i % 7 == 3 else 1.0 + 0.01 * i for i in range(40)]
    with open_with_reset(asked, Resources("processes", 2, instances=2))[0] as pool:
        answered(pool, [1.0] * 8)  # from now on tasks travel together
        outcomes = answered(pool, rates, 100)
    check_decays(outcomes, rates)
    fatal = [i for i, outcome in enumerate(outcomes) if not outcome.ok]
    assert fatal == [i for i, rate in enumerate(rates) if rate == FATAL]
    assert {outcomes[i].status for i in fatal} == {Status.SOLVER_FAILURE}
    assert not any("executor.instances" in outcomes[i].message for i in fatal)
    assert counted.most == 2


@pytest.mark.slow
def test_after_a_fatal_error_in_this_process_there_is_no_other_instance(own_fmu, counted, tmp_path):
    """It may not be freed, so that the limit can only be held by ending, with a sentence."""
    config = write_decay(tmp_path, own_fmu("counts_instances", 2))
    fatal = f"parameters.k.start={FATAL}", "parameters.k.bounds=[0.01,3.0]"
    command = ["fit", str(config), "--out", str(tmp_path / "run"), "executor.instances=1", *fatal]
    program = [sys.executable, "-m", "cluster_est", *command]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stdout
    said = " ".join(done.stderr.split())
    assert "executor.instances: " in said
    assert "fatal" in said
    assert 'choose executor.name = "processes"' in said
    assert counted.most == 1


@pytest.mark.parametrize("policy", ["instance", "process"])
def test_each_simulation_in_a_new_one_is_never_two(own_fmu, counted, policy):
    asked = decay_problem(own_fmu("counts_instances", 3))
    asked = replace(asked, model=replace(asked.model, reset=policy))  # type: ignore[arg-type]
    rates = [1.0 + 0.01 * i for i in range(20)]
    with open_with_reset(asked, Resources("processes", 4, instances=2))[0] as pool:
        outcomes = answered(pool, rates)
    check_decays(outcomes, rates)
    assert all(outcome.ok for outcome in outcomes)
    assert counted.made >= 20
    assert counted.most == 2


def test_two_runs_of_a_program_share_the_limit(asked, counted):
    """Also where the pool of the first has hardly ended when that of the second begins."""
    for executor in ("processes", "local", "processes"):
        found = fit(asked, resources=Resources(executor, 3, instances=2))
        assert found.estimates[0].value == pytest.approx(RATE, rel=1e-5)
    assert counted.most == 2


@pytest.mark.parametrize("instances", [0, -1, 1.5, True, "3", math.inf])
def test_a_limit_that_is_no_count_is_refused(asked, instances):
    with pytest.raises(ProblemError, match=r"^executor\.instances: must be"):
        fit(asked, resources=Resources(instances=instances))  # type: ignore[arg-type]
