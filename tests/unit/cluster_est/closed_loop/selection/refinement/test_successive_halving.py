"""Successive halving of candidates: by what they reach, and by what they promise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from support.loop_objects import made_bench, made_candidate, made_fit, made_problem

from cluster_est.closed_loop.selection.refinement import refine
from cluster_est.closed_loop.selection.refinement.refine import refit_briefly, successive_halving
from cluster_est.closed_loop.workbench import FitStart, FittedModel

SIZE = 40
LEFT = np.where(np.arange(SIZE) % 2, 1.0, -1.0)
"""What no candidate explains."""


def test_one_that_has_further_to_go_is_refitted_too(monkeypatch):
    """It is the last after an iteration; the linear model says that its next step explains all."""
    problem = made_problem(SIZE)
    names = [f"f{i}" for i in range(8)]
    slow = "f7"
    explained = np.cos(np.arange(SIZE))
    calls: list[list[str]] = []

    def fitted(name: str, call: int) -> FittedModel:
        candidate = made_candidate(name)
        share = 3.0 + 0.1 * names.index(name)
        if name == slow:
            share = 6.0 if call < 2 else 0.0
        found = made_fit(problem, 0.1 * LEFT + share * explained, [candidate])
        matrix = np.zeros((SIZE, found.space.size))
        if name == slow and call < 2:
            matrix[:, 0] = explained
        return replace(found, jacobian=matrix)

    def fit(bench, stage, starts, method, kind=None):
        own = [start.added[-1].effect.name for start in starts]
        calls.append(own)
        return [fitted(name, len(calls) - 1) for name in own]

    bench = made_bench(problem)
    monkeypatch.setattr(refine.LoopWorkbench, "fit", fit)
    current = made_fit(problem, 0.1 * LEFT + 9.0 * explained)
    starts = [FitStart(problem, {}, (made_candidate(name),)) for name in names]
    found = successive_halving(bench, current, 0.4, refit_briefly(bench, starts))
    assert all(slow in own for own in calls)
    assert found[0].candidate.effect.name == slow
    assert found[0].full
    assert len(calls[1]) == 5  # the better half, and it


def test_what_cannot_come_near_one_that_closes_the_gap_is_refitted_no_further(monkeypatch):
    """All do more than a quarter of what the best does; their next steps promise nothing."""
    problem = made_problem(SIZE)
    names = [f"f{i}" for i in range(6)]
    explained = np.cos(np.arange(SIZE))
    shares = dict(zip(names, [0.0, 0.001, 3.0, 4.0, 5.0, 6.0], strict=True))
    calls: list[list[str]] = []

    def fit(bench, stage, starts, method, kind=None):
        own = [start.added[-1].effect.name for start in starts]
        calls.append(own)
        return [
            made_fit(problem, 0.1 * LEFT + shares[name] * explained, [made_candidate(name)])
            for name in own
        ]

    monkeypatch.setattr(refine.LoopWorkbench, "fit", fit)
    current = made_fit(problem, 0.1 * LEFT + 9.0 * explained)
    bench = made_bench(problem)
    starts = [FitStart(problem, {}, (made_candidate(name),)) for name in names]
    found = successive_halving(bench, current, 0.4, refit_briefly(bench, starts))
    assert [set(own) for own in calls[1:]] == [{"f0", "f1"}] * 2
    assert {c.candidate.effect.name for c in found if c.full} == {"f0", "f1"}
    assert len(found) == 6
