"""What is said of effects that make simulations dear, in steps of the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.loop_objects import fit_with_squares, made_bench, made_candidate, made_problem

from cluster_est.closed_loop.findings.simulation_cost import dear_structures
from cluster_est.closed_loop.selection.path import compared_structure
from cluster_est.closed_loop.selection.rounds import ComparedStructure


def structure(name: str, times: float, *, accepted: bool = False) -> ComparedStructure:
    return ComparedStructure(1, (f"{name} at der(v)",), -10.0, 0.5, True, accepted, times)


def test_nothing_is_said_where_all_cost_about_the_same():
    assert dear_structures([structure("a", 1.2), structure("b", 5.0), structure("c", np.nan)]) == ()


def test_the_dearest_is_named_with_its_figure():
    (said,) = dear_structures([structure("a", 1.2), structure("b", 31.4), structure("c", 7.0)])
    assert said.startswith("2 structures of the 3 that were tried")
    assert "most of all b at der(v) (31.4 times)" in said
    assert "what was added" not in said


def test_what_was_added_is_said_too():
    (said,) = dear_structures([structure("a", 9.0, accepted=True), structure("b", 31.4)])
    assert said.endswith("with what was added a simulation takes 9 times the steps")


@pytest.mark.parametrize(("base", "grown", "expected"), [(200, 1400, 7.0), (0, 1400, np.nan)])
def test_it_is_the_steps_over_those_of_the_declared_model(base: int, grown: int, expected: float):
    problem = made_problem(10)
    declared = replace(fit_with_squares(problem, 9.0), steps=base)
    larger = replace(fit_with_squares(problem, 4.0, [made_candidate("f")]), steps=grown)
    found = compared_structure(made_bench(problem), declared, larger, 1.0, 1)
    assert found.relative_steps == pytest.approx(expected, nan_ok=True)
