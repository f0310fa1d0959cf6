"""Pairs of points that are near each other are those of all distances."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.clustering.neighbours import (
    cross_pairs,
    near_pairs,
    pairs_between,
    pairs_in_radius,
    rows_near,
)


def points(n: int = 40) -> torch.Tensor:
    g = torch.Generator().manual_seed(2)
    return torch.randn(n, 3, generator=g, dtype=torch.float64)


def test_near_pairs_are_those_within_the_radius():
    point = points()
    distance = torch.cdist(point, point)
    wanted = torch.nonzero((distance < 1.0).triu(1))
    assert torch.equal(near_pairs(point, radius=1.0, count=40), wanted)
    few = near_pairs(point, radius=10.0, count=1)
    assert len(few) < len(point)


def test_cross_pairs_are_those_within_the_radius():
    point = points()
    wanted = torch.nonzero(torch.cdist(point[:10], point[10:]) < 1.0)
    assert torch.equal(cross_pairs(point[:10], point[10:], radius=1.0, count=30), wanted)


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("radius", [0.01, 0.7, 300.0])
def test_many_points_lose_those_far_from_a_few_and_no_others(dimension: int, radius: float):
    g = torch.Generator().manual_seed(dimension)
    many = 200 * torch.rand(30_000, dimension, generator=g, dtype=torch.float64) - 100
    beside = many[40:80].clone()
    beside[:, 0] += 0.999 * radius
    few = torch.cat((many[:40], beside, 5000 + many[:9]))
    apart = torch.cdist(many, few, compute_mode="donot_use_mm_for_euclid_dist")
    rows = torch.from_numpy(rows_near(many.numpy(), few.numpy(), radius))
    near = (apart <= radius).any(1)
    assert torch.isin(near.nonzero()[:, 0], rows).all() and (rows.diff() > 0).all()
    assert int(near.sum()) >= 80 and (radius > 1 or dimension == 1 or len(rows) < len(many) / 2)
    row, column, _ = pairs_between(many, few, radius=radius)
    assert torch.equal(torch.stack((row, column), dim=1), (apart <= radius).nonzero())
    column, row, _ = pairs_between(few, many, radius=radius)
    assert torch.equal(torch.stack((column, row), dim=1), (apart.T <= radius).nonzero())


def test_pairs_between_two_sets_are_those_within_the_radius_with_their_distance(
    generator: torch.Generator,
):
    a, b = torch.rand(2, 30, 2, generator=generator, dtype=torch.float64)
    row_a, row_b, distance = pairs_between(a, b, radius=0.2)
    apart = torch.cdist(a, b)
    assert torch.equal(torch.stack((row_a, row_b), dim=1), (apart <= 0.2).nonzero())
    # cdist loses half of the digits near zero.
    assert torch.allclose(distance, apart[row_a, row_b], atol=1e-7)
    assert all(len(part) == 0 for part in pairs_between(a, b[:0], radius=1.0))


def test_pairs_in_a_radius_are_complete_and_ordered():
    point = points()
    pair = pairs_in_radius(point, 1.0)
    wanted = torch.nonzero((torch.cdist(point, point) < 1.0).triu(1))
    assert {tuple(p) for p in pair.tolist()} == {tuple(p) for p in wanted.tolist()}
    assert (pair[:, 0] < pair[:, 1]).all()
    assert len(pairs_in_radius(point[:0], 1.0)) == len(pairs_in_radius(point[:1], 1.0)) == 0


def test_no_points_are_near_none():
    point = points()
    assert len(near_pairs(point[:1], radius=9.0, count=3)) == 0
    assert len(cross_pairs(point, point[:0], radius=9.0, count=3)) == 0
