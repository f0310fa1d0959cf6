"""Gated matching, window pairs, and rows matched to slots along sparse candidates."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from scipy.optimize import linear_sum_assignment

from crowdmap_torch.clustering.assignment import (
    gated_matching,
    match_slots,
    matching_of_near,
    window_pairs,
)


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
    row, column = gated_matching(cost.numpy(), 6.0)
    total = float((cost[row, column] - 6.0).sum())
    assert total == pytest.approx(_best_by_enumeration(cost, 6.0))


def test_pairs_at_the_gate_or_beyond_are_never_matched():
    cost = torch.tensor([[1.0, torch.inf], [torch.inf, 5.0]], dtype=torch.float64)
    row, column = gated_matching(cost.numpy(), 5.0)
    assert row.tolist() == [0] and column.tolist() == [0]


def test_an_excellent_pair_is_not_given_up_for_two_poor_ones():
    cost = torch.tensor([[1.0, 8.0], [9.0, torch.inf]], dtype=torch.float64)
    row, column = gated_matching(cost.numpy(), 10.0)
    assert (row.tolist(), column.tolist()) == ([0], [0])


@pytest.mark.parametrize("shape", [(0, 3), (3, 0), (0, 0)])
@pytest.mark.parametrize("matching", [gated_matching, matching_of_near])
def test_empty_sides_match_nothing(matching, shape):
    row, column = matching(np.zeros(shape), 1.0)
    assert len(row) == len(column) == 0


def test_the_gate_of_near_columns_leaves_their_partners_open():
    # Column 1 is near row 0 only, which column 0 has; so it takes row 1, however dear. Column 2 is near no row.
    cost = np.array([[0.1, 4.0, 9.0], [50.0, 30.0, 7.0]])
    row, column = matching_of_near(cost, 5.0)
    assert (row.tolist(), column.tolist()) == ([0, 1], [0, 1])


def test_impossible_pairs_are_never_matched_and_a_match_is_not_given_up_for_one():
    cost = np.array([[1.0, np.inf], [2.0, np.inf], [3.0, np.inf]])
    row, column = matching_of_near(cost, 5.0)
    assert (row.tolist(), column.tolist()) == ([0], [0])
    cost = np.array([[1.0, 4.0], [np.inf, np.inf]])
    row, column = matching_of_near(cost, 5.0)
    assert (row.tolist(), column.tolist()) == ([0], [0])


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
        assert int(pairs.start[b] + a - pairs.first[b]) == number


def test_no_rows_make_no_pairs():
    pairs = window_pairs(torch.zeros(0, dtype=torch.int64), 5)
    assert pairs.total == 0 and list(pairs.chunks(10)) == []


def test_matches_the_optimal_assignment_of_a_full_problem():
    g = torch.Generator().manual_seed(0)
    cost = torch.rand(12, 9, generator=g, dtype=torch.float64)
    row, slot = torch.cartesian_prod(torch.arange(12), torch.arange(9)).T
    found = match_slots(row, slot, cost.flatten(), rows=12, unmatched_cost=0.25)
    total = torch.where(found >= 0, cost[torch.arange(12), found.clamp_min(0)], 0.25).sum()
    padded = torch.cat((cost, torch.full((12, 12), 0.25).double()), dim=1).numpy()
    r, c = linear_sum_assignment(padded)
    # The same sum of numbers of order one, added in another order.
    assert abs(float(total) - padded[r, c].sum()) < 1e-12
    taken = found[found >= 0]
    assert len(taken.unique()) == len(taken)


def test_a_common_shift_does_not_swap_neighbours():
    heads, signs = torch.tensor([0.0, 0.7]), torch.tensor([0.5, 1.2])
    row, slot = torch.cartesian_prod(torch.arange(2), torch.arange(2)).T
    cost = (signs[row] - heads[slot]).square().double()
    # The first sign is nearer to the second head, yet the pair fits best as a pair.
    assert match_slots(row, slot, cost, rows=2, unmatched_cost=4.0).tolist() == [0, 1]


def test_pairs_dearer_than_no_match_are_never_used():
    found = match_slots(
        torch.tensor([0, 1]),
        torch.tensor([5, 5]),
        torch.tensor([0.2, 2.0]).double(),
        rows=3,
        unmatched_cost=1.0,
    )
    assert found.tolist() == [5, -1, -1]


def test_independent_rows_take_their_cheapest_slot():
    row = torch.tensor([0, 0, 1, 1, 2])
    slot = torch.tensor([10, 11, 10, 11, 40])
    cost = torch.tensor([0.1, 0.5, 0.5, 0.1, 0.3]).double()
    assert match_slots(row, slot, cost, rows=3, unmatched_cost=1.0).tolist() == [10, 11, 40]


def test_rows_without_candidates_have_no_slot():
    none = torch.zeros(0, dtype=torch.int64)
    assert match_slots(
        none, none, torch.zeros(0).double(), rows=2, unmatched_cost=1.0
    ).tolist() == [-1, -1]
