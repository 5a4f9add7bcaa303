"""Steps along chains of experiments against the same in one array."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares.bounded_step import StepSolver
from cluster_est.methods.least_squares.chain_elimination import eliminate, make_chains
from cluster_est.methods.least_squares.factored_chains import FactoredChains
from cluster_est.methods.least_squares.sparse_step import SparseStepSolver

DAMPINGS = (1e-12, 1e-3, 1.0)


def chained_matrix(seed, records=2, segments=5, states=3, shared=2, rows=9):
    """Each segment has shared unknowns, its own states and those of the next segment."""
    generator = np.random.default_rng(seed)
    blocks, columns, size = [], [], shared
    for _ in range(records):
        own = np.arange(size, size + states)
        size += states
        for segment in range(segments):
            following = np.zeros(0, np.intp)
            if segment < segments - 1:
                following = np.arange(size, size + states)
                size += states
            acting = np.concatenate([np.arange(shared), own, following])
            blocks.append(generator.normal(size=(rows, len(acting))))
            columns.append(acting)
            own = following
    matrix = BlockMatrix(tuple(blocks), tuple(columns), size)
    return matrix, generator.normal(size=matrix.row_count)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize("width", [np.inf, 0.1])
def test_steps_are_those_of_the_whole_matrix(seed, damping, width):
    matrix, residuals = chained_matrix(seed, rows=9 if seed else 4)
    bounds = np.full(matrix.size, -width), np.full(matrix.size, width)
    scale = matrix.norms()
    chain = SparseStepSolver(FactoredChains, matrix, residuals, scale, *bounds)
    dense = StepSolver(matrix.dense(), residuals, scale, *bounds)
    step = chain.step(damping)
    np.testing.assert_allclose(
        step, dense.step(damping), atol=1e-6 if damping < 1e-6 and not seed else 1e-11
    )
    assert chain.predicted_cost(step) == pytest.approx(dense.predicted_cost(step))


def test_links_act_on_two_neighbours_and_nothing_else():
    matrix, _ = chained_matrix(0, records=1, segments=3, states=1, shared=1)
    np.testing.assert_array_equal(matrix.links, [False, False, True, True])


def test_records_are_chains_of_their_own():
    matrix, residuals = chained_matrix(0, records=3, segments=4)
    border = np.zeros(matrix.size, bool)
    border[:2] = True
    chains = make_chains(matrix, residuals, border)
    assert [len(chain.links) for chain in chains] == [4, 4, 4]
    assert [link.arrived for link in chains[0].links] == [0, 3, 3, 3]
    assert [link.eliminated for link in chains[0].links] == [3, 3, 3, 3]


def test_the_elimination_keeps_all_that_the_rows_say_of_the_border():
    matrix, residuals = chained_matrix(4, records=1)
    border = np.zeros(matrix.size, bool)
    border[:2] = True
    (chain,) = make_chains(matrix, residuals, border)
    nothing = np.zeros(matrix.size)
    rest = eliminate(chain, border & False, nothing, nothing).rest
    whole = matrix.dense()
    inner = whole[:, 2:]
    others = np.column_stack([whole[:, :2], residuals])
    left = others - inner @ np.linalg.lstsq(inner, others, rcond=None)[0]
    np.testing.assert_allclose(rest.T @ rest, left.T @ left, atol=1e-10)


def test_work_grows_with_the_number_of_segments_and_not_with_its_square():
    sizes = []
    for segments in (50, 100):
        matrix, residuals = chained_matrix(1, records=1, segments=segments)
        border = np.zeros(matrix.size, bool)
        border[:2] = True
        (chain,) = make_chains(matrix, residuals, border)
        sizes.append(sum(link.triangle.size for link in chain.links))
    assert sizes[1] < 2.1 * sizes[0]
