import pickle
from functools import partial

import numpy as np
import pytest

from cluster_est.methods.block_matrix import BlockMatrix
from cluster_est.methods.least_squares import linear_map
from cluster_est.methods.least_squares.linear_map import (
    FactoredBlocks,
    FactoredChains,
    StepSolver,
)
from cluster_est.methods.least_squares.sparse_step import SparseStepSolver, within_bounds

DAMPINGS = (1e-14, 1e-6, 1e-3, 1.0, 1e6)


def made(blocks, columns, size, generator):
    matrix = BlockMatrix(tuple(blocks), tuple(columns), size)
    return matrix, generator.normal(size=matrix.row_count), generator


def random_matrix(seed, experiments=9, shared=3, own=2, groups=0, rows=(8, 14)):
    """Blocks with shared unknowns, some of groups of experiments, and each experiment's own."""
    generator = np.random.default_rng(seed)
    parts, columns = [], []
    for e in range(experiments):
        acting = list(range(shared))
        acting += [shared + e % groups] if groups else []
        acting += [shared + groups + j * experiments + e for j in range(own)]
        columns.append(np.array(acting))
        parts.append(generator.normal(size=(int(generator.integers(*rows)), len(acting))))
    return made(parts, columns, shared + groups + own * experiments, generator)


def chained_matrix(seed, records=2, segments=5, states=3, shared=2, rows=9):
    """Each segment has shared unknowns, its own states and those of the next segment."""
    generator = np.random.default_rng(seed)
    parts, columns = [], []
    for e in range(records * segments):
        last = (e + 1) % segments == 0
        acting = [*range(shared), *shared + states * e + np.arange(states * (1 if last else 2))]
        columns.append(np.array(acting))
        parts.append(generator.normal(size=(rows, len(acting))))
    return made(parts, columns, shared + states * records * segments, generator)


FEW_ROWS = [
    (FactoredBlocks, partial(random_matrix, own=4, rows=(2, 9))),
    (FactoredChains, partial(chained_matrix, rows=4)),
]
"""Experiments with fewer residuals than unknowns."""
SHAPES = [
    (FactoredBlocks, random_matrix),
    (FactoredBlocks, partial(random_matrix, groups=3)),
    (FactoredBlocks, partial(random_matrix, shared=0)),
    (FactoredBlocks, partial(random_matrix, own=0)),
    (FactoredBlocks, partial(random_matrix, shared=0, groups=4, own=1)),
    (FactoredChains, chained_matrix),
    (FactoredChains, partial(chained_matrix, records=3, segments=4)),
    *FEW_ROWS,
]


def solver_of(factor, matrix, residuals, scale=None, width=np.inf):
    bounds = np.full(matrix.size, -width), np.full(matrix.size, width)
    scale = matrix.norms() if scale is None else scale
    return SparseStepSolver(factor, matrix, residuals, scale, *bounds)


def least_squares(matrix, residuals, scale, damping):
    """The minimum without bounds, from one large array."""
    system = np.vstack([matrix, np.sqrt(damping) * np.diag(scale)])
    target = np.concatenate([-residuals, np.zeros(len(scale))])
    return np.linalg.lstsq(system, target, rcond=None)[0]


def far_from_optimal(matrix, residuals, scale, damping, bounds, step):
    """The largest violation of the conditions of Karush, Kuhn and Tucker, in units of `scale`."""
    lower, upper = bounds
    assert ((step >= lower) & (step <= upper)).all()
    slope = matrix.T @ (matrix @ step + residuals) + damping * scale**2 * step
    slope = slope / scale
    slope = np.where(step <= lower, np.minimum(slope, 0.0), slope)
    slope = np.where(step >= upper, np.maximum(slope, 0.0), slope)
    return np.abs(np.where(lower == upper, 0.0, slope)).max()


def test_products_are_those_of_the_whole_matrix():
    matrix, values, generator = random_matrix(1, groups=2)
    whole, step = matrix.dense(), generator.normal(size=matrix.size)
    np.testing.assert_allclose(matrix.product(step), whole @ step, atol=1e-13)
    np.testing.assert_allclose(matrix.transposed_product(values), whole.T @ values, atol=1e-13)
    np.testing.assert_allclose(matrix.norms(), np.linalg.norm(whole, axis=0), rtol=1e-14)
    np.testing.assert_array_equal(matrix.scaled_rows(values).dense(), values[:, None] * whole)
    np.testing.assert_array_equal(matrix.divided_columns(step).dense(), whole / step)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("factor", "make"), SHAPES)
def test_steps_without_bounds_are_those_of_the_whole_matrix(factor, make, seed):
    matrix, residuals, generator = make(seed)
    scale = generator.uniform(0.1, 10.0, matrix.size)
    solver, whole = solver_of(factor, matrix, residuals, scale), matrix.dense()
    for damping in DAMPINGS[1:] if (factor, make) in FEW_ROWS else DAMPINGS:
        expected = least_squares(whole, residuals, scale, damping)
        step = solver.step(damping)
        np.testing.assert_allclose(step, expected, rtol=1e-10, atol=1e-10 * abs(expected).max())
        cost = float(((whole @ step + residuals) ** 2).sum())
        assert solver.predicted_cost(step) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("width", [0.01, 0.1, 0.5])
