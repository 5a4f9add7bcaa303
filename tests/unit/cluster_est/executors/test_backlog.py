"""Batches of tasks that wait: as long as they are worth the trip, and not longer."""

import numpy as np
import pytest

from cluster_est.executors.backlog import TaskBacklog
from workers.messages import Outcome, Status, Task


def tasks(count: int, want: str = "residuals", first: int = 0) -> list[Task]:
    return [Task(first + i, 0, np.array([float(i)]), want) for i in range(count)]  # type: ignore[arg-type]


def taking(seconds: float, shares: int = 1, **options: float) -> TaskBacklog:
    """A backlog that has learned how long a simulation takes."""
    backlog = TaskBacklog(shares, **options)
    backlog.add(tasks(1, first=1000))
    batch = backlog.take()
    backlog.learn(batch, [Outcome(1000, Status.OK, seconds=seconds)])
    return backlog


@pytest.mark.parametrize(
    ("seconds", "few_seconds", "expected"),
    [
        (0.001, 0.5, 101),
        (0.1, 0.5, 5),
        (0.1, 0.9, 9),
        (0.2, 0.9, 4),
        (0.3, 0.5, 1),
        (0.3, 0.9, 3),
        (5.0, 0.9, 1),
    ],
)
def test_a_batch_takes_a_tenth_of_a_second_or_has_a_few_tasks(seconds, few_seconds, expected):
    backlog = taking(seconds, few_seconds=few_seconds)
    backlog.add(tasks(1000))
    taken = backlog.take().ids.tolist()
    assert len(taken) == pytest.approx(expected, abs=expected // 100)  # sums of 0.001 are rounded
    assert taken == list(range(len(taken)))


@pytest.mark.parametrize(("seconds", "expected"), [(0.01, 5), (0.1, 5), (0.0005, 10)])
def test_no_worker_holds_more_than_its_share_unless_that_is_hardly_anything(seconds, expected):
    backlog = taking(seconds, shares=4)
    backlog.add(tasks(20))
    assert len(backlog.take().ids) == expected


def test_what_is_wanted_differs_between_batches_and_not_within_one():
    backlog = taking(0.001)
    backlog.add([*tasks(3), *tasks(2, "trajectory", first=3), *tasks(1, first=5)])
    batches = [backlog.take() for _ in range(3)]
    assert [batch.ids.tolist() for batch in batches] == [[0, 1, 2], [3, 4], [5]]
    assert [batch.want for batch in batches] == ["residuals", "trajectory", "residuals"]
    assert not backlog


def test_what_is_taken_back_is_not_given_out_and_what_was_lost_goes_first():
    backlog = taking(1.0)
    waiting = tasks(4)
    backlog.add(waiting)
    assert backlog.remove([2, 0, 77]) == [0, 2]
    backlog.add_first(waiting[2])
    assert [backlog.take().ids.tolist() for _ in range(3)] == [[2], [1], [3]]
