"""Fixed points of maps that come nearer by slow steps."""

from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.optim.fixed_point import fixed_point

F64 = torch.float64


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_what_comes_nearer_by_one_share_is_there_after_one_cycle(share: float):
    there = torch.tensor([[0.3, -1.0, 2.0]], dtype=F64)
    begun = torch.zeros_like(there)
    found = fixed_point(lambda x: there + share * (x - there), begun, 1, -9.0, 9.0)
    torch.testing.assert_close(found, there)


def test_rows_have_paces_of_their_own_and_a_few_cycles_do_for_many_steps():
    paces = torch.tensor([[0.95, 0.9], [0.2, 0.5]], dtype=F64)
    there = torch.tensor([[1.0, 2.0], [-1.0, 0.5]], dtype=F64)
    calls = []

    def nearer(x: torch.Tensor) -> torch.Tensor:
        calls.append(x)
        off = x - there
        return there + paces * off + 0.02 * off.square().sin()

    plain = torch.zeros_like(there)
    for _ in range(60):
        plain = nearer(plain)
    calls.clear()
    found = fixed_point(nearer, torch.zeros_like(there), 5, -9.0, 9.0)
    assert len(calls) == 15
    assert (found - there).abs().max() < 1e-3 < 2e-2 < (plain - there).abs().max()


def test_the_map_is_asked_within_the_bounds_alone():
    bound = math.log(3)

    def outwards(x: torch.Tensor) -> torch.Tensor:
        assert x.abs().max() <= bound
        return (x + 0.2 + 0.1 * x).clamp(-bound, bound)

    start = torch.zeros(2, 3, dtype=F64)
    found = fixed_point(outwards, start, 4, -bound, bound)
    torch.testing.assert_close(found, torch.full_like(found, bound))


def test_nothing_has_no_point_to_go_to():
    none = torch.zeros(3, 0, dtype=F64)
    assert fixed_point(lambda x: x, none, 5, -1.0, 1.0).shape == (3, 0)
