import os
import signal
import time
from collections.abc import Callable
from pathlib import Path


def state_of(process: int) -> tuple[str, int]:
    """State and parent of a process; a zombie's state where there is none."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2]
    except OSError:
        return "Z", 0
    return fields.split()[0], int(fields.split()[1])


def parent(process: int) -> int:
    """The process that has forked another one."""
    return state_of(process)[1]


def living() -> dict[int, int]:
    """The parents of all processes that live."""
    numbers = (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit())
    known = {process: state_of(process) for process in numbers}
    return {process: above for process, (state, above) in known.items() if state != "Z"}


def worker_since(before: dict[int, int]) -> tuple[int, int]:
    """The only process in which an FMU was loaded since then, and the fork server above it."""
    now = living()
    new = {p for p in now.keys() - before.keys() if is_below(p, os.getpid(), now)}
    (worker,) = (p for p in new if p not in now.values() and now[now[p]] != os.getpid())
    return worker, now[worker]


def is_below(process: int, above: int, parents: dict[int, int]) -> bool:
    """Whether a process is another one, or descends from it."""
    while process in parents and process != above:
        process = parents[process]
    return process == above


def wait_until(condition: Callable[[], bool], seconds: float = 30.0) -> bool:
    """Whether something becomes true."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def has_ended(process: int) -> bool:
    """Whether a process is gone, or is soon; one that only its parent remembers counts as gone."""
    return wait_until(lambda: state_of(process)[0] == "Z")


def kill(process: int) -> None:
    """End a process, and wait until it has: the signal may arrive later than what follows."""
    os.kill(process, signal.SIGKILL)
    assert has_ended(process)