@pytest.mark.parametrize(("factor", "make"), SHAPES[:2] + SHAPES[5:7])
def test_steps_within_bounds_are_optimal(factor, make, width, seed):
    matrix, residuals, generator = make(seed)
    scale = matrix.norms()
    bounds = -width * generator.uniform(0.0, 1.0, matrix.size), np.full(matrix.size, width)
    bounds[0][::5] = 0.0  # they stand at a bound already
    bounds[1][::7] = np.inf
    bounds[0][::11] = bounds[1][::11] = 0.0  # they cannot move at all
    solver = SparseStepSolver(factor, matrix, residuals, scale, *bounds)
    for damping in DAMPINGS:
        step = solver.step(damping)
        far = far_from_optimal(matrix.dense(), residuals, scale, damping, bounds, step)
        assert far < 1e-10 * (1.0 + damping)


@pytest.mark.parametrize(("factor", "make"), [SHAPES[0], SHAPES[5]])
def test_columns_of_any_size_count(factor, make):
    matrix, residuals, generator = make(3)
    sizes = 10.0 ** generator.uniform(-150.0, 150.0, matrix.size)
    plain, scaled = matrix, matrix.divided_columns(1.0 / sizes)
    one, other = (solver_of(factor, each, residuals).step(1e-3) for each in (plain, scaled))
    np.testing.assert_allclose(other * sizes, one, rtol=1e-9)


def test_frozen_unknowns_stay():
    matrix, residuals, _ = random_matrix(4, groups=2)
    frozen = np.zeros(matrix.size, dtype=bool)
    frozen[[0, 4, 9, 17]] = True
    for part, columns in zip(matrix.blocks, matrix.columns, strict=True):
        part[:, frozen[columns]] = 0.0
    scale = np.where(frozen, 1.0, matrix.norms())
    solver = solver_of(FactoredBlocks, matrix, residuals, scale)
    expected = least_squares(matrix.dense(), residuals, scale, 1e-3)
    assert (solver.step(1e-3)[frozen] == 0.0).all()
    np.testing.assert_allclose(solver.step(1e-3), expected, atol=1e-12)
    np.testing.assert_array_equal(solver.step(1e-14)[frozen], 0.0)


def test_blocks_pay_only_where_the_whole_matrix_would_be_large():
    assert not random_matrix(0)[0].sparse
    assert not random_matrix(0, experiments=1, own=300)[0].sparse
    assert random_matrix(0, experiments=150)[0].sparse


def test_memory_grows_with_the_number_of_segments_and_not_with_its_square():
    sizes = []
    for segments in (50, 100):
        matrix, residuals, _ = chained_matrix(1, records=1, segments=segments)
        sizes.append(len(pickle.dumps(FactoredChains(matrix, residuals))))
    assert sizes[1] < 2.1 * sizes[0]


class TestActiveSet:
    def test_places_change_one_at_a_time_where_all_at_once_would_cycle(self):
        # exchanging all wrong places at once cycles on some matrices that are far from diagonal
        generator = np.random.default_rng(7)
        for _ in range(40):
            root = generator.normal(size=(8, 8)) @ np.diag(10.0 ** generator.uniform(-2, 0, 8))
            curvature = root @ root.T + 1e-6 * np.eye(8)
            right = generator.normal(size=8)

            def solve(fixed, moved, curvature=curvature, right=right):
                found, free = moved.copy(), ~fixed
                rest = right[free] - curvature[np.ix_(free, fixed)] @ moved[fixed]
                found[free] = np.linalg.solve(curvature[np.ix_(free, free)], rest)
                return found

            def slope(x, curvature=curvature, right=right):
                return curvature @ x - right, 1.0

            lower, upper = np.full(8, -0.1), np.full(8, 0.1)
            x = within_bounds(solve, slope, lower, upper, rounds=2**8)
            gradient = slope(x)[0]
            assert (gradient[x < upper] > -1e-8).all()
            assert (gradient[x > lower] < 1e-8).all()

    def test_too_few_rounds_still_give_a_step_within_bounds(self):
        matrix, residuals, _ = random_matrix(6)
        whole = matrix.dense()

        def solve(fixed, moved):
            return least_squares(whole, residuals, np.ones(matrix.size), 1e-3)

        limit = np.full(matrix.size, 1e-3)
        found = within_bounds(solve, lambda x: (x, 1.0), -limit, limit, rounds=1)
        assert (np.abs(found) <= limit).all()


@pytest.mark.parametrize("rows", [3, 100, 1001])
def test_a_large_jacobian_gives_the_same_steps_part_by_part(rows, monkeypatch):
    generator = np.random.default_rng(5)
    matrix, residuals = generator.normal(size=(rows, 7)), generator.normal(size=rows)
    matrix[:, 3] = 0.0
    scale = np.maximum(np.linalg.norm(matrix, axis=0), 1.0)
    bounds = np.full(7, -0.05), np.full(7, 0.02)
    whole = StepSolver(matrix, residuals, scale, *bounds)
    monkeypatch.setattr(linear_map, "LARGE_MATRIX", 10)
    monkeypatch.setattr(linear_map, "PART_OF_MATRIX", 200)
    parts = StepSolver(matrix, residuals, scale, *bounds)
    for damping in DAMPINGS:
        step = whole.step(damping)
        np.testing.assert_allclose(parts.step(damping), step, rtol=1e-9, atol=1e-8)
        assert parts.predicted_cost(step) == pytest.approx(whole.predicted_cost(step), rel=1e-12)
