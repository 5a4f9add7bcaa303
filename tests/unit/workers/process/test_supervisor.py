"""A simulation that crashes, hangs or leaks costs only itself."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import (
    USUAL,
    Experiment,
    Input,
    Limits,
    Model,
    Outcome,
    Output,
    Status,
    Task,
)
from workers.process.supervisor import SupervisedEvaluator
from workers.process.template_client import TEMPLATE
from workers.wire import TaskBatch

CRASHES, ABORTS, EXITS, HANGS, EATS_MEMORY = 1.0, 2.0, 3.0, 4.0, 5.0
TIMES = np.linspace(0.0, 2.0, 9)
INPUTS = (Input("u", TIMES, np.sin(TIMES)),)
EXPERIMENTS = tuple(
    Experiment(name, 0.0, 2.0, INPUTS, (Output("y", TIMES, np.zeros(9)),)) for name in "ab"
)
RATES = np.linspace(0.1, 1.9, 60)
QUICK = Limits(seconds=3.0)


@pytest.fixture
def open_guard(model: Model) -> Iterator[Callable[[Limits], SupervisedEvaluator]]:
    guards: list[SupervisedEvaluator] = []

    def make(limits: Limits) -> SupervisedEvaluator:
        guards.append(SupervisedEvaluator(model, EXPERIMENTS, "guarded", limits))
        return guards[-1]

    yield make
    for guard in guards:
        guard.close()


def chance(rate: float) -> float:
    """Which part of the rates misbehaves earlier than this one; the FMU's own arithmetic."""
    mask = 2**64 - 1
    bits = int(np.float64(rate).view(np.uint64))
    bits = ((bits ^ bits >> 31) * 0x7FB5D329728EA185) & mask
    bits = ((bits ^ bits >> 27) * 0x81DADEF4BC2DD44D) & mask
    return ((bits ^ bits >> 33) >> 11) / 2**53


def tasks(rates, kind=0.0, share=0.0, leak=0.0) -> list[Task]:
    return [
        Task(i, i % 2, np.array([rate, kind, share, leak])) for i, rate in enumerate(rates.tolist())
    ]


def has_ended(process: int) -> bool:
    """Whether a process is gone, or is soon; one that only its parent remembers counts as gone."""
    deadline = time.monotonic() + 10.0
    while time.monotonic() < deadline:
        try:
            state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.01)
    return False


def kill(process: int) -> None:
    """End a process, and wait until it has: the signal may arrive later than what follows."""
    os.kill(process, signal.SIGKILL)
    assert has_ended(process)


def in_batches(guard: SupervisedEvaluator, asked: list[Task], size: int = 10) -> list[Outcome]:
    return [
        outcome
        for first in range(0, len(asked), size)
        for outcome in guard.evaluate(TaskBatch.of(asked[first : first + size]))
    ]


def bad(share: float) -> set[int]:
    return {i for i, rate in enumerate(RATES.tolist()) if chance(rate) < share}


@pytest.mark.parametrize(
    ("kind", "share", "status", "phrase"),
    [
        (CRASHES, 0.1, Status.CRASH, "crashed during this simulation (SIGSEGV)"),
        (ABORTS, 0.1, Status.CRASH, "crashed during this simulation (SIGABRT)"),
        (EXITS, 0.1, Status.CRASH, "ended by the FMU during this simulation (exit code 3)"),
        (HANGS, 0.03, Status.TIMEOUT, "did not end within"),
    ],
    ids=["segfault", "abort", "exit", "hang"],
)
def test_what_fails_is_an_outcome_and_spares_all_others(
    model, open_guard, kind, share, status, phrase
):
    guard, alone = open_guard(QUICK), Evaluator(model, EXPERIMENTS, "reference")
    asked = tasks(RATES, kind, share)
    expected = bad(share)
    assert 0 < len(expected) < len(RATES) / 4
    for task, outcome in zip(asked, in_batches(guard, asked), strict=True):
        assert outcome.task == task.id
        if task.id in expected:
            assert outcome.status is status
            assert phrase in outcome.message
            assert outcome.residuals is None
        else:
            (reference,) = alone.evaluate(TaskBatch.of([task]))
            assert outcome.ok
            assert outcome.residuals.tobytes() == reference.residuals.tobytes()
    alone.close()


