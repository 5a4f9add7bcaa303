"""Ray's workers that stand still, are killed, or are lost with their node: no bit changes.

Fits on Ray that nothing disturbs are among the tests of the same bits and of every executor.
"""

import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from support.decays import RATE, VARIABLE, CountedInstances, answered, check_decays, decay_problem
from support.descendants import ray_actors
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.executors import WorkerPool, executor_class
from cluster_est.problem.search_space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Task

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def quiet_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")


@pytest.fixture
def problem() -> ce.Problem:
    return spring_problem(noise=0.01).problem


def opened(problem: ce.Problem, name: str, workers: int | None, address: str | None) -> WorkerPool:
    return executor_class(name).open(problem.model, problem.experiments, workers, address)


@pytest.fixture
def pool(problem) -> Iterator[WorkerPool]:
    with opened(problem, "ray", 2, None) as executor:
        yield executor
    assert not ray.is_initialized()


def tasks(count: int, first: int) -> list[Task]:
    generator = np.random.default_rng(first)
    values = generator.uniform([1.0, 20.0, 0.5, 0.0], [1.5, 40.0, 1.0, 0.1], (count, 4))
    return [Task(first + i, i % 5, row) for i, row in enumerate(values)]


def residuals(executor, asked: list[Task]) -> dict[int, bytes]:
    executor.submit(asked)
    found: dict[int, bytes] = {}
    while len(found) < len(asked):
        for outcome in executor.completed():
            assert outcome.task not in found
            found[outcome.task] = outcome.residuals.tobytes()
    return found


def expected(problem: ce.Problem, asked: list[Task]) -> dict[int, bytes]:
    with opened(problem, "local", 1, None) as executor:
        return residuals(executor, asked)


@pytest.fixture
def stopped(pool) -> Iterator[int]:
    """One of two workers, which are at work already, stands still."""
    residuals(pool, tasks(100, 0))
    process = min(ray_actors())
    os.kill(process, signal.SIGSTOP)
    yield process
    os.kill(process, signal.SIGCONT)


def test_what_a_worker_holds_up_is_asked_elsewhere(problem, pool, stopped):
    asked = tasks(200, 1000)
    assert residuals(pool, asked) == expected(problem, asked)
    assert pool.busy <= 1  # 0 if what was stopped had not begun yet
    os.kill(stopped, signal.SIGCONT)
    deadline = time.monotonic() + 60.0
    while pool.busy and time.monotonic() < deadline:
        assert pool.completed() == [], "another has answered it already"
    assert pool.busy == 0
    asked = tasks(100, 2000)
    assert residuals(pool, asked) == expected(problem, asked)


def test_a_late_answer_is_none_to_another_task_of_the_same_id(problem, pool, stopped):
    residuals(pool, tasks(200, 1000))
    others = [replace(task, id=task.id - 1000) for task in tasks(200, 2000)]
    truth = expected(problem, others)
    pool.submit(others)
    os.kill(stopped, signal.SIGCONT)
    found: dict[int, bytes] = {}
    while len(found) < len(others):
        found |= {outcome.task: outcome.residuals.tobytes() for outcome in pool.completed()}
    assert found == truth


def test_killed_workers_change_no_bit(problem, pool):
    asked = tasks(3000, 0)
    pool.submit(asked)
    found: dict[int, bytes] = {}
    for kill_at in (300, 900, 10**9):
        while len(found) < min(kill_at, len(asked)):
            found |= {o.task: o.residuals.tobytes() for o in pool.completed()}
        running = ray_actors()
        if running and kill_at < len(asked):
            os.kill(min(running), signal.SIGKILL)
    assert found == expected(problem, asked)


@pytest.fixture
def counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CountedInstances:
    folder = tmp_path / "counted"
    folder.mkdir()
    monkeypatch.setenv(VARIABLE, str(folder))
    return CountedInstances(folder)


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[Cluster]:
    """A cluster of one node, with one processor if nothing else is asked for."""
    processors = getattr(request, "param", 1)
    head = {"num_cpus": processors, "include_dashboard": False}
    made = Cluster(initialize_head=True, head_node_args=head)
    yield made
    ray.shutdown()
    made.shutdown()


def found_by(executor: WorkerPool, requests, record=lambda *_: None) -> list[bytes]:
    """What searches find."""
    return [s.x.tobytes() for s in Runner(executor, record=record).run(requests)]


