"""Cholesky factors by tiles against LAPACK's."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from crowdmap_torch.optim.solvers.sparse_tiles import TileMatrix, TilePattern, tile_width
from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.processes.threads import one_core_each


def matrix(dim):
    """A positive definite one."""
    generator = torch.Generator().manual_seed(dim)
    root = torch.randn(dim + 3, dim + 3, dtype=torch.float64, generator=generator)
    return (root @ root.mT + dim * torch.eye(dim + 3).double())[:dim, :dim]


def by_tiles(A, present=None, width=None):
    """The same by tiles; of those `present`, all of them without it."""
    width = width or tile_width(len(A), A.device)
    count = -(-len(A) // width)
    present = np.ones((count, count), dtype=bool) if present is None else present
    pattern = TilePattern.of(len(A), width, present, A.device).filled()
    found = TileMatrix.zeros(pattern, A)
    row, column = torch.meshgrid(torch.arange(len(A)), torch.arange(len(A)), indexing="ij")
    kept = pattern.present[row // width, column // width]
    found.add(row[kept], column[kept], A[kept][None, None])
    found.add_diagonal(torch.zeros(len(A), dtype=A.dtype))
    return found


def sparse(width, *bound, tiles=6, short=3):
    """A matrix of which tiles that are not `bound` hold nothing, and which are."""
    present = np.eye(tiles, dtype=bool)
    for i, j in bound:
        present[i, j] = present[j, i] = True
    dim = tiles * width - short
    whole = torch.from_numpy(np.kron(present, np.ones((width, width)))).double()[:dim, :dim]
    # Not positive definite without it, where entries are left out.
    return matrix(dim) * whole + 3 * dim * torch.eye(dim).double(), present


PATTERNS = {
    "none": (),
    "chain": ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5)),
    "fills in": ((0, 3), (0, 5), (1, 4), (2, 5)),
    "arrow": ((0, 5), (1, 5), (2, 5), (3, 5), (4, 5)),
    "all to the first": ((0, 1), (0, 2), (0, 3), (0, 4), (0, 5)),
}


@pytest.mark.parametrize("dim", [0, 1, 50, 768, 1000])
def test_factors_solve_and_invert(dim):
    A, right_side = matrix(dim), torch.linspace(-1, 1, 2 * dim).double().view(dim, 2)
    factor = TiledCholesky.of(by_tiles(A))
    assert factor is not None
    torch.testing.assert_close(factor.solve(right_side), torch.linalg.solve(A, right_side))
    torch.testing.assert_close(factor.selected_inverse().dense(), torch.linalg.inv(A))


@pytest.mark.parametrize("bound", PATTERNS.values(), ids=list(PATTERNS))
@pytest.mark.parametrize("short", [0, 3])
def test_sparse_factors_solve_and_invert_where_they_have_tiles(bound, short):
    A, present = sparse(7, *bound, short=short)
    right_side = torch.linspace(-1, 1, 2 * len(A)).double().view(-1, 2)
    tiles = by_tiles(A, present, 7)
    torch.testing.assert_close(tiles.dense(), A)
    factor = TiledCholesky.of(tiles)
    assert factor is not None
    torch.testing.assert_close(factor.solve(right_side), torch.linalg.solve(A, right_side))
    inverse, expected = factor.selected_inverse(), torch.linalg.inv(A)
    row, column = torch.nonzero(
        torch.from_numpy(present)
        .repeat_interleave(7, 0)
        .repeat_interleave(7, 1)[: len(A), : len(A)],
        as_tuple=True,
    )
    torch.testing.assert_close(inverse.read(row, column), expected[row, column])


def test_memory_grows_with_the_tiles_that_hold_anything():
    chain = np.eye(200, dtype=bool) | np.eye(200, k=1, dtype=bool)
    pattern = TilePattern.of(200 * 10, 10, chain, torch.device("cpu")).filled()
    assert pattern.count == 399
    assert pattern.size < 45_000


def test_entries_without_a_tile_are_neither_added_nor_read():
    A, present = sparse(7, (0, 1))
    tiles = by_tiles(A, present, 7)
    far = torch.tensor([30])
    with pytest.raises(ValueError, match="not kept"):
        tiles.read(torch.tensor([0]), far)
    with pytest.raises((IndexError, RuntimeError)):
        tiles.add(torch.tensor([0]), far, torch.ones(1, 1, 1).double())


@pytest.mark.parametrize("dim", [40, 900])
@pytest.mark.parametrize("spoilt", [-1.0, float("nan"), float("inf")])
def test_what_is_not_positive_definite_has_no_factors(dim, spoilt):
    A = matrix(dim)
    A[dim // 2, dim // 2] = spoilt
    assert TiledCholesky.of(by_tiles(A)) is None
    A = matrix(dim)
    A[0, dim - 1] = float("nan")
    assert TiledCholesky.of(by_tiles(A)) is None


def test_factors_have_the_same_bits_on_any_number_of_cores():
    A, before, found = matrix(1200), torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with one_core_each():
                factor = TiledCholesky.of(by_tiles(A))
                assert factor is not None
                found.append((factor.upper.dense(), factor.selected_inverse().dense()))
    finally:
        torch.set_num_threads(before)
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_inverse_is_right_at_the_far_end_of_a_long_road(seed: int):
    """Blocks that two others tell well, and nothing else: what rounding leaves must not grow along them."""
    generator = torch.Generator().manual_seed(seed)
    steps, width = 300, 4
    A = 1e-2 * torch.eye((steps + 2) * width).double()
    for step in range(steps):
        rows = slice(step * width, (step + 3) * width)
        bend = 10 * torch.randn(width, 3 * width, generator=generator, dtype=torch.float64)
        bend += 100 * torch.tensor([[1.0, -2.0, 1.0]]).kron(torch.eye(width))
        A[rows, rows] += bend.mT @ bend
    tile = torch.arange(len(A) // width)
    band = ((tile[:, None] - tile).abs() <= 2).numpy()
    factor = TiledCholesky.of(by_tiles(A, band, width))
    assert factor is not None
    every = torch.arange(len(A))
    found = factor.selected_inverse().read(every, every)
    expected = factor.solve(torch.eye(len(A)).double()).diagonal()
    torch.testing.assert_close(found, expected, rtol=1e-8, atol=0)
