"""Loops on one case that share a memory, and parts that did nothing in a loop."""

import numpy as np
import pytest
from closed_loop_benchmark.activity import noted_parts, saved
from closed_loop_benchmark.memory import KNOWN, OutcomeMemory, remembering
from support.problems.driven_springs import driven_by

import cluster_est as ce
from cluster_est.closed_loop.settings import LoopPart
from workers.messages import Outcome, Status

FEW = ce.LoopSettings(sites=("input F", "der(v)"), forms=("cubic", "coulomb"), draws=200)


@pytest.fixture(scope="module")
def lacking() -> ce.Problem:
    """A spring whose force has a term that its model lacks."""
    return driven_by(*(lambda t, f: f + 0.02 * f**3 for _ in range(2)))


def remembered(problem: ce.Problem, case: str, settings: ce.LoopSettings = FEW) -> ce.LoopResult:
    with remembering(case) as resources:
        return ce.close_loop(problem, resources, settings)


def facts(result: ce.LoopResult) -> tuple[object, ...]:
    rows = result.table("structures").to_pylist()
    return result.message, result.x, result.simulations, result.evaluations, repr(rows)


def test_a_loop_that_is_answered_from_memory_is_the_same_and_simulates_nothing(lacking):
    plain = facts(ce.close_loop(lacking, settings=FEW))
    assert facts(remembered(lacking, "a")) == plain
    simulated, asked = KNOWN.simulated, KNOWN.asked
    assert simulated > 0
    assert facts(remembered(lacking, "a")) == plain
    assert KNOWN.simulated == simulated
    assert KNOWN.asked > asked
    with remembering("b"):
        assert KNOWN.held == 0


def test_a_memory_that_is_full_lets_go_what_was_used_longest_ago():
    memory = OutcomeMemory(most=20 * 8)
    for key in "ab":
        memory.keep(key, Outcome(0, Status.OK, np.zeros(8)))
    assert memory.get("a") is not None
    memory.keep("c", Outcome(0, Status.OK, np.zeros(8)))
    assert [memory.get(key) is not None for key in "abc"] == [True, False, True]
    assert memory.held <= memory.most


def test_parts_that_changed_nothing_are_known_and_what_they_have_simulated(lacking):
    with noted_parts() as notes:
        whole = remembered(lacking, "c")
    assert {LoopPart.ADD, LoopPart.SIGNIFICANCE} <= notes.active
    silent = {*LoopPart} - notes.active
    assert {LoopPart.CURVE_ENDS, LoopPart.NUMERICAL, LoopPart.FREE_CURVE} <= silent
    without = remembered(lacking, "c", FEW.changed(without=tuple(silent)))
    assert (without.x, without.verdict) == (whole.x, whole.verdict)
    spent = saved(notes.spans, silent)
    assert spent > 0.0
    left = whole.simulations - spent  # or a few more: others may ask the same later
    assert left <= without.simulations <= 1.1 * left


def test_a_gate_is_noted_where_it_refuses(lacking):
    strict = FEW.changed(significance=1e-300)
    with noted_parts() as notes:
        remembered(lacking, "d", strict)
    assert LoopPart.SIGNIFICANCE in notes.active
    assert LoopPart.SIBLINGS not in notes.active


def test_nested_calls_of_parts_are_counted_once():
    spans = [("replace", 10.0, 20.0), ("siblings", 12.0, 15.0), ("siblings", 30.0, 31.0)]
    assert saved(spans, {"replace", "siblings"}) == 11.0
    assert saved(spans, {"siblings"}) == 4.0
    assert saved(spans, {"drop"}) == 0.0
