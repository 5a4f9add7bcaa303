"""Fork servers come from one template process, and take on what the program has at the moment."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from multiprocessing import reduction
from multiprocessing.connection import Connection

import numpy as np
import pytest
from support.processes_of_fmus import living, parent, wait_until, worker_since

from workers.messages import Experiment, Input, Limits, Model, Output, Task
from workers.process.orders import END, FORK
from workers.process.supervisor import SupervisedEvaluator
from workers.process.template_client import TemplateClient, shared_address
from workers.process.watch import SharedProgress
from workers.wire import TaskBatch

TIMES = np.linspace(0.0, 2.0, 9)
EXPERIMENT = Experiment(
    "a", 0.0, 2.0, (Input("u", TIMES, np.sin(TIMES)),), (Output("y", TIMES, np.zeros(9)),)
)
CHECK = 'exec "$0" -c "from cluster_est.cli import run; run()" check "$1" 2>&-'


def answer(guard: SupervisedEvaluator) -> bytes:
    (outcome,) = guard.evaluate(TaskBatch.of([Task(0, 0, np.array([1.0, 0.0, 0.0, 0.0]))]))
    return outcome.residuals.tobytes()


@pytest.mark.parametrize(
    ("variable", "shared"), [(None, True), ("NEW_FOR_A_TEST", True), ("LD_NEW_FOR_A_TEST", False)]
)
def test_it_is_one_for_all_that_do_not_read_other_things_when_they_start(
    model, monkeypatch, variable, shared
):
    found, before = [], living()
    with ExitStack() as guards:
        for _ in range(2):
            guard = SupervisedEvaluator(model, (EXPERIMENT,), "guarded", Limits())
            guards.enter_context(closing(guard))
            _, server = worker_since(before)
            found.append((answer(guard), server, parent(server)))
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
def fork_server(client: TemplateClient, model: Model) -> Iterator[tuple[int, Connection]]:
    """A fork server of a client: its process, and the connection that it takes orders from."""
    mine, theirs = socket.socketpair()
    progress = SharedProgress()
    with theirs:
        installation = model, (EXPERIMENT,), "shared"
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
import numpy as np
from workers.process.fork_server import draw_anew

for _ in range(2):
    if os.fork() == 0:
        if sys.argv[1] == "anew":
            draw_anew()
        print(np.random.random(), flush=True)
        os._exit(0)
    os.wait()
"""


def drawn(how: str) -> list[str]:
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
