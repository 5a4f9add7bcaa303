"""Never more instances of an FMU than `executor.instances` allows, in Ray's actors.

The FMU counts its instances itself. The truth is the solution of x' = -k x, x(0) = 1, by hand.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import ray
from ray.cluster_utils import Cluster
from support.counted import VARIABLE, CountedInstances
from support.descendants import ray_actors

from cluster_est import Parameter, Problem
from cluster_est.executors.ray_pool import RayPool
from cluster_est.fit import fit
from cluster_est.running.resources import Resources
from workers.messages import Experiment, Model, Outcome, Output, Solver, Task

Give = Callable[[str, int], Path]

RATE = 1.3
TIMES = np.linspace(0.0, 2.0, 41)


@pytest.fixture
def counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CountedInstances:
    folder = tmp_path / "counted"
    folder.mkdir()
    monkeypatch.setenv(VARIABLE, str(folder))
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    return CountedInstances(folder)


@pytest.fixture
def decay(own_fmu: Give) -> Problem:
    fmu = own_fmu("counts_instances", 2)
    model = Model(fmu.name, fmu.read_bytes(), "model_exchange", Solver("rk4"), ("k",))
    output = Output("y", TIMES, np.exp(-RATE * TIMES))
    runs = tuple(Experiment(name, 0.0, 2.0, (), (output,)) for name in "abcd")
    return Problem(model, (Parameter("k", 0.7, 0.01, 1.9),), runs)


@pytest.fixture
def cluster(counted: CountedInstances) -> Iterator[Cluster]:
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
    yield made
    ray.shutdown()
    made.shutdown()


def answered(executor: RayPool, first: int) -> list[Outcome]:
    tasks = [Task(first + i, i % 4, np.array([1.0 + 0.01 * i])) for i in range(60)]
    executor.submit(tasks)
    found: dict[int, Outcome] = {}
    while len(found) < len(tasks):
        found |= {outcome.task: outcome for outcome in executor.completed()}
    return [found[task.id] for task in tasks]


def check(outcomes: list[Outcome]) -> None:
    for i, outcome in enumerate(outcomes):
        expected = np.exp(-RATE * TIMES) - np.exp(-(1.0 + 0.01 * i) * TIMES)
        assert np.allclose(outcome.residuals, expected, atol=1e-4)


def test_eight_workers_share_three_instances(decay: Problem, counted: CountedInstances) -> None:
    """With solver rk4 the error of its step is measured at the end, in a further process."""
    found = fit(decay, resources=Resources("ray", 8, instances=3))
    assert found.estimates[0].value == pytest.approx(RATE, rel=1e-4)
    assert found.solver_error is not None
    assert counted.most <= 3  # fewer, if an actor begins when there is nothing left to do
    assert counted.made <= 3 + 1
    assert found.simulated > 20


def test_an_actor_in_the_place_of_a_killed_one_waits_for_its_instance(
    decay: Problem, cluster: Cluster, counted: CountedInstances
) -> None:
    """On the same node; where that is lost with the actor, on another one."""
    second = cluster.add_node(num_cpus=1)
    model = Resources(instances=3).limited(decay.model)
    with RayPool.open(model, decay.experiments, 8, cluster.address) as pool:
        assert pool.workers == 3
        check(answered(pool, 0))
        pool.free_instances(3)  # waits until all have begun
        before = placed(pool)
        assert set(before.values()) == {node["NodeID"] for node in ray.nodes()}
        for turn in (1, 2):
            for process in ray_actors():
                os.kill(process, signal.SIGKILL)
            check(answered(pool, 100 * turn))
            pool.free_instances(3)  # waits until each has begun again
            assert placed(pool) == before, "each is where the one before it was"
        cluster.remove_node(second, allow_graceful=False)
        cluster.add_node(num_cpus=1)
        check(answered(pool, 1000))
    assert counted.made >= 3 + 6
    assert counted.most == 3


def placed(pool: RayPool) -> dict[int, str]:
    """The node of each seat's actor, as the actor says."""
    of = pool._seats._of
    return {of[name]: ray.get(actor.node.remote()) for name, actor in pool._actors.items()}
