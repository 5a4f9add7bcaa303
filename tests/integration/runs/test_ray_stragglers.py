"""A worker that stands still holds nobody up, and one that is killed loses nothing."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import ray
from support.descendants import ray_actors
from support.problems.springs import spring_problem

from cluster_est.executors.local import LocalExecutor
from cluster_est.executors.ray_pool import RayPool
from workers.messages import Task


@pytest.fixture
def problem():
    return spring_problem(noise=0.01).problem


@pytest.fixture
def pool(problem) -> Iterator[RayPool]:
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    with RayPool.open(problem.model, problem.experiments, 2, None) as executor:
        yield executor
    assert not ray.is_initialized()


def tasks(problem, count: int, first: int) -> list[Task]:
    generator = np.random.default_rng(first)
    values = generator.uniform([1.0, 20.0, 0.5, 0.0], [1.5, 40.0, 1.0, 0.1], (count, 4))
    return [Task(first + i, i % 5, row) for i, row in enumerate(values)]


def answers(executor, asked: list[Task]) -> dict[int, bytes]:
    executor.submit(asked)
    found: dict[int, bytes] = {}
    while len(found) < len(asked):
        for outcome in executor.completed():
            assert outcome.task not in found
            found[outcome.task] = outcome.residuals.tobytes()
    return found


def expected(problem, asked: list[Task]) -> dict[int, bytes]:
    with LocalExecutor.open(problem.model, problem.experiments, 1, None) as executor:
        return answers(executor, asked)


def test_what_a_worker_holds_up_is_asked_elsewhere(problem, pool):
    answers(pool, tasks(problem, 100, 0))
    stopped = ray_actors()[0]
    os.kill(stopped, signal.SIGSTOP)
    try:
        asked = tasks(problem, 200, 1000)
        assert answers(pool, asked) == expected(problem, asked)
        assert pool.busy <= 1  # 0 if what was stopped had not begun yet
    finally:
        os.kill(stopped, signal.SIGCONT)
    deadline = time.monotonic() + 60.0
    while pool.busy and time.monotonic() < deadline:
        assert pool.completed() == [], "another has answered it already"
    assert pool.busy == 0
    asked = tasks(problem, 100, 2000)
    assert answers(pool, asked) == expected(problem, asked)


def test_a_late_answer_is_none_to_another_task_of_the_same_id(problem, pool):
    answers(pool, tasks(problem, 100, 0))
    stopped = ray_actors()[0]
    os.kill(stopped, signal.SIGSTOP)
    try:
        answers(pool, tasks(problem, 200, 1000))
        others = [replace(task, id=task.id - 1000) for task in tasks(problem, 200, 2000)]
        truth = expected(problem, others)
        pool.submit(others)
    finally:
        os.kill(stopped, signal.SIGCONT)
    found: dict[int, bytes] = {}
    while len(found) < len(others):
        found |= {outcome.task: outcome.residuals.tobytes() for outcome in pool.completed()}
    assert found == truth


def test_killed_workers_change_no_bit(problem, pool):
    asked = tasks(problem, 3000, 0)
    pool.submit(asked)
    found: dict[int, bytes] = {}
    for kill_at in (300, 900, 10**9):
        while len(found) < min(kill_at, len(asked)):
            found |= {o.task: o.residuals.tobytes() for o in pool.completed()}
        running = ray_actors()
        if running and kill_at < len(asked):
            os.kill(running[0], signal.SIGKILL)
    assert found == expected(problem, asked)
