"""What a run shows that was begun from Python, and whom it asks whether to go on."""

import math
import sys
import types

import pytest
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.errors import ProblemError
from cluster_est.methods.method import Progress
from cluster_est.running.progress_line import line_of, progress_of
from cluster_est.running.resources import RunSnapshot

SNAPSHOT = RunSnapshot("train", Progress(3, 2.5), 12, 40, 1, 2, 4, 7.0)


@pytest.fixture(scope="module")
def problem():
    return spring_problem(experiments=2, samples=40).problem


def test_the_line_says_what_is_done():
    assert line_of(SNAPSHOT) == (
        "searching, iteration 3 | cost 2.5 | 40 simulations | 1 failed | 2 of 4 workers busy | 7 s"
    )
    many = RunSnapshot(
        "candidate", Progress(1, 2.0), 9, 30, 0, 1, 1, 2.0, "round 2", 4, 16, left=5.0
    )
    assert line_of(many) == (
        "round 2, 4 of 16 done | about 5 s left | 30 simulations | 1 of 1 workers busy | 2 s"
    )


class Display:
    """Stands for IPython in a notebook."""

    def __init__(self):
        self.shown = []
        self.kernel = True

    def get_ipython(self):
        return self

    def display(self, data, raw, display_id):
        assert raw
        assert display_id
        return self

    def update(self, data, raw):
        self.shown.append(data["text/plain"])


def test_a_notebook_shows_a_line_that_is_renewed_and_goes(problem, monkeypatch):
    display = Display()
    monkeypatch.setitem(sys.modules, "IPython", display)
    monkeypatch.setitem(
        sys.modules, "IPython.display", types.SimpleNamespace(display=display.display)
    )
    ce.fit(problem)
    *lines, last = display.shown
    assert any("simulations" in line for line in lines)
    assert last == ""
    shown = len(display.shown)
    ce.fit(problem, progress=False)
    assert len(display.shown) == shown


def test_a_terminal_shows_a_line(monkeypatch):
    class Terminal:
        encoding = "utf-8"

        def __init__(self):
            self.text = ""

        def write(self, text):
            self.text += text

        def flush(self):
            pass

        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with progress_of(None) as show:
        assert show is not None
        show(SNAPSHOT)
    assert "searching, iteration 3" in terminal.text


def test_a_script_whose_errors_go_to_a_file_shows_nothing(capfd):
    with progress_of(None) as show:
        assert show is None
    assert capfd.readouterr().err == ""


def test_a_function_sees_every_snapshot(problem):
    seen = []
    result = ce.fit(problem, progress=seen.append)
    assert seen[-1].simulations <= result.simulated
    assert "train" in {each.search for each in seen}


def test_a_callback_sees_iterations_and_can_end_the_run(problem):
    costs = []

    def look(iteration):
        costs.append(iteration.progress.cost)
        if len(costs) == 3:
            raise StopIteration

    result = ce.fit(problem, callback=look)
    assert result.interrupted
    assert len(costs) == 3
    assert result.cost <= min(c for c in costs if math.isfinite(c))
    whole = []
    assert not ce.fit(problem, callback=whole.append).interrupted
    assert len(whole) > 3


def test_what_is_no_function_is_refused(problem):
    with pytest.raises(ProblemError, match=r"callback: must be a function but is 3"):
        ce.fit(problem, callback=3)
    with pytest.raises(ProblemError, match=r"progress: must be true, false or a function.*'bar'"):
        ce.fit(problem, progress="bar")