def test_a_lost_node_and_a_new_one_change_no_bit(problem, cluster):
    space = make_space(problem, problem.indices("train"))
    starts = np.random.default_rng(0).uniform(0.8, 1.2, (40, space.size)) * space.start
    requests = [
        SearchRequest(f"start {i}", ce.LeastSquares(trials=1), space.starting_at(x))
        for i, x in enumerate(starts)
    ]
    with opened(problem, "local", 1, None) as executor:
        truth = found_by(executor, requests)

    second = cluster.add_node(num_cpus=1)
    seen: Counter[str] = Counter()
    lost_after: list[int] = []

    def disturb(origin, outcome):
        """On a busy machine the second worker may begin long after the first one."""
        seen[outcome.worker] += 1
        if not lost_after and len(seen) == 2 and seen.total() >= 300:
            lost_after.append(seen.total())
            cluster.remove_node(second, allow_graceful=False)
        if lost_after and seen.total() == lost_after[0] + 300:
            cluster.add_node(num_cpus=1)

    with opened(problem, "ray", None, cluster.address) as executor:
        begin = time.monotonic()
        while len(seen) < 3 and time.monotonic() - begin < 900.0:  # some seconds on an idle machine
            assert found_by(executor, requests, disturb) == truth
    assert len(seen) >= 3


@pytest.fixture
def folders(tmp_path, monkeypatch) -> list[Path]:
    """Of the first node, which works where it is started, of the second one and the program."""
    made = [tmp_path / name for name in ("head", "second", "program")]
    for folder in made:
        folder.mkdir()
    monkeypatch.chdir(made[0])
    return made


def test_nodes_that_work_in_other_folders_need_no_files(folders, cluster, monkeypatch):
    """Relative paths are those of the program; the FMU and what was measured travel by content."""
    *of_nodes, program = folders
    monkeypatch.chdir(of_nodes[1])
    cluster.add_node(num_cpus=1)
    monkeypatch.chdir(program)
    shutil.copytree(ROOT / "configs", "configs")
    problem = ce.read_problem("configs/mass_spring_damper.toml")
    requests = [
        SearchRequest(f"start {experiment}", ce.LeastSquares(), make_space(problem, (experiment,)))
        for experiment in problem.indices("train")
    ]
    with opened(problem, "local", 1, None) as executor:
        truth = found_by(executor, requests)
    with opened(problem, "ray", 2, cluster.address) as pool:
        pool.free_instances(2)  # waits until both have begun
        at_work = {Path(os.readlink(f"/proc/{process}/cwd")) for process in ray_actors()}
        assert found_by(pool, requests) == truth
    assert at_work == set(of_nodes)
    assert not any(list(folder.iterdir()) for folder in of_nodes)


def test_eight_workers_share_three_instances(own_fmu, counted):
    """With solver rk4 the error of its step is measured at the end, in a further process."""
    decay = decay_problem(own_fmu("counts_instances", 2), "rk4", 1.9)
    found = ce.fit(decay, resources=ce.Resources("ray", 8, instances=3))
    assert found.estimates[0].value == pytest.approx(RATE, rel=1e-4)
    assert found.solver_error is not None
    assert counted.most <= 3  # fewer, if an actor begins when there is nothing left to do
    assert counted.made <= 3 + 1
    assert found.simulated > 20


@pytest.mark.parametrize("cluster", [2], indirect=True)
def test_an_actor_in_the_place_of_a_killed_one_waits_for_its_instance(own_fmu, counted, cluster):
    """On the same node; where that is lost with the actor, on another one."""
    second = cluster.add_node(num_cpus=1)
    decay = decay_problem(own_fmu("counts_instances", 2), "rk4", 1.9)
    model = ce.Resources(instances=3).limited(decay.model)
    rates = [1.0 + 0.01 * i for i in range(60)]
    with opened(replace(decay, model=model), "ray", 8, cluster.address) as pool:
        assert pool.workers == 3
        check_decays(answered(pool, rates), rates, 1e-4)
        pool.free_instances(3)  # waits until all have begun
        before = Counter(ray_actors().values())
        assert len(before) == 2, "there are some on each node"
        for turn in (1, 2):
            for process in ray_actors():
                os.kill(process, signal.SIGKILL)
            check_decays(answered(pool, rates, 100 * turn), rates, 1e-4)
            pool.free_instances(3)  # waits until each has begun again
            assert Counter(ray_actors().values()) == before, "each is where the one before it was"
        cluster.remove_node(second, allow_graceful=False)
        cluster.add_node(num_cpus=1)
        check_decays(answered(pool, rates, 1000), rates, 1e-4)
    assert counted.made >= 3 + 6
    assert counted.most == 3
