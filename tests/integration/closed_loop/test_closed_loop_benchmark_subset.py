"""A few cases of the closed-loop benchmark, whose data come from equations of its own in NumPy."""

from functools import cache

import pytest
from closed_loop_benchmark.data import Data, make, make_problem
from closed_loop_benchmark.naming import compare, normal
from closed_loop_benchmark.scenarios import subset

import cluster_est as ce
from cluster_est.closed_loop.findings.effects import Verdict

CASES = {case.name: case for case in subset()}
COMPLETE = [name for name, case in CASES.items() if not case.effects]
LACKING = [name for name, case in CASES.items() if case.effects]
QUICK = "pendulum/clean/0.01 0.0 0"


def each(names):
    """By default only one, which takes seconds; `test_undeclared_effects.py` has others."""
    return [n if n == QUICK else pytest.param(n, marks=pytest.mark.slow) for n in names]


@cache
def closed(name: str) -> tuple[Data, ce.LoopResult]:
    data = make(CASES[name])
    return data, ce.close_loop(make_problem(data))


def test_the_subset_has_both_sorts():
    assert len(COMPLETE) >= 2
    sites = {CASES[name].effects[0].kind for name in LACKING}
    assert sites == {"der", "input", "output", "parameter"}


@pytest.mark.parametrize("name", each(LACKING))
def test_an_effect_is_found_and_named_and_leaves_noise(name):
    data, result = closed(name)
    assert result.verdict == Verdict.FOUND
    named = [normal(e.form, e.site, e.variables) for e in result.effects]
    (accepted,) = CASES[name].accepted
    assert compare(accepted, named, []).alias, named
    assert len(named) == 1
    before, after = result.rms("test", "before"), result.rms("test", "after")
    assert after < 0.8 * before
    held_out = [run for run in data.experiments if run.role == "test"]
    noise = [(((run.outputs - run.true_outputs) / data.sigma) ** 2).mean() for run in held_out]
    assert after == pytest.approx((sum(noise) / len(noise)) ** 0.5, rel=0.05)


@pytest.mark.parametrize("name", each(COMPLETE))
def test_nothing_is_found_where_nothing_is_missing(name):
    result = closed(name)[1]
    coloured = CASES[name].noise.correlation > 0.0
    assert result.verdict == (Verdict.COLOURED if coloured else Verdict.NONE)
    assert result.effects == ()
    assert result.rms("test", "after") == result.rms("test", "before")
