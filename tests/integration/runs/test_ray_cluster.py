"""Fits on two Ray nodes: in other folders than the program, and where one of them is lost."""

from __future__ import annotations

import os
import shutil
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from support.descendants import ray_actors
from support.problems.springs import ROOT, spring_problem

import cluster_est as ce
from cluster_est.executors.local import LocalExecutor
from cluster_est.executors.ray_pool import RayPool
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest


@pytest.fixture
def cluster() -> Iterator[Cluster]:
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    yield made
    ray.shutdown()
    made.shutdown()


def test_a_lost_node_and_a_new_one_change_no_bit(cluster, monkeypatch):
    monkeypatch.setattr("cluster_est.executors.ray_pool.CLUSTER_SECONDS", 0.5)
    problem = spring_problem(noise=0.01).problem
    space = make_space(problem, problem.indices("train"))
    requests = [
        SearchRequest(f"start {i}", LeastSquares(trials=1), space.starting_at(x))
        for i, x in enumerate(
            np.random.default_rng(0).uniform(0.8, 1.2, (40, space.size)) * space.start
        )
    ]
    with LocalExecutor.open(problem.model, problem.experiments, 1, None) as executor:
        expected = Runner(executor).run(requests)

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

    with RayPool.open(problem.model, problem.experiments, None, cluster.address) as executor:
        begin = time.monotonic()
        while time.monotonic() - begin < 900.0:  # some seconds on an idle machine
            found = Runner(executor, record=disturb).run(requests)
            assert [s.x.tobytes() for s in found] == [s.x.tobytes() for s in expected]
            if len(seen) >= 3:
                break
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
        SearchRequest(f"start {experiment}", LeastSquares(), make_space(problem, (experiment,)))
        for experiment in problem.indices("train")
    ]
    with LocalExecutor.open(problem.model, problem.experiments, 1, None) as executor:
        expected = Runner(executor).run(requests)
    with RayPool.open(problem.model, problem.experiments, 2, cluster.address) as pool:
        pool.free_instances(2)  # waits until both have begun
        at_work = {Path(os.readlink(f"/proc/{process}/cwd")) for process in ray_actors()}
        found = Runner(pool).run(requests)
    assert at_work == set(of_nodes)
    assert [s.x.tobytes() for s in found] == [s.x.tobytes() for s in expected]
    assert not any(list(folder.iterdir()) for folder in of_nodes)