@pytest.mark.parametrize("want", USUAL)
def test_whatever_is_sent_of_them_simulations_that_are_known_travel_together(
    open_guard, monkeypatch, want
):
    sizes = []
    real = SupervisedEvaluator._ask

    def counted(guard, batch):
        sizes.append(len(batch.ids))
        return real(guard, batch)

    monkeypatch.setattr(SupervisedEvaluator, "_ask", counted)
    guard = open_guard(QUICK)
    batch = TaskBatch.of([replace(task, want=want) for task in tasks(RATES[:4])])
    for _ in range(2):
        assert all(outcome.ok for outcome in guard.evaluate(batch))
    assert sizes == [1, 1, 1, 1, 4]


def test_no_task_is_tried_more_than_twice_alone(open_guard, monkeypatch):
    tried: dict[int, int] = {}
    ask = SupervisedEvaluator._ask

    def counted(self, batch):
        for i in batch.ids.tolist():
            tried[i] = tried.get(i, 0) + 1
        return ask(self, batch)

    monkeypatch.setattr(SupervisedEvaluator, "_ask", counted)
    in_batches(open_guard(QUICK), tasks(RATES, CRASHES, 0.2))
    assert max(tried.values()) <= 3


def test_what_sleeps_without_a_step_is_asked_again_and_then_ended(open_guard):
    """The next one is none the worse for it."""
    guard = open_guard(Limits(seconds=60.0, stall=0.3))
    hanging = next(i for i in range(len(RATES)) if i in bad(0.05))
    (outcome,) = guard.evaluate(TaskBatch.of([tasks(RATES, HANGS, 0.05)[hanging]]))
    assert outcome.status is Status.TIMEOUT
    assert "stood still for 0.3 s, in which no step ended" in outcome.message
    (outcome,) = guard.evaluate(TaskBatch.of([tasks(RATES)[hanging]]))
    assert outcome.ok


def test_what_is_stopped_and_goes_on_is_no_failure(open_guard, monkeypatch):
    """It stands still for five times as long as it may, and no time passes for it."""
    monkeypatch.setattr("workers.process.failures.LOAD_SECONDS", 0.2)
    guard, asked = open_guard(Limits(stall=0.2)), tasks(RATES[:10])
    expected = in_batches(guard, asked)
    child = guard._child[0]
    os.kill(child, signal.SIGSTOP)
    timer = threading.Timer(1.0, os.kill, (child, signal.SIGCONT))
    timer.start()
    found = in_batches(guard, asked)
    timer.join()
    assert guard._child[0] == child
    assert [o.residuals.tobytes() for o in found] == [o.residuals.tobytes() for o in expected]


def test_the_last_try_is_in_a_process_that_nothing_was_simulated_in(open_guard):
    """Memory that others leave behind, 20 MB each, must not make a simulation fail."""
    limits = Limits(memory=450.0 * 2**20, growth=1e12)
    guard = open_guard(limits)
    outcomes = in_batches(guard, tasks(np.linspace(0.1, 1.9, 60), leak=20.0))
    assert all(outcome.ok for outcome in outcomes)


def test_too_much_memory_is_said_to_be_that(open_guard):
    limits = Limits(seconds=120.0, memory=700.0 * 2**20)
    outcomes = in_batches(open_guard(limits), tasks(RATES[:20], EATS_MEMORY, 0.1))
    expected = {i for i in bad(0.1) if i < 20}
    failed = {outcome.task: outcome for outcome in outcomes if not outcome.ok}
    assert set(failed) == expected
    for outcome in failed.values():
        assert outcome.status is Status.OUT_OF_MEMORY
        assert "MB of memory and was stopped; raise executor.memory" in outcome.message


def test_a_leak_is_bounded_and_changes_no_bit(open_guard):
    asked = tasks(np.linspace(0.1, 1.9, 400), leak=1.0)
    leaking, whole = open_guard(Limits(growth=30.0 * 2**20)), open_guard(Limits())
    processes = set()
    for first in range(0, len(asked), 10):
        batch = TaskBatch.of(asked[first : first + 10])
        outcomes, expected = leaking.evaluate(batch), whole.evaluate(batch)
        assert [o.residuals.tobytes() for o in outcomes] == [
            o.residuals.tobytes() for o in expected
        ]
        if leaking._child is not None:
            processes.add(leaking._child[0])
    assert len(processes) >= 400 / 45


