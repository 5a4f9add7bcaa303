"""The line that a person sees while a fit runs."""

from __future__ import annotations

import io
import math

from rich.console import Console

from cluster_est.cli.display.progress import ProgressLine, line
from cluster_est.methods.base import Progress
from cluster_est.running.records import Budget, RunSnapshot


def snapshot(cost: float, failures: int = 0) -> RunSnapshot:
    return RunSnapshot("candidate", Progress(12, cost), 123456, 234567, failures, 16, 16, 4321.0)


def test_a_cost_that_is_not_known_yet_is_left_out():
    assert "nan" not in line(snapshot(math.nan), Budget())
    assert "cost 2.5" in line(snapshot(2.5), Budget())
    assert "3 simulations failed" in line(snapshot(2.5, 3), Budget())


def test_it_begins_with_a_word_and_stays_one_line_in_a_narrow_terminal():
    out = io.StringIO()
    with ProgressLine(Console(file=out, force_terminal=True, width=80), Budget()) as shown:
        assert "starting" in out.getvalue()
        shown.show(snapshot(2.5, 3))
    assert "candidate: iteration 12" in out.getvalue()
    assert "4321 s" not in out.getvalue()  # cut, where it would have begun a second line


def test_nothing_is_shown_where_there_is_no_terminal():
    out = io.StringIO()
    with ProgressLine(Console(file=out, width=80), Budget()) as shown:
        shown.show(snapshot(2.5))
    assert out.getvalue() == ""
