"""Parts of a search that are left out, and how the log names the moves and gates of the others."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from support.problems.driven_springs import LARGEST, dead, driven_by, pushed_by_waves

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict
from cluster_est.closed_loop.settings import LoopPart, LoopStage

QUICK = {LoopPart.ADD, LoopPart.DROP, LoopPart.PRUNING}


def bent(times: np.ndarray, force: np.ndarray) -> np.ndarray:
    """A force with two terms that its model lacks: one of its own size, and one of time."""
    return np.asarray(force + 0.02 * force**3 + 0.4 * times)


@pytest.fixture(scope="module")
def lacking() -> ce.Problem:
    return driven_by(bent, bent)


def searched(problem: ce.Problem, *without: str) -> tuple[ce.LoopResult, Counter[str]]:
    """A result, and how many simulations each stage took."""
    counts: Counter[str] = Counter()
    few = ce.LoopSettings(
        sites=("input F", "der(v)"), forms=("cubic", "drift", "coulomb"), draws=200, without=without
    )
    result = ce.close_loop(
        problem, settings=few, record=lambda origin, _: counts.update([origin.search])
    )
    return result, counts


@pytest.fixture(scope="module")
def whole(lacking) -> tuple[ce.LoopResult, Counter[str]]:
    return searched(lacking)


@pytest.mark.parametrize(
    "part", [p if p in QUICK else pytest.param(p, marks=pytest.mark.slow) for p in LoopPart]
)
def test_a_search_without_any_one_part_comes_to_an_end(lacking, part):
    """It may find less, but it says so, and no proposal is of a move that was left out."""
    result, _ = searched(lacking, part)
    assert isinstance(result.verdict, Verdict)
    rows = result.table("structures").to_pylist()
    assert part not in {row["move"] for row in rows}
    assert part not in {row["stopped_by"] for row in rows}


def test_what_was_found_names_its_move_and_what_was_refused_its_gate(whole):
    result, _ = whole
    assert {effect.form for effect in result.effects} == {"cubic", "drift"}
    rows = result.table("structures").to_pylist()
    known = {part.value for part in LoopPart}
    compared_later = ""  # with the answer, after the search
    assert {row["move"] for row in rows if row["effects"]} <= known | {compared_later}
    assert {row["stopped_by"] for row in rows} <= known | {""}
    assert {row["stopped_by"] for row in rows if row["accepted"]} == {""}


def test_a_part_that_is_left_out_simulates_nothing(lacking, whole):
    assert whole[1][LoopStage.DROP.value] > 0
    without = searched(lacking, LoopPart.DROP, LoopPart.ANSWER)
    assert without[1][LoopStage.DROP.value] == 0


def test_a_gate_that_is_left_out_refuses_nothing():
    """A wave of less than three periods in a record."""
    problem = pushed_by_waves(2.0, (1.0, 1.0))
    given = {"draws": 200, "pairs": False, "max_effects": 1}
    few = ce.LoopSettings(sites=("der(v)",), forms=("sine", "coulomb"), **given)
    refused = ce.close_loop(problem, settings=few)
    stopped = [row["stopped_by"] for row in refused.table("structures").to_pylist()]
    assert LoopPart.WAVES in stopped
    assert refused.effects == ()
    found = ce.close_loop(problem, settings=few.changed(without=(LoopPart.WAVES,)))
    assert [effect.form for effect in found.effects] == ["sine"]


def test_a_dead_zone_needs_no_other_part_than_that_which_adds_it():
    """Nor do its figures change, if the parts did nothing for it."""
    width = 0.3 * LARGEST
    problem = driven_by(*(lambda t, f: dead(f, width) for _ in range(2)))
    few = ce.LoopSettings(sites=("input F",), forms=("dead_zone",), draws=200, pairs=False)
    others = ("add two", "exclude", "free curve", "siblings", "drop", "next best")
    results = [ce.close_loop(problem, settings=each) for each in (few, few.changed(without=others))]
    assert [effect.form for result in results for effect in result.effects] == 2 * ["dead_zone"]
    assert results[0].x == results[1].x


def test_what_the_search_accepted_has_its_errors(lacking):
    """Of the held-out experiment the same as after the last fit; of what is left out, more."""
    runs = tuple(
        replace(run, role="train" if i == 0 else "test")
        for i, run in enumerate(lacking.experiments)
    )
    result, _ = searched(replace(lacking, experiments=runs))
    assert result.effects
    rows = [row for row in result.table("structures").to_pylist() if row["left_out"] is not None]
    known = [row for row in rows if row["left_out"] == row["left_out"]]
    (kept,) = (row for row in known if len(row["effects"]) == len(result.effects))
    errors = {role: [e for e in result.errors if e.role == role] for role in ("train", "test")}
    (held_out,) = (e.normalised_after for e in errors["test"])
    assert kept["held_out"] == pytest.approx(held_out, rel=0.02)
    (error,) = (s.outcome.residuals for s in result.after.simulations if s.experiment == 0)
    assert kept["left_out"] > 0.99 * np.sqrt(np.mean(error**2))
