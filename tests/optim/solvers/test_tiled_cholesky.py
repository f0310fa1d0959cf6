"""Cholesky factors by tiles against LAPACK's."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.solvers.tiled_cholesky import TiledCholesky
from crowdmap_torch.processes.threads import one_core_each


def matrix(dim):
    """A positive definite one, rows of a larger one in memory."""
    generator = torch.Generator().manual_seed(dim)
    root = torch.randn(dim + 3, dim + 3, dtype=torch.float64, generator=generator)
    return (root @ root.mT + dim * torch.eye(dim + 3).double())[:dim, :dim]


@pytest.mark.parametrize("dim", [0, 1, 50, 768, 1000])
def test_factors_solve_and_invert(dim):
    A, right_side = matrix(dim), torch.linspace(-1, 1, 2 * dim).double().view(dim, 2)
    factor = TiledCholesky.of(A.triu())
    assert factor is not None
    torch.testing.assert_close(factor.solve(right_side), torch.linalg.solve(A, right_side))
    torch.testing.assert_close(factor.inverse(), torch.linalg.inv(A))


@pytest.mark.parametrize("dim", [40, 900])
@pytest.mark.parametrize("spoilt", [-1.0, float("nan"), float("inf")])
def test_what_is_not_positive_definite_has_no_factors(dim, spoilt):
    A = matrix(dim)
    A[dim // 2, dim // 2] = spoilt
    assert TiledCholesky.of(A) is None
    A = matrix(dim)
    A[0, dim - 1] = float("nan")
    assert TiledCholesky.of(A) is None


def test_factors_have_the_same_bits_on_any_number_of_cores():
    A, before, found = matrix(1200), torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with one_core_each():
                factor = TiledCholesky.of(A.clone())
            assert factor is not None
            found.append(factor.upper.triu())
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)
