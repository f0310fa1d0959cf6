"""The place on which most votes of a group agree."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.clustering.voting import densest


def test_votes_find_the_shift_most_agree_on():
    g = torch.Generator().manual_seed(4)
    truth = torch.tensor([[1.0, -2.0, 0.5], [0.0, 0.0, -0.7]]).double()
    group = torch.tensor([0] * 40 + [1] * 25)
    good = torch.arange(65) % 3 > 0
    vote = truth[group] + 0.1 * torch.randn(65, 3, generator=g, dtype=torch.float64)
    wrong = 6 * torch.rand(65, 3, generator=g, dtype=torch.float64) - 3
    vote = torch.where(good[:, None], vote, wrong)
    one = torch.ones(65).double()
    found = densest(vote, one, 0 * one, group, groups=3, width=0.3)
    # The mean of 16 votes with 0.1 m of noise, 4 sigma.
    assert (found.vector[:2] - truth).abs().max() < 0.1
    assert (found.support[:2] > 2 * found.runner_up[:2]).all()
    assert found.support[2] == 0


def test_the_prior_decides_between_equals():
    vote = torch.tensor([[0.0], [5.0]], dtype=torch.float64)
    one, group = torch.ones(2, dtype=torch.float64), torch.zeros(2, dtype=torch.int64)
    for prior, expected in (([0.1, 0.0], 0.0), ([0.0, 0.1], 5.0)):
        found = densest(vote, one, torch.tensor(prior).double(), group, groups=1, width=0.3)
        assert float(found.vector[0, 0]) == pytest.approx(expected, abs=1e-12)
        assert found.support.tolist() == found.runner_up.tolist() == [1.0]


def test_consensus_moves_with_the_votes_and_not_with_their_order(generator: torch.Generator):
    vote = torch.randn(30, 2, generator=generator, dtype=torch.float64)
    weight = torch.rand(30, generator=generator, dtype=torch.float64)
    group = torch.arange(30) % 3
    order = torch.randperm(30, generator=generator)
    shift = torch.tensor([7.0, -3.0], dtype=torch.float64)
    found = densest(vote, weight, 0 * weight, group, groups=3, width=0.5)
    moved = densest(
        vote[order] + shift, weight[order], 0 * weight, group[order], groups=3, width=0.5
    )
    torch.testing.assert_close(moved.vector, found.vector + shift, atol=1e-12, rtol=0)
    torch.testing.assert_close(moved.support, found.support, atol=1e-12, rtol=0)
