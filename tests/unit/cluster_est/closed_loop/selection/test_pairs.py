"""Two columns that together carry most of a residual."""

import numpy as np
import pytest
from support.loop_objects import made_candidate, made_ranking

from cluster_est import LoopSettings
from cluster_est.closed_loop.selection.refinement.pairs import best_pairs

FITTED = LoopSettings().thresholds.pairs.fitted

GENERATOR = np.random.default_rng(5)
N, COUNT = 400, 60
MATRIX = GENERATOR.standard_normal((N, 3))
COLUMNS = [GENERATOR.standard_normal((N, 1)) for _ in range(COUNT)]


def screened(residuals, columns, candidates=None):
    made = candidates or [made_candidate(f"e{i}") for i in range(len(columns))]
    return made_ranking(MATRIX, residuals, columns, made)


def left(residuals, *columns):
    """Sum of squares after least squares on the parameters and these columns."""
    joined = np.column_stack([MATRIX, *columns])
    fit = np.linalg.lstsq(joined, residuals, rcond=None)[0]
    return float(np.sum((residuals - joined @ fit) ** 2))


def planted():
    """Two alike columns of opposite sign: neither says much alone."""
    columns = list(COLUMNS)
    columns[40] = columns[17] + 0.3 * columns[40]
    residuals = columns[17][:, 0] - columns[40][:, 0] + MATRIX @ [2.0, -1.0, 0.5]
    return residuals + 0.05 * GENERATOR.standard_normal(N), columns


def test_a_planted_pair_comes_first():
    assert set(best_pairs(screened(*planted()))[0]) == {17, 40}


def test_pairs_are_ranked_as_by_least_squares():
    residuals = GENERATOR.standard_normal(N)
    found = best_pairs(screened(residuals, COLUMNS[:12]))
    every = {(i, j): left(residuals, COLUMNS[i], COLUMNS[j]) for i in range(12) for j in range(i)}
    assert len(found) == FITTED
    expected = sorted(every, key=every.get)[:FITTED]
    assert [frozenset(pair) for pair in found] == [frozenset(pair) for pair in expected]


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_scales_do_not_matter(scale):
    residuals, columns = planted()
    found = best_pairs(screened(scale * residuals, [scale**0.5 * c for c in columns]))
    assert set(found[0]) == {17, 40}


def spoiled(columns, case):
    """The planted pair, made one that is none; what is alike is so by its columns."""
    trials = [made_candidate(f"e{i}") for i in range(COUNT)]
    if case == "points of one grid":
        trials[40] = made_candidate("e17")
    elif case == "a free curve":
        trials[40] = made_candidate("e40", "table")
    else:
        columns[40] = columns[17] + 0.01 * COLUMNS[40]
    return trials


@pytest.mark.parametrize("case", ["points of one grid", "a free curve", "alike"])
def test_no_pair_are(case):
    residuals, columns = planted()
    found = best_pairs(screened(residuals, columns, spoiled(columns, case)))
    assert len(found) == FITTED
    assert {17, 40} not in [set(p) for p in found]


def test_one_candidate_is_no_pair():
    assert best_pairs(screened(GENERATOR.standard_normal(N), COLUMNS[:1])) == []
