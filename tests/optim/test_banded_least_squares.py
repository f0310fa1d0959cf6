from __future__ import annotations

import torch

from crowdmap_torch.optim.banded_least_squares import solve_banded


def test_banded_solution_is_that_of_dense_least_squares(generator: torch.Generator) -> None:
    count, width, rows = 17, 4, 60
    start = torch.randint(0, count - width + 1, (rows,), generator=generator)
    row = torch.randn(rows, width, generator=generator, dtype=torch.float64)
    target = torch.randn(rows, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(rows, generator=generator, dtype=torch.float64) + 0.1
    dense = torch.zeros(rows, count, dtype=torch.float64)
    dense.scatter_(1, start[:, None] + torch.arange(width), row)
    root = weight.sqrt()[:, None]
    expected = torch.linalg.lstsq(root * dense, root * target).solution
    found = solve_banded(start, row, target, weight, count)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)


def test_separate_problems_do_not_mix(generator: torch.Generator) -> None:
    row = torch.randn(12, 2, generator=generator, dtype=torch.float64)
    target = torch.randn(12, 1, generator=generator, dtype=torch.float64)
    weight = torch.ones(12, dtype=torch.float64)
    start = torch.tensor([0, 1, 0, 1, 0, 1, 3, 4, 3, 4, 3, 4])
    both = solve_banded(start, row, target, weight, 6)
    first = solve_banded(start[:6], row[:6], target[:6], weight[:6], 3)
    torch.testing.assert_close(both[:3], first, rtol=0, atol=1e-12)
