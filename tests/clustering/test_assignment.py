"""Gated matching and window pairs."""

from __future__ import annotations

import itertools

import pytest
import torch

from crowdmap_torch.clustering.assignment import gated_matching, window_pairs


def _best_by_enumeration(cost: torch.Tensor, gate: float) -> float:
    n, m = cost.shape
    best = 0.0
    for columns in itertools.permutations([*range(m), *([None] * n)], n):
        pairs = [(r, c) for r, c in enumerate(columns) if c is not None]
        best = min(best, sum(float(cost[r, c]) - gate for r, c in pairs if cost[r, c] < gate))
    return best


@pytest.mark.parametrize("shape", [(3, 3), (2, 4), (4, 2)])
def test_matching_is_the_cheapest_of_all(shape):
    generator = torch.Generator().manual_seed(3)
    cost = 10 * torch.rand(shape, dtype=torch.float64, generator=generator)
    row, column = gated_matching(cost, 6.0)
    total = float((cost[row, column] - 6.0).sum())
    assert total == pytest.approx(_best_by_enumeration(cost, 6.0))


def test_pairs_at_the_gate_or_beyond_are_never_matched():
    cost = torch.tensor([[1.0, torch.inf], [torch.inf, 5.0]], dtype=torch.float64)
    row, column = gated_matching(cost, 5.0)
    assert row.tolist() == [0] and column.tolist() == [0]


def test_an_excellent_pair_is_not_given_up_for_two_poor_ones():
    cost = torch.tensor([[1.0, 8.0], [9.0, torch.inf]], dtype=torch.float64)
    row, column = gated_matching(cost, 10.0)
    assert (row.tolist(), column.tolist()) == ([0], [0])


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
def test_empty_sides_match_nothing(shape):
    row, column = gated_matching(torch.zeros(shape, dtype=torch.float64), 1.0)
    assert len(row) == len(column) == 0


@pytest.mark.parametrize("chunk", [1, 3, 1000])
def test_window_pairs_are_all_pairs_in_the_window(chunk):
    time = torch.tensor([0, 0, 1, 4, 4, 5, 9, 12, 13])
    pairs = window_pairs(time, 3)
    listed = [
        (int(a), int(b)) for ea, la in pairs.chunks(chunk) for a, b in zip(ea, la, strict=True)
    ]
    expected = [(a, b) for b in range(9) for a in range(9) if 1 <= int(time[b] - time[a]) <= 3]
    assert listed == expected
    for number, (a, b) in enumerate(listed):
        assert int(pairs.index(torch.tensor(a), torch.tensor(b))) == number
    assert int(pairs.index(torch.tensor(0), torch.tensor(3))) == -1
    assert int(pairs.index(torch.tensor(0), torch.tensor(1))) == -1


def test_no_rows_make_no_pairs():
    pairs = window_pairs(torch.zeros(0, dtype=torch.int64), 5)
    assert pairs.total == 0 and list(pairs.chunks(10)) == []
