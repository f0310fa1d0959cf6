"""Figures of groups of rows agree with a loop over the groups; pairs and votes are found."""

from __future__ import annotations

import torch

from crowdmap_torch.clustering.groups import (
    group_median,
    group_mode,
    group_sum,
    pairs_within,
)
from crowdmap_torch.clustering.neighbours import cross_pairs, near_pairs
from crowdmap_torch.clustering.voting import densest


def rows(n: int = 40, groups: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(2)
    label = torch.randint(-1, groups, (n,), generator=g)
    label[label == 4] = 3  # an empty group
    return torch.randn(n, 3, generator=g, dtype=torch.float64), label


def test_sums_and_medians_agree_with_a_loop():
    value, label = rows()
    total, middle = group_sum(value, label, 6), group_median(value, label, 6)
    for c in range(6):
        own = value[label == c]
        assert torch.allclose(total[c], own.sum(0), atol=1e-12)  # order of a sum of 10 numbers
        if len(own):
            assert torch.allclose(middle[c], own.quantile(0.5, dim=0), atol=1e-12)
        else:
            assert middle[c].isnan().all()


def test_mode_has_the_most_weight_and_ignores_unknown():
    code = torch.tensor([2, 2, 5, -1, 1, 0])
    weight = torch.tensor([1.0, 1.0, 3.0, 9.0, 1.0, 1.0])
    label = torch.tensor([0, 0, 0, 1, 2, 2])
    assert group_mode(code, weight, label, 4).tolist() == [5, -1, 0, -1]


def test_pairs_within_groups_are_complete():
    _, label = rows()
    found = {tuple(sorted(p)) for p in pairs_within(label).tolist()}
    wanted = {
        (i, j)
        for i in range(len(label))
        for j in range(i + 1, len(label))
        if label[i] == label[j] >= 0
    }
    assert found == wanted


def test_near_pairs_are_those_within_the_radius():
    point, _ = rows()
    distance = torch.cdist(point, point)
    wanted = torch.nonzero((distance < 1.0).triu(1))
    assert torch.equal(near_pairs(point, radius=1.0, count=40), wanted)
    few = near_pairs(point, radius=10.0, count=1)
    assert len(few) < len(point)


def test_cross_pairs_are_those_within_the_radius():
    point, _ = rows()
    wanted = torch.nonzero(torch.cdist(point[:10], point[10:]) < 1.0)
    assert torch.equal(cross_pairs(point[:10], point[10:], radius=1.0, count=30), wanted)


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
