"""Two runs of the benchmark are compared case by case."""

from dataclasses import replace

import pytest
from closed_loop_benchmark.comparison import compare_runs, holds
from closed_loop_benchmark.scoring import Score

FOUND = Score(
    name="a", system="s", kind="single", split="tune", size=1.0, correlation=0.0, true=["drag"],
    named=["drag"], verdict="found", alias=[True], before=9.0, after=1.0, oracle=1.0, floor=1.0,
    simulations=100.0, seconds=1.0,
)  # fmt: skip
CLEAN = replace(FOUND, name="b", kind="clean", true=[], named=[], verdict="none", alias=None)


def test_a_name_that_was_right_and_is_no_longer_is_counted_and_shown():
    wrong = replace(FOUND, named=["cubic"], alias=[False])
    text, lost = compare_runs({"a": FOUND, "b": CLEAN}, {"a": wrong, "b": CLEAN})
    assert lost == 1
    assert [line[:4] for line in text.splitlines()[:2]] == ["was ", "is  "]
    assert text.endswith("2 cases in both: right 2 -> 1, no longer right 1, now right 0")


def test_what_became_right_is_named_and_cases_of_one_file_are_left_out():
    wrong = replace(FOUND, named=[], alias=[False])
    text, lost = compare_runs({"a": wrong}, {"a": FOUND, "b": CLEAN})
    assert lost == 0
    assert text.startswith("now right: a\n1 cases in both: right 0 -> 1")


@pytest.mark.parametrize(
    ("score", "expected"),
    [
        (FOUND, True),
        (replace(FOUND, alias=[False], numerical=True), True),
        (replace(FOUND, alias=[False]), False),
        (replace(FOUND, after=9.5), False),
        (replace(FOUND, error="Traceback"), False),
        (CLEAN, True),
        (replace(CLEAN, named=["drag"], verdict="found"), False),
        (replace(FOUND, kind="outside", alias=[False]), True),
    ],
)
def test_what_counts_as_right(score, expected):
    assert holds(score) is expected
