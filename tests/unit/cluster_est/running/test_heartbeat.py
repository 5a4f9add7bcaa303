import math
import threading

from cluster_est.methods.method import Progress
from cluster_est.running.heartbeat import STARTING, beating
from cluster_est.running.resources import RunSnapshot

SNAPSHOT = RunSnapshot("train", Progress(3, 1.0), 7, 9, 0, 1, 1, 5.0, left=2.0)


class Listener:
    """Keeps what it is shown, and says when that is enough."""

    def __init__(self, enough: int) -> None:
        self.seen: list[RunSnapshot] = []
        self.enough, self._count = threading.Event(), enough

    def __call__(self, snapshot: RunSnapshot) -> None:
        self.seen.append(snapshot)
        if len(self.seen) >= self._count:
            self.enough.set()


def test_the_last_state_is_shown_again_while_nothing_comes():
    heard = Listener(4)
    with beating(heard, seconds=0.01) as show:
        show(SNAPSHOT)
        assert heard.enough.wait(60.0)
    again = heard.seen[heard.seen.index(SNAPSHOT) + 1 :]
    assert all(s.evaluations == 7 and math.isnan(s.left) for s in again)
    seconds = [SNAPSHOT.seconds, *(s.seconds for s in again)]
    assert seconds == sorted(set(seconds))


def test_something_is_shown_before_anything_was_simulated():
    heard = Listener(1)
    with beating(heard, seconds=0.01):
        assert heard.enough.wait(60.0)
    assert heard.seen[0].search == STARTING


def test_nothing_is_shown_after_the_end():
    heard = Listener(1)
    with beating(heard, seconds=0.01):
        heard.enough.wait(60.0)
    count = len(heard.seen)
    assert not any(t.name.startswith("beat") for t in threading.enumerate())
    assert len(heard.seen) == count
