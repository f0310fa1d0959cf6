"""One-to-one matching along sparse candidates is as good as the best assignment."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment

from crowdmap_torch.clustering.matching import match_slots


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
