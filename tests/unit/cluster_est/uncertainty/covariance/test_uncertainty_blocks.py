"""The block-wise covariance is that of the dense Jacobian."""

import numpy as np
import pytest
from scipy.linalg import block_diag, null_space

from cluster_est.uncertainty.covariance.blocks import (
    ErrorLimits,
    JacobianBlock,
    block_covariance,
    factorise,
)


def random_blocks(seed, shared=3, sizes=((20, 2), (15, 0), (30, 4), (6, 6))):
    generator = np.random.default_rng(seed)
    return [
        JacobianBlock(generator.normal(size=(n, shared)), generator.normal(size=(n, local)))
        for n, local in sizes
    ]


def dense(blocks):
    """Shared columns first, then the local ones of one block after the other."""
    shared = np.vstack([block.shared for block in blocks])
    return np.column_stack([shared, block_diag(*(block.local for block in blocks))])


def limits(blocks, size):
    width = blocks[0].shared.shape[1]
    local = tuple(np.full(block.local.shape[1], size) for block in blocks)
    return ErrorLimits(np.full(width, size), local, np.eye(width))


def factorised(blocks, size=1e-12, weak=1e-9):
    """With errors of the derivatives of this size."""
    return factorise(blocks, limits(blocks, size), weak)


def check(found, expected, blocks):
    """Whether all parts of a block-wise covariance stand in the dense one."""
    width = blocks[0].shared.shape[1]
    np.testing.assert_allclose(found.shared, expected[:width, :width], rtol=1e-10, atol=1e-12)
    first = width
    for block, cross, local in zip(blocks, found.cross, found.local, strict=True):
        part = slice(first, first + block.local.shape[1])
        np.testing.assert_allclose(cross, expected[part, :width], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(local, expected[part, part], rtol=1e-10, atol=1e-12)
        first = part.stop


NONE_LOCAL = ((10, 0), (8, 0))


@pytest.mark.parametrize(
    "blocks",
    [*(random_blocks(n, n) for n in (0, 1, 4)), random_blocks(0, 2, NONE_LOCAL)],
    ids=["no shared", "one shared", "four shared", "no local"],
)
def test_covariance_is_that_of_the_dense_jacobian(blocks):
    factors, matrix = factorised(blocks), dense(blocks)
    assert factors.rank == matrix.shape[1]
    assert factors.combinations == ()
    check(block_covariance(factors), np.linalg.inv(matrix.T @ matrix), blocks)


@pytest.mark.parametrize("seed", range(3))
def test_sandwich_is_that_of_the_dense_jacobian(seed):
    blocks = random_blocks(seed)
    generator = np.random.default_rng(seed + 100)
    spread = [generator.uniform(0.1, 3.0, len(block.shared)) for block in blocks]
    noise = [lambda columns, d=d: d[:, None] * columns for d in spread]
    found = block_covariance(factorised(blocks), noise)
    matrix = dense(blocks)
    bread = np.linalg.inv(matrix.T @ matrix)
    filling = matrix.T @ (np.concatenate(spread)[:, None] * matrix)
    check(found, bread @ filling @ bread, blocks)


def spoilt(seed):
    """Blocks with three null directions: shared, shared with local, and local alone."""
    blocks = random_blocks(seed, 4)
    blocks[2].local[:, 3] = blocks[2].local[:, 1]
    for block in blocks:
        block.shared[:, 1] = 2.0 * block.shared[:, 0]
    blocks[1].shared[:, 2] = 0.0
    blocks[3].shared[:, 2] = 0.0
    for e in (0, 2):
        blocks[e].shared[:, 2] = blocks[e].local @ np.arange(1.0, 1.0 + blocks[e].local.shape[1])
    return blocks


@pytest.mark.parametrize("seed", range(3))
def test_lost_directions_are_the_null_space(seed):
    blocks = spoilt(seed)
    factors = factorised(blocks)
    expected = null_space(dense(blocks), rcond=1e-10)
    assert expected.shape[1] == 3
    assert factors.rank == dense(blocks).shape[1] - 3
    sizes = [block.local.shape[1] for block in blocks]
    found = []
    for each in factors.combinations:
        pairs = zip(each.local, sizes, strict=True)
        local = [part if len(part) else np.zeros(n) for part, n in pairs]
        found.append(np.concatenate([each.shared, *local]))
    assert len(found) == 3
    assert all(c.undetermined for c in factors.combinations)
    for vector in found:
        assert np.linalg.norm(vector) == pytest.approx(1.0)
        np.testing.assert_allclose(expected @ (expected.T @ vector), vector, atol=1e-9)
    assert np.linalg.matrix_rank(np.array(found), tol=1e-6) == 3


@pytest.mark.parametrize("seed", range(3))
def test_what_is_determined_keeps_its_variance_beside_lost_directions(seed):
    blocks = spoilt(seed)
    found = block_covariance(factorised(blocks))
    inverse = np.linalg.pinv(dense(blocks), rcond=1e-10)
    expected = inverse @ inverse.T
    # 2 a + b is determined where b counts twice as much as a does
    contrast = np.array([1.0, 2.0, 0.0, 0.0])
    width = 4
    assert contrast @ found.shared @ contrast == pytest.approx(
        contrast @ expected[:width, :width] @ contrast
    )
    assert found.shared[3, 3] == pytest.approx(expected[3, 3])


def test_fewer_residuals_than_local_unknowns():
    blocks = random_blocks(3, 1, ((3, 5), (12, 1)))
    factors = factorised(blocks)
    assert len(factors.combinations) == 2
    assert factors.rank == np.linalg.matrix_rank(dense(blocks))


def test_a_direction_is_lost_only_below_its_limit():
    blocks = random_blocks(0, 3)
    generator = np.random.default_rng(1)
    for block in blocks:
        noise = generator.normal(size=len(block.shared))
        block.shared[:, 1] = block.shared[:, 0] + 1e-5 * noise
    assert factorised(blocks).combinations == ()
    (weak,) = factorised(blocks, weak=1e-3).combinations
    assert not weak.undetermined
    (lost,) = factorised(blocks, 1e-4).combinations
    assert lost.undetermined
    np.testing.assert_allclose(np.abs(lost.shared[:2]), 0.5**0.5, rtol=1e-3)
