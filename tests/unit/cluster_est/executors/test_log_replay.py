"""Answers from a log: in its order, each once, and what it lacks is simulated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.problems.functions import ROSENBROCK
from support.shuffling_executor import ShufflingExecutor

from cluster_est.executors.log_replay import LogReplayExecutor
from cluster_est.run_folder.evaluation_log import EvaluationLog
from cluster_est.run_folder.log_segment import read_log
from cluster_est.run_folder.logged_outcomes import LoggedOutcomes
from cluster_est.running.resources import LogSettings, TaskOrigin
from workers.messages import Outcome, Status, Task, Trajectory

MODEL, EXPERIMENTS = ROSENBROCK.problem().model, ROSENBROCK.problem().experiments


def answer(task: Task) -> Outcome:
    """What the valley is at a point; it cannot be computed left of -1.5."""
    x, steps = task.values, np.arange(3.0)
    if x[0] < -1.5:
        return Outcome(task.id, Status.SOLVER_FAILURE, message="too far left", worker="w")
    path = Trajectory(("a", "b"), steps, np.outer(steps, x)) if task.want == "trajectory" else None
    found = replace(ROSENBROCK.answer(task), trajectory=path, constraints=x[:1])
    return replace(found, seconds=0.5, worker="w", steps=7 + task.id)


def tasks(*values: float, want: str = "residuals") -> list[Task]:
    return [Task(i, 0, np.array([v, 0.5]), want) for i, v in enumerate(values)]  # type: ignore[arg-type]


class Replayed:
    """An executor behind a log of some tasks, in a folder, and the one that simulates others."""

    def __init__(
        self, folder: Path, logged: list[Task], settings: LogSettings | None = None
    ) -> None:
        names = [(each.id, each.key) for each in EXPERIMENTS]
        log = EvaluationLog(folder, MODEL.key, names, {}, settings)
        for task in logged:
            log.record(TaskOrigin(task, "train", 0, "trial"), answer(task))
        log.close()
        self.known = LoggedOutcomes(folder)
        self.inner = ShufflingExecutor(answer)
        self.executor = LogReplayExecutor(self.inner, MODEL, EXPERIMENTS, self.known)
        self.submit, self.completed = self.executor.submit, self.executor.completed

    @property
    def simulated(self) -> set[int]:
        return {task.id for task in self.inner.submitted}

    def drain(self, count: int) -> list[int]:
        found: list[int] = []
        while len(found) < count:
            found += [outcome.task for outcome in self.completed()]
        return found


def bytes_of(array: np.ndarray | None) -> bytes | None:
    return None if array is None else array.tobytes()


@pytest.mark.parametrize("want", ["residuals", "trajectory"])
def test_what_is_logged_is_given_back_as_it_was(tmp_path: Path, want: str) -> None:
    asked = tasks(0.1, -1.7, 0.3, want=want)
    replayed = Replayed(tmp_path, asked)
    replayed.submit(asked)
    for task in asked:
        (found,) = replayed.completed()
        true = answer(task)
        assert (found.task, found.status, found.message) == (task.id, true.status, true.message)
        assert (found.seconds, found.worker) == (true.seconds, true.worker)
        assert found.steps == true.steps
        np.testing.assert_array_equal(found.constraints, true.constraints)
        assert bytes_of(found.residuals) == bytes_of(true.residuals)
        assert (found.trajectory is None) == (true.trajectory is None)
        if found.trajectory is not None and true.trajectory is not None:
            assert found.trajectory.variables == true.trajectory.variables
            np.testing.assert_array_equal(found.trajectory.times, true.trajectory.times)
            np.testing.assert_array_equal(found.trajectory.values, true.trajectory.values)
    assert not replayed.simulated


def test_answers_come_in_the_order_of_the_log_then_the_others(tmp_path: Path) -> None:
    one, two, three, four = tasks(0.1, 0.2, 0.3, 0.4)
    replayed = Replayed(tmp_path, [three, one])
    replayed.submit([one, two])  # three is not asked yet: it cannot be waited for
    assert replayed.drain(1) == [one.id]
    replayed.submit([three, four])
    assert replayed.drain(3)[0] == three.id
    assert replayed.simulated == {two.id, four.id}


def test_the_same_question_asked_again_takes_the_next_row(tmp_path: Path) -> None:
    one, again, third = (replace(tasks(0.1)[0], id=i) for i in range(3))
    replayed = Replayed(tmp_path, [one, again])
    replayed.submit([one, again, third])
    assert replayed.drain(3) == [0, 1, 2]
    assert replayed.simulated == {2}


def test_what_is_wanted_is_part_of_the_question(tmp_path: Path) -> None:
    replayed = Replayed(tmp_path, tasks(0.1))
    replayed.submit(tasks(0.1, want="trajectory"))
    (found,) = replayed.completed()
    assert found.trajectory is not None
    assert replayed.simulated == {0}


def test_rows_without_residuals_are_simulated_again_and_keep_their_turn(tmp_path: Path) -> None:
    asked = tasks(0.1, -1.7, 0.3, 0.4)
    replayed = Replayed(tmp_path, asked[::-1], LogSettings(residuals=False))
    assert read_log(tmp_path)["residuals"].null_count == 4
    replayed.submit(asked)
    outcomes = [replayed.completed() for _ in asked]
    assert [each.task for (each,) in outcomes] == [3, 2, 1, 0]
    assert all(each.ok == (each.task != 1) for (each,) in outcomes)
    assert replayed.simulated == {0, 2, 3}  # a failure needs no residuals


def test_what_is_held_is_not_taken_back_but_the_others_are(tmp_path: Path) -> None:
    asked = tasks(0.1, 0.2, 0.3)
    replayed = Replayed(tmp_path, asked[:1])
    replayed.submit(asked)
    assert replayed.executor.cancel([0, 1]) == [1]
    assert sorted(replayed.drain(2)) == [0, 2]
    assert replayed.simulated == {2}


def test_only_what_was_answered_from_the_log_is_known_to_be_logged(tmp_path: Path) -> None:
    asked = tasks(0.1, 0.2)
    replayed = Replayed(tmp_path, asked[:1])
    replayed.submit(asked)
    replayed.drain(2)
    assert [replayed.known.was_answered(task.id) for task in asked] == [True, False]
    assert not replayed.known.was_answered(0)  # the first task of the next runner
