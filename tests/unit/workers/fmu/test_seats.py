"""A seat is one instance's at a time, and free again when the process that had it is gone."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from workers.errors import ModelError
from workers.fmu import seats as room
from workers.fmu.seats import Seat, has_lost, program_seats, seats_folder
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
def holder() -> Iterator[object]:
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
def seats(monkeypatch: pytest.MonkeyPatch) -> Iterator[Seats]:
    """Two seats of nobody else, for which nobody waits long."""
    monkeypatch.setattr(room, "WAIT_SECONDS", 0.3)
    monkeypatch.setattr(room, "_taken", {})
    monkeypatch.setattr(room, "_lost", set())
    room._program.cache_clear()
    yield program_seats(2)
    room._program.cache_clear()


def test_a_seat_of_another_process_is_waited_for_until_that_is_gone(seats, holder, monkeypatch):
    other = holder(seats, 0)
    with pytest.raises(ModelError, match=r"none of the others was given back"):
        Seat(seats.of_worker(0), "a.fmu")

    monkeypatch.setattr(room, "WAIT_SECONDS", 600.0)
    monkeypatch.setattr(room.time, "sleep", lambda _: other.kill())  # while it is waited for
    Seat(seats.of_worker(0), "a.fmu")
    other.wait()


def test_a_worker_has_a_seat_of_its_own(seats, holder):
    holder(seats, 0)
    Seat(seats.of_worker(1), "a.fmu").give_back()
    with pytest.raises(ModelError, match=r"given back"):
        Seat(seats.of_worker(0), "a.fmu")
    first = Seat(seats, "a.fmu")  # of all, that which is free
    assert first._key == (seats.program, 1)


def test_what_this_process_has_already_is_refused_at_once(seats, monkeypatch):
    monkeypatch.setattr(room.time, "sleep", lambda _: pytest.fail("nobody else can give it back"))
    own = Seat(seats.of_worker(0), "a.fmu")
    with pytest.raises(ModelError, match=r"^a\.fmu: .* as many instances already .*; raise exec"):
        Seat(seats.of_worker(0), "a.fmu")
    own.give_back()
    Seat(seats.of_worker(0), "a.fmu")


def test_a_lost_seat_stays_taken_and_is_said_to_be_lost(seats):
    Seat(seats.of_worker(0), "a.fmu").lose()
    assert has_lost(seats.of_worker(0))
    assert not has_lost(seats.of_worker(1))
    assert not has_lost(None)
    with pytest.raises(ModelError, match=r'after a fatal error .* choose executor.name = "proc'):
        Seat(seats.of_worker(0), "a.fmu")


def test_a_lost_seat_is_one_less_for_all_that_follow_in_this_program(seats):
    Seat(seats.of_worker(0), "a.fmu").lose()
    assert program_seats(2).numbers == (1,)
    with pytest.raises(
        ModelError, match=r"^executor\.instances: allows 1 at once, but as many had"
    ):
        program_seats(1)


def test_where_no_file_can_be_locked_that_is_said(seats, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("", encoding="ascii")
    monkeypatch.setattr(room.tempfile, "gettempdir", lambda: str(tmp_path / "file"))
    with pytest.raises(ModelError, match=r"needs files that can be locked in .*; set TMPDIR"):
        Seat(seats, "a.fmu")


def test_a_program_has_the_same_seats_each_time_and_leaves_no_folder():
    code = (
        "from workers.fmu.seats import Seat, program_seats, seats_folder\n"
        "assert program_seats(1).program == program_seats(3).program\n"
        "Seat(program_seats(1), 'a.fmu')\n"
        "folder = seats_folder(program_seats(1).program)\n"
        "assert folder.is_dir()\n"
        "print(folder)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    folder = done.stdout.strip()
    assert folder.startswith(str(seats_folder("")))
    assert not os.path.exists(folder)
