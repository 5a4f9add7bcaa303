"""What a run shows while it goes on, and whom it asks whether to go on."""

import io
import math
import sys
import types
from dataclasses import replace

import pytest
from rich.console import Console
from support.problems.springs import spring_problem

import cluster_est as ce
from cluster_est.errors import ProblemError
from cluster_est.methods.method import Progress
from cluster_est.running.progress_line import (
    TerminalPlace,
    line_of,
    progress_of,
    search_title,
    shown_at,
)
from cluster_est.running.resources import Budget, RunSnapshot

SNAPSHOT = RunSnapshot("train", Progress(3, 2.5), 12, 40, 1, 2, 4, 7.0)


@pytest.fixture(scope="module")
def problem():
    return spring_problem(experiments=2, samples=40).problem


def line(snapshot, budget=None):
    return line_of(snapshot, budget or Budget())


def snapshot(cost, failures=0):
    return RunSnapshot("candidate", Progress(12, cost), 123456, 234567, failures, 16, 16, 4321.0)


def test_the_line_says_what_is_done():
    assert line(SNAPSHOT) == (
        "searching, iteration 3 | cost 2.5 | 1 simulation failed | 12 evaluations (1.71/s) | "
        "2/4 workers busy | 7 s"
    )


def test_a_search_with_a_number_has_a_text_and_the_number():
    assert search_title("start 3") == "searching from start 3"
    assert search_title("leave one out") == "predicting experiments that were left out"
    assert search_title("something new") == "something new"


def test_a_cost_that_is_not_known_yet_is_left_out():
    assert "nan" not in line(snapshot(math.nan))
    assert "cost 2.5" in line(snapshot(2.5))
    assert "3 simulations failed" in line(snapshot(2.5, 3))


def test_it_begins_with_a_word_and_stays_one_line_in_a_narrow_terminal():
    out = io.StringIO()
    place = TerminalPlace(Console(file=out, force_terminal=True, width=80))
    with shown_at(place, Budget()) as show:
        assert "starting" in out.getvalue()
        show(snapshot(2.5, 3))
    assert "refitting candidates, iteration 12" in out.getvalue()
    assert "4321 s" not in out.getvalue()  # cut, where it would have begun a second line


def test_the_phase_how_much_is_done_and_the_time_left_are_said():
    known = replace(
        snapshot(2.5), phase="looking for effect 2 of at most 3", ended=7, searches=12, left=41.2
    )
    text = line(known)
    begin = "looking for effect 2 of at most 3: refitting candidates, 7 of 12 done | "
    assert text.startswith(f"{begin}this step: at most about 41 s left | ")
    assert line(replace(known, left=math.nan)).startswith(f"{begin}time left unknown | ")
    assert "time left" not in line(snapshot(2.5))  # a fit: nobody expects to be told
    expected = replace(known, left=41.2, at_most=False)
    assert line(expected).startswith(f"{begin}this step: about 41 s left | ")


def test_the_pace_of_a_single_search_is_said_where_somebody_waits_for_it():
    assert " | an iteration takes about 2 min | " in line(
        replace(snapshot(2.5), pace=125.0), Budget()
    )
    for pace in (0.2, math.nan):
        assert "an iteration" not in line(replace(snapshot(2.5), pace=pace))


def test_a_budget_is_said_once():
    budget = Budget(seconds=5000.0)
    fit = replace(snapshot(2.5), left=600.0)
    assert line(fit, budget).count("left") == 1
    assert line(snapshot(2.5), budget).endswith("at most 679 s left")  # before anything has ended
    recipe = replace(fit, phase="looking for effect 2 of at most 3")
    assert line(recipe, budget).endswith("at most 679 s left")


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
    assert any("evaluations" in line for line in lines)
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
    with progress_of(None, Budget()) as show:
        assert show is not None
        show(SNAPSHOT)
    assert "searching, iteration 3" in terminal.text


def test_a_script_whose_errors_go_to_a_file_shows_nothing(capfd):
    with progress_of(None, Budget()) as show:
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
    with pytest.raises(ProblemError, match=r"callback: must be a function, but is 3"):
        ce.fit(problem, callback=3)
    with pytest.raises(ProblemError, match=r"progress: must be true, false or a function.*'bar'"):
        ce.fit(problem, progress="bar")
