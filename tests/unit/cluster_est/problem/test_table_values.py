"""Smooth tables: what their expressions make of the unknowns, point by point."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_est.problem.effects.table_values import TableShape, ValueTable
from cluster_est.problem.formulas import Formula

ZEROS = ((), (0,), (3,), (0, 6), (2, 5), (6,))
"""Points at which a table is 0 by definition."""


def table(points, zeros, change=0.5, starts=None):
    names = tuple(None if i in zeros else f"map.k{i}" for i in range(len(points)))
    starts = starts or (0.0,) * len(points)
    shape = TableShape(change, bounds=(-50.0, 50.0))
    points = tuple(float(each) for each in points)
    return ValueTable("t", "map.", names, points, tuple(starts), shape)


def values_of(made, unknowns):
    """Every value, by its expression and those before it."""
    columns = {name: np.array([value]) for name, value in unknowns.items()}
    for name, text in made.expressions():
        columns[name] = Formula(text, tuple(columns)).values(columns, 1)
    return np.array([0.0 if name is None else columns[name][0] for name in made.values])


@pytest.mark.parametrize("zeros", ZEROS)
@settings(max_examples=8, deadline=None)  # each reads a formula for every value
@given(seed=st.integers(0, 10_000))
def test_the_slope_changes_by_the_unknowns_and_the_zeros_are_there(zeros, seed):
    generator = np.random.default_rng(seed)
    points = np.cumsum(generator.uniform(0.2, 2.0, 7)) - 3.0
    made = table(points, zeros)
    unknowns = {each.name: float(generator.normal()) for each in made.unknowns()}
    found = values_of(made, unknowns)
    bends = [unknowns[f"map.bend_{i}"] for i in range(2, 7)]
    slopes = np.diff(found) / np.diff(points)
    assert np.diff(slopes) == pytest.approx(bends, abs=1e-9)
    assert found[list(zeros)] == pytest.approx(0.0, abs=1e-9)
    assert len(unknowns) == 7 - len(zeros)  # as many as there are free values
    if not zeros:
        assert found[0] == unknowns["map.level"]


@pytest.mark.parametrize("zeros", ZEROS)
def test_it_starts_from_the_values_that_are_given(zeros):
    points = np.array([-2.0, -1.5, 0.0, 0.3, 1.0, 1.2, 2.0])
    starts = np.array([0.3, -0.2, 0.5, 0.4, 0.6, 0.1, -0.3])
    starts[list(zeros)] = 0.0
    made = table(points, zeros, change=2.0, starts=starts.tolist())
    found = values_of(made, {each.name: each.start for each in made.unknowns()})
    assert found == pytest.approx(starts, abs=1e-12)
