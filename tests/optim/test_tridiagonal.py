"""Tridiagonal systems one behind the other."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.optim.tridiagonal import solve_tridiagonal

F64 = torch.float64


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("lengths", [(1,), (1, 1, 1), (7,), (8, 1, 33, 2), (64, 65)])
def test_every_system_is_solved_by_itself(lengths: tuple[int, ...], seed: int):
    g = torch.Generator().manual_seed(seed)
    total, ends = sum(lengths), torch.tensor(lengths).cumsum(0) - 1
    beside = torch.randn(total, 2, generator=g, dtype=F64)
    beside[ends] = 0
    diagonal = 0.1 + beside.abs() + torch.cat((torch.zeros(1, 2, dtype=F64), beside[:-1].abs()))
    right = torch.randn(total, 2, generator=g, dtype=F64)
    found = solve_tridiagonal(diagonal, beside, right, max(lengths))
    for column in range(2):
        b = beside[:-1, column]
        dense = diagonal[:, column].diag() + b.diag(1) + b.diag(-1)
        torch.testing.assert_close(found[:, column], torch.linalg.solve(dense, right[:, column]))


def test_nothing_is_solved_where_there_is_nothing():
    none = torch.zeros(0, 3, dtype=F64)
    assert solve_tridiagonal(none, none, none, 1).shape == (0, 3)
