"""A simulation that crashes, hangs or leaks costs only itself; and where its process comes from."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, closing, contextmanager
from dataclasses import replace
from multiprocessing import reduction
from multiprocessing.connection import Connection

import numpy as np
import pytest
from support.processes_of_fmus import has_ended, kill, living, parent, wait_until, worker_since

from workers.evaluate import Evaluator
from workers.messages import USUAL, Experiment, Input, Limits, Model, Output, Solver, Status, Task
from workers.process.forked import END, FORK, TemplateClient, shared_address
from workers.process.progress_watch import SharedProgress
from workers.process.supervisor import SupervisedEvaluator
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
def model(built_fmu):
    """An FMU that misbehaves as its parameters say."""
    names, archive = ("rate", "kind", "share", "leak"), built_fmu("misbehaves")
    return Model("misbehaves.fmu", archive, "model_exchange", Solver("rk4", 0.02), names)


@pytest.fixture
def open_guard(model):
    guards = []

    def make(limits):
        guards.append(SupervisedEvaluator(model, EXPERIMENTS, "guarded", limits))
        return guards[-1]

    yield make
    for guard in guards:
        guard.close()


def chance(rate):
    """Which part of the rates misbehaves earlier than this one; the FMU's own arithmetic."""
    mask = 2**64 - 1
    bits = int(np.float64(rate).view(np.uint64))
    bits = ((bits ^ bits >> 31) * 0x7FB5D329728EA185) & mask
    bits = ((bits ^ bits >> 27) * 0x81DADEF4BC2DD44D) & mask
    return ((bits ^ bits >> 33) >> 11) / 2**53


def tasks(rates, kind=0.0, share=0.0, leak=0.0):
    return [
        Task(i, i % 2, np.array([rate, kind, share, leak])) for i, rate in enumerate(rates.tolist())
    ]


def in_batches(guard, asked, size=10):
    return [
        outcome
        for first in range(0, len(asked), size)
        for outcome in guard.evaluate(TaskBatch.of(asked[first : first + size]))
    ]


def bits(outcomes):
    assert all(outcome.ok for outcome in outcomes)
    return [outcome.residuals.tobytes() for outcome in outcomes]


def bad(share):
    return {i for i, rate in enumerate(RATES.tolist()) if chance(rate) < share}


HANGING = next(i for i in range(len(RATES)) if i in bad(0.05))
HANG = TaskBatch.of([tasks(RATES, HANGS, 0.05)[HANGING]])