def test_killed_from_outside_it_goes_on(open_guard):
    guard = open_guard(QUICK)
    asked = tasks(RATES)
    before = in_batches(guard, asked)
    for _ in range(3):
        os.kill(guard._child[0], signal.SIGKILL)
        after = in_batches(guard, asked)
        assert all(outcome.ok for outcome in after)
        assert [o.residuals.tobytes() for o in after] == [o.residuals.tobytes() for o in before]


def test_even_without_the_process_that_forks_it_goes_on(open_guard):
    guard = open_guard(QUICK)
    asked = tasks(RATES)
    before = in_batches(guard, asked)
    for _ in range(2):
        child, fork_server = guard._child[0], guard._forks.server
        kill(fork_server)
        assert has_ended(child)
        after = in_batches(guard, asked)
        assert guard._forks.server != fork_server
        assert [o.residuals.tobytes() for o in after] == [o.residuals.tobytes() for o in before]


def test_even_without_the_process_that_all_of_them_come_from_it_goes_on(open_guard):
    guard = open_guard(QUICK)
    asked = tasks(RATES)
    before = in_batches(guard, asked)
    template, child = TEMPLATE._process.pid, guard._child[0]
    kill(template)
    kill(guard._forks.server)
    assert has_ended(child)
    after = in_batches(guard, asked)
    assert [o.residuals.tobytes() for o in after] == [o.residuals.tobytes() for o in before]
    assert TEMPLATE._process.pid != template


def test_after_a_while_without_failures_tasks_travel_in_batches_again(open_guard, monkeypatch):
    monkeypatch.setattr("workers.process.supervisor.CAREFUL", 20)
    guard = open_guard(QUICK)
    in_batches(guard, tasks(RATES))
    os.kill(guard._child[0], signal.SIGKILL)
    in_batches(guard, tasks(RATES))
    sizes = []
    ask = SupervisedEvaluator._ask
    monkeypatch.setattr(
        SupervisedEvaluator,
        "_ask",
        lambda self, batch: sizes.append(len(batch.ids)) or ask(self, batch),
    )
    in_batches(guard, tasks(RATES))
    assert sizes == [10] * 6


def test_nothing_is_left_running(open_guard):
    guard = open_guard(QUICK)
    in_batches(guard, tasks(RATES[:4]))
    child, fork_server = guard._child[0], guard._forks.server
    guard.close()
    guard.close()
    assert has_ended(fork_server)
    assert has_ended(child)


def test_a_process_dies_with_its_guard_even_in_the_middle_of_a_hang(model, open_guard):
    guard = open_guard(Limits(seconds=60.0))
    hanging = next(i for i in range(len(RATES)) if i in bad(0.05))
    _, connection = guard._child
    connection.send(TaskBatch.of([tasks(RATES, HANGS, 0.05)[hanging]]))
    child = guard._child[0]
    assert not connection.poll(0.3)
    os.kill(guard._forks.server, signal.SIGKILL)
    assert has_ended(child)
    guard._child = None


def test_an_fmu_that_cannot_be_loaded_is_refused_with_its_sentence(model):
    broken = Model("broken.fmu", b"no archive", "model_exchange", model.solver, ())
    with pytest.raises(ModelError, match=r"broken\.fmu"):
        SupervisedEvaluator(broken, EXPERIMENTS, "guarded", QUICK)


def test_an_interrupt_leaves_no_answer_for_somebody_else(open_guard, monkeypatch):
    guard = open_guard(QUICK)
    asked = tasks(RATES[:4])
    expected = in_batches(guard, asked)

    def interrupted(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(SupervisedEvaluator, "_wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            guard.evaluate(TaskBatch.of(tasks(RATES[10:14])))
    again = in_batches(guard, asked)
    assert [o.residuals.tobytes() for o in again] == [o.residuals.tobytes() for o in expected]
