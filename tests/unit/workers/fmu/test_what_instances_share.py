import ctypes
import signal
import subprocess
import sys
import threading
import time
import uuid
import weakref
from collections import deque
from contextlib import ExitStack

import pytest

from workers.errors import ModelError
from workers.fmu import instance
from workers.fmu import seats as room
from workers.fmu.process_environment import SIGACTION_BYTES, kept_signal_handlers
from workers.fmu.seats import Seat, has_lost
from workers.messages import Seats

HOLDS = """
import sys
from workers.fmu.seats import Seat
from workers.messages import Seats
seat = Seat(Seats(sys.argv[1], (int(sys.argv[2]),)), "other.fmu")
print("taken", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def holder():
    """Start processes that take a seat and keep it."""
    started: list[subprocess.Popen[str]] = []

    def start(seats: Seats, number: int) -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HOLDS, seats.program, str(number)]
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "taken\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.communicate()


@pytest.fixture
def seats():
    """Two seats of nobody else."""
    return Seats(uuid.uuid4().hex, (0, 1))


def test_a_seat_of_another_process_is_waited_for_until_that_is_gone(seats, holder, monkeypatch):
    other = holder(seats, 0)
    Seat(seats.of_worker(1), "a.fmu").give_back()
    first = Seat(seats, "a.fmu")  # of all, that which is free
    with pytest.raises(ModelError, match=r"already has as many instances"):
        Seat(seats.of_worker(1), "a.fmu")
    first.give_back()
    with monkeypatch.context() as impatient:
        impatient.setattr(room, "WAIT_SECONDS", 0.2)
        with pytest.raises(ModelError, match=r"none of the others was freed"):
            Seat(seats.of_worker(0), "a.fmu")

    threading.Timer(0.2, other.kill).start()  # while it is waited for
    Seat(seats.of_worker(0), "a.fmu")
    other.wait()


def test_what_this_process_has_already_is_refused_at_once(seats):
    own = Seat(seats.of_worker(0), "a.fmu")
    with pytest.raises(
        ModelError, match=r"^a\.fmu: .* already has as many instances .*; raise exec"
    ):
        Seat(seats.of_worker(0), "a.fmu")
    own.give_back()
    Seat(seats.of_worker(0), "a.fmu")


def test_a_lost_seat_stays_taken_and_is_said_to_be_lost(seats):
    Seat(seats.of_worker(0), "a.fmu").lose()
    assert has_lost(seats.of_worker(0))
    assert not has_lost(seats.of_worker(1))
    assert not has_lost(None)
    with pytest.raises(ModelError, match=r'after a fatal error .* set executor.name = "proc'):
        Seat(seats.of_worker(0), "a.fmu")


PROGRAM = """
import os
import tempfile
from workers.errors import ModelError
from workers.fmu.seats import Seat, program_seats
seats = program_seats(3)
assert program_seats(1).program == seats.program
seat = Seat(seats.of_worker(0), "a.fmu")
(folder,) = os.listdir(os.environ["TMPDIR"])
assert seats.program in folder
seat.lose()
assert program_seats(2).numbers == (1,)
try:
    program_seats(1)
except ModelError as error:
    print(error)
tempfile.tempdir = "/dev/null"
try:
    Seat(program_seats(2), "a.fmu")
except ModelError as error:
    print(error)
tempfile.tempdir = None
"""


def test_a_program_has_the_same_seats_each_time_but_lost_ones_and_leaves_no_folder(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={"TMPDIR": str(tmp_path), "PYTHONPATH": ":".join(sys.path)},
        capture_output=True,
        text=True,
        check=True,
    )
    none_left, no_file = done.stdout.splitlines()
    assert none_left.startswith("executor.instances: allows 1 instances, but all of them had")
    assert "needs a folder whose files can be locked, but " in no_file
    assert "; set TMPDIR" in no_file
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def alone(monkeypatch):
    """The log of the only instance of a process."""
    monkeypatch.setattr(instance, "_logs", weakref.WeakValueDictionary())
    log: deque[str] = deque()
    instance.open_log("model-1", log, shown=False)
    return log


@pytest.mark.parametrize("name", ["model-1", " model-1 ", "", "another name"])
def test_the_only_instance_gets_what_names_no_other(alone, name):
    say = instance.log_message_3(name)
    say(None, 3, b"", b" it could not go on ")
    say(None, 0, b"", b"all is well")
    assert list(alone) == ["it could not go on"]


def test_with_several_instances_only_a_name_tells(alone):
    other: deque[str] = deque()
    instance.open_log("model-2", other, shown=False)
    instance.log_message_3("model-2")(None, 3, b"", b"it could not go on")
    instance.log_message_3("nobody")(None, 3, b"", b"whose is this")
    assert not alone
    assert list(other) == ["it could not go on"]


WHERE_SIGACTION_IS = pytest.mark.skipif(sys.platform == "win32", reason="there is none")


def handlers() -> list[bytes]:
    """Return what the C library has for both signals."""
    library, found = ctypes.CDLL(None), []
    for number in (signal.SIGINT, signal.SIGTERM):
        room = ctypes.create_string_buffer(SIGACTION_BYTES)
        library.sigaction(int(number), None, room)
        found.append(room.raw[:8])  # the handler; flags beside it are the library's own
    return found


def replace_handlers() -> None:
    """Do as an FMU does: without Python's knowledge."""
    ignore = ctypes.c_void_p(1)  # SIG_IGN
    library = ctypes.CDLL(None)
    library.signal.argtypes = [ctypes.c_int, ctypes.c_void_p]
    library.signal.restype = ctypes.c_void_p
    for number in (signal.SIGINT, signal.SIGTERM):
        library.signal(int(number), ignore)


@WHERE_SIGACTION_IS
@pytest.mark.parametrize("first_out", [0, 1])
def test_a_second_thread_does_not_take_an_fmus_handlers_for_the_process_s(first_out):
    before = handlers()
    threads = [ExitStack(), ExitStack()]
    threads[0].enter_context(kept_signal_handlers())
    replace_handlers()
    threads[1].enter_context(kept_signal_handlers())
    replace_handlers()
    threads[first_out].close()
    assert handlers() == before
    threads[1 - first_out].close()
    assert handlers() == before


@WHERE_SIGACTION_IS
def test_handlers_that_were_replaced_once_are_given_back_during_the_next_call():
    """Otherwise nobody could interrupt an FMU that replaces them and then takes its time."""
    before = handlers()
    with kept_signal_handlers():
        replace_handlers()
    with kept_signal_handlers():
        replace_handlers()
        while handlers() != before:  # the FMU at work
            time.sleep(0.01)
    assert handlers() == before