@pytest.mark.parametrize(
    ("kind", "share", "status", "phrase"),
    [
        (CRASHES, 0.1, Status.CRASH, "crashed during this simulation (SIGSEGV)"),
        pytest.param(
            *(ABORTS, 0.1, Status.CRASH, "crashed during this simulation (SIGABRT)"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *(EXITS, 0.1, Status.CRASH, "ended by the FMU during this simulation (exit code 3)"),
            marks=pytest.mark.slow,
        ),
        (HANGS, 0.03, Status.TIMEOUT, "did not end within"),
    ],
    ids=["segfault", "abort", "exit", "hang"],
)
def test_what_fails_is_an_outcome_and_spares_all_others(
    model, open_guard, kind, share, status, phrase
):
    guard, alone = open_guard(Limits(seconds=1.5)), Evaluator(model, EXPERIMENTS, "reference")
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


@pytest.fixture
def simulations(tmp_path, monkeypatch):
    """How many simulations there were since it was last asked."""
    file = tmp_path / "simulations"
    monkeypatch.setenv("SIMULATIONS_COUNTED_IN", str(file))

    def count():
        found = file.stat().st_size if file.exists() else 0
        file.unlink(missing_ok=True)
        return found

    return count


GOOD = np.array([rate for rate in RATES.tolist() if chance(rate) >= 0.2])
CRASHING = next(rate for rate in RATES.tolist() if chance(rate) < 0.2)
MIXED = np.array([GOOD[0], GOOD[1], CRASHING, GOOD[2]])
"""Alone, three are simulated once and one twice."""


def test_simulations_go_alone_until_they_are_known_and_after_a_failure(open_guard, simulations):
    guard, mixed = open_guard(QUICK), TaskBatch.of(tasks(MIXED, CRASHES, 0.2))
    good = tasks(GOOD[:4])

    def ask():
        assert [outcome.ok for outcome in guard.evaluate(mixed)] == [True, True, False, True]

    ask()
    assert simulations() == 5
    ask()  # a while without failures has to pass first
    assert simulations() == 5
    for _ in range(130):
        assert all(outcome.ok for outcome in guard.evaluate(TaskBatch.of(good)))
    simulations()
    ask()  # the batch, up to the crash, and then each of it alone
    assert simulations() >= 3 + 4


@pytest.mark.parametrize("want", USUAL)
def test_whatever_is_sent_of_them_known_simulations_travel_together(open_guard, simulations, want):
    guard = open_guard(QUICK)
    guard.evaluate(TaskBatch.of([replace(task, want=want) for task in tasks(GOOD[:4])]))
    assert simulations() == 4
    mixed = [replace(task, want=want) for task in tasks(MIXED, CRASHES, 0.2)]
    assert [o.ok for o in guard.evaluate(TaskBatch.of(mixed))] == [True, True, False, True]
    assert simulations() >= 3 + 4


def test_what_sleeps_without_a_step_is_asked_again_and_then_ended(open_guard):
    """The next one is none the worse for it."""
    guard = open_guard(Limits(seconds=60.0, stall=0.3))
    (outcome,) = guard.evaluate(HANG)
    assert outcome.status is Status.TIMEOUT
    assert "stalled: no step ended for 0.3 s" in outcome.message
    (outcome,) = guard.evaluate(TaskBatch.of([tasks(RATES)[HANGING]]))
    assert outcome.ok


def test_what_is_stopped_and_goes_on_is_no_failure(open_guard):
    """It stands still for five times as long as it may, and no time passes for it."""
    before = living()
    guard, asked = open_guard(Limits(stall=0.2)), tasks(RATES[:10])
    expected = bits(in_batches(guard, asked))
    worker, _ = worker_since(before)
    os.kill(worker, signal.SIGSTOP)
    timer = threading.Timer(1.0, os.kill, (worker, signal.SIGCONT))
    timer.start()
    assert bits(in_batches(guard, asked)) == expected
    timer.join()
    assert worker_since(before)[0] == worker


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
        assert (
            "MB of memory and was stopped; if it needs that much, raise executor.memory"
            in outcome.message
        )


def test_a_leak_is_bounded_and_changes_no_bit(open_guard):
    asked = tasks(np.linspace(0.1, 1.9, 100), leak=4.0)
    whole = open_guard(Limits())
    before = living()
    leaking, processes = open_guard(Limits(growth=30.0 * 2**20)), set()
    for first in range(0, len(asked), 5):
        processes.update(living().keys() - before.keys())
        batch = TaskBatch.of(asked[first : first + 5])
        assert bits(leaking.evaluate(batch)) == bits(whole.evaluate(batch))
    assert len(processes) > 100 / 15


@pytest.mark.parametrize(
    "which", ["worker", "fork server", pytest.param("template", marks=pytest.mark.slow)]
)
def test_killed_from_outside_it_goes_on(open_guard, which):
    """Whichever process it is of those that an FMU's comes from."""
    before = living()
    guard, asked = open_guard(QUICK), tasks(RATES[:30])
    expected = bits(in_batches(guard, asked))
    for _ in range(2):
        worker, server = worker_since(before)
        killed = {"worker": worker, "fork server": server, "template": parent(server)}[which]
        kill(killed)
        if which == "template":
            kill(server)
        assert has_ended(worker)
        assert bits(in_batches(guard, asked)) == expected
        assert worker_since(before)[0] != worker


def test_nothing_is_left_running(open_guard):
    before = living()
    guard = open_guard(QUICK)
    in_batches(guard, tasks(RATES[:4]))
    worker, server = worker_since(before)
    guard.close()
    guard.close()
    assert has_ended(server)
    assert has_ended(worker)


def test_a_process_dies_with_its_fork_server_even_in_the_middle_of_a_hang(open_guard):
    before = living()
    guard = open_guard(Limits(seconds=60.0))
    worker, server = worker_since(before)
    asking = threading.Thread(target=guard.evaluate, args=(HANG,))
    asking.start()
    time.sleep(0.3)
    assert asking.is_alive()
    os.kill(server, signal.SIGKILL)
    assert has_ended(worker)
    # it may just be beginning another one, which has to be stopped too
    assert wait_until(lambda: guard.stop() or not asking.is_alive())


def test_an_interrupt_leaves_no_answer_for_somebody_else(open_guard):
    guard, asked = open_guard(Limits(seconds=60.0)), tasks(RATES[:4])
    expected = bits(in_batches(guard, asked))

    def interrupted():
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        guard.evaluate(HANG)

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert bits(in_batches(guard, asked)) == expected


CHECK = 'exec "$0" -c "from cluster_est.cli import run; run()" check "$1" 2>&-'


@pytest.mark.parametrize(
    ("variable", "shared"), [(None, True), ("NEW_FOR_A_TEST", True), ("LD_NEW_FOR_A_TEST", False)]
)
def test_it_is_one_for_all_that_do_not_read_other_things_when_they_start(
    model, monkeypatch, variable, shared
):
    found, before = [], living()
    with ExitStack() as guards:
        for _ in range(2):
            guard = SupervisedEvaluator(model, EXPERIMENTS[:1], "guarded", Limits())
            guards.enter_context(closing(guard))
            _, server = worker_since(before)
            found.append((bits(in_batches(guard, tasks(RATES[:1]))), server, parent(server)))
            before = living()
            if variable:
                monkeypatch.setenv(variable, "1")
    (one, server, template), (other, other_server, other_template) = found
    assert one == other
    assert server != other_server
    assert (template == other_template) is shared


@pytest.mark.slow
def test_a_program_needs_no_standard_error(own_fmu):
    command = ["sh", "-c", CHECK, sys.executable, str(own_fmu("dahlquist", 2))]
    ended = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    assert "no problem was found" in ended.stdout


@contextmanager
def fork_server(client, model):
    """A fork server of a client: its process, and the connection that it takes orders from."""
    mine, theirs = socket.socketpair()
    progress, installation = SharedProgress(), (model, EXPERIMENTS[:1], "shared")
    with theirs:
        server = client.fork_server(installation, theirs.fileno(), progress.descriptor)
    with Connection(mine.detach()) as orders:
        yield server, orders
        orders.send(END)
    progress.close()


@pytest.fixture
def group(tmp_path, monkeypatch):
    """Two programs that share a template, as far as it knows."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    clients = [TemplateClient(), TemplateClient()]
    for client in clients:
        client.share("group")
    yield clients
    for client in clients:
        client.close()


def test_a_group_shares_one_that_is_nobody_s_child(model, group):
    with fork_server(group[0], model) as (one, _), fork_server(group[1], model) as (other, _):
        assert one != other
        assert parent(one) == parent(other) != os.getpid()
        assert parent(parent(one)) != os.getpid()


def test_a_shared_one_goes_on_for_the_others_and_ends_with_the_last(model, group, tmp_path):
    with fork_server(group[0], model) as (one, _), fork_server(group[1], model):
        template = parent(one)
    group[0].close()
    with fork_server(group[1], model) as (other, _):
        assert parent(other) == template
    group[1].close()
    assert wait_until(lambda: not any(tmp_path.iterdir()))


@pytest.mark.slow
def test_a_shared_one_that_was_killed_is_replaced_for_all(model, group):
    with fork_server(group[0], model) as (one, _), fork_server(group[1], model) as (_, orders):
        killed = parent(one)
        os.kill(killed, signal.SIGKILL)
        with fork_server(group[0], model) as (third, _), fork_server(group[1], model) as (last, _):
            assert parent(third) == parent(last) != killed
        orders.send(FORK)  # the fork server that came from it serves on
        mine, theirs = socket.socketpair()
        with mine, theirs:
            reduction.send_handle(orders, theirs.fileno(), os.getpid())
        assert orders.poll(30.0)
        assert orders.recv() > 0


@pytest.mark.slow
def test_where_no_socket_can_be_each_has_its_own(model, group, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / ("long" * 30)))
    with fork_server(group[0], model) as (one, _), fork_server(group[1], model) as (other, _):
        assert parent(one) != parent(other)


def test_what_is_read_at_start_decides_who_shares():
    assert shared_address("g", {"OMP_A": "1"}) != shared_address("g", {"OMP_A": "2"})
    assert shared_address("g", {}) != shared_address("h", {})


TWO_FORKS = """
import os
import sys
import numpy.random
from workers.process.template import draw_anew

for _ in range(2):
    if os.fork() == 0:
        if sys.argv[1] == "anew":
            draw_anew()
        print(numpy.random.random(), flush=True)
        os._exit(0)
    os.wait()
"""


def drawn(how):
    done = subprocess.run(
        [sys.executable, "-c", TWO_FORKS, how], capture_output=True, text=True, check=True
    )
    return done.stdout.split()


@pytest.mark.slow
def test_an_fmu_in_python_does_not_draw_the_same_in_each_process():
    """With the state that forks inherit it would, and seem to repeat."""
    one, other = drawn("inherited")
    assert one == other
    one, other = drawn("anew")
    assert one != other
