"""Sentences are broken between words in a terminal, and stay whole in a file."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from cluster_est.cli.display.run import tell

SENTENCE = "  Coulomb friction at der(v): der(v) += -k * tanh(v / width), with k = 0.5015 m/s^2"


def told(*, terminal: bool, width: int) -> list[str]:
    out = io.StringIO()
    tell(Console(file=out, force_terminal=terminal, width=width, no_color=True), SENTENCE)
    return out.getvalue().rstrip("\n").split("\n")


@pytest.mark.parametrize("width", [30, 50, 80])
def test_a_terminal_gets_whole_words_and_an_indent(width):
    lines = told(terminal=True, width=width)
    assert all(len(line) <= width for line in lines)
    assert " ".join(" ".join(lines).split()) == " ".join(SENTENCE.split())
    assert all(line.startswith(" " * 6) for line in lines[1:])


def test_where_there_is_room_or_no_terminal_it_is_one_line():
    assert told(terminal=True, width=200) == [SENTENCE]
    assert told(terminal=False, width=30) == [SENTENCE]
