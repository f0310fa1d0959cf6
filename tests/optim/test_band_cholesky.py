from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.band_cholesky import BandInverse, _by_blocks, _by_lapack

F64 = torch.float64
WAYS = {"lapack": _by_lapack, "blocks": _by_blocks}


def banded(q: int, w: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """A positive definite matrix, dense and as its lower band; behind the last row the band holds anything."""
    factor = torch.randn(q, q, dtype=F64, generator=generator).tril().triu(1 - w)
    factor.diagonal().abs_().add_(w**0.5)
    dense = factor @ factor.T
    lower = torch.full((q, w), torch.nan, dtype=F64)
    for d in range(min(w, q)):
        lower[: q - d, d] = dense.diagonal(-d)
    return dense, lower


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    ("q", "w"), [(1, 1), (5, 1), (7, 3), (32, 4), (100, 40), (211, 144), (90, 200)]
)
def test_solutions_and_determinant_are_those_of_the_dense_matrix(
    way: str, q: int, w: int, generator: torch.Generator
) -> None:
    dense, lower = banded(q, w, generator)
    right = torch.randn(q, 3, dtype=F64, generator=generator)
    factor = WAYS[way](lower.clone())
    assert factor is not None
    torch.testing.assert_close(factor.solve(right), torch.linalg.solve(dense, right))
    torch.testing.assert_close(factor.log_determinant, dense.logdet())


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(("q", "w", "reach"), [(1, 1, 0), (7, 3, 5), (100, 40, 0), (211, 20, 90)])
def test_the_inverse_near_the_diagonal_is_that_of_the_dense_matrix(
    way: str, q: int, w: int, reach: int, generator: torch.Generator
) -> None:
    dense, lower = banded(q, w, generator)
    factor = WAYS[way](lower.clone())
    assert factor is not None
    row, column = torch.meshgrid(torch.arange(q), torch.arange(q), indexing="ij")
    near = (row - column).abs() <= max(w - 1, reach)
    found = BandInverse.of(factor, reach).read(row[near], column[near])
    torch.testing.assert_close(found, torch.linalg.inv(dense)[near])


@pytest.mark.parametrize("way", WAYS)
def test_a_matrix_that_is_not_positive_definite_has_no_factor(
    way: str, generator: torch.Generator
) -> None:
    _, lower = banded(70, 6, generator)
    lower[66, 0] -= 100.0
    assert WAYS[way](lower) is None
