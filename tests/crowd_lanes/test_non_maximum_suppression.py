from __future__ import annotations

from dataclasses import replace

import torch
from worlds.lines import ridges, straight

from crowdmap_torch.crowd_lanes.density_ridge import RidgePoints
from crowdmap_torch.crowd_lanes.non_maximum_suppression import local_maxima


def kept_of(points: RidgePoints, sideways: float = 0.25) -> RidgePoints:
    rows = local_maxima(points, along=1.0, sideways=sideways, beside_stronger=0.9, height_gate=2.0)
    return points[rows]


def test_one_point_a_metre_is_left() -> None:
    x = kept_of(ridges(straight([-0.1, 0.0, 0.1]))).point[:, 0].sort().values
    assert float((x[1:] - x[:-1]).min()) >= 1.0
    assert float((x[1:] - x[:-1]).max()) < 3.5


def test_the_densest_of_neighbours_is_kept_whatever_the_order(generator: torch.Generator) -> None:
    points = ridges(straight([-0.1, 0.0, 0.1]))
    points = replace(
        points, density=torch.rand(len(points), generator=generator, dtype=torch.float64) + 1
    )
    order = torch.randperm(len(points), generator=generator)
    kept, other = kept_of(points), kept_of(points[order])
    assert sorted(kept.density.tolist()) == sorted(other.density.tolist())
    assert float(points.density.max()) in kept.density.tolist()


def test_what_is_kept_suppresses_all_the_rest() -> None:
    points = ridges(straight([-0.1, 0.0, 0.1]))
    kept = kept_of(points)
    apart = (points.point[:, None, :2] - kept.point[None, :, :2]).abs()
    assert ((apart[..., 0] < 1.0) & (apart[..., 1] < 0.25)).any(1).all()


def test_a_weak_point_beside_a_strong_ridge_is_noise_unless_of_another_kind() -> None:
    two = ridges(straight([0.0]))[torch.tensor([0, 0])]
    two = replace(
        two,
        point=torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.6, 0.0]], dtype=torch.float64),
        direction=torch.tensor([[1.0, 0.0], [1.0, 0.0]], dtype=torch.float64),
        density=torch.tensor([5.0, 1.0], dtype=torch.float64),
    )
    assert len(kept_of(two)) == 1
    assert len(kept_of(replace(two, kind=torch.tensor([0, 2])))) == 2
    assert len(kept_of(replace(two, density=torch.tensor([5.0, 2.0]).double()))) == 2


def test_no_points_have_no_maxima() -> None:
    assert len(kept_of(ridges(straight([0.0]))[torch.arange(0)])) == 0
