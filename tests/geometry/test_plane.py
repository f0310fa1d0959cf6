"""Planes: fits, flatness, intersections."""

from __future__ import annotations

import pytest
import torch

from crowdmap_torch.geometry import plane, se3


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_plane_of_flat_points_is_exact_and_flat(generator):
    flat = torch.randn(20, 9, 3, generator=generator, dtype=torch.float64)
    flat[..., 2] = 0
    xi = torch.randn(20, 6, generator=generator, dtype=torch.float64)
    T = se3.exp(xi)
    centroid, normal, smallest = plane.fit_plane(se3.transform(T[:, None], flat))
    torch.testing.assert_close(centroid, se3.transform(T, flat.mean(-2)))
    torch.testing.assert_close((normal * T[:, :3, 2]).sum(-1).abs(), torch.ones(20).double())
    assert smallest.max() < 1e-12


def test_smallest_singular_value_is_the_sum_of_squared_distances(generator):
    points = torch.randn(5, 30, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(5, 30, generator=generator, dtype=torch.float64)
    centroid, normal, smallest = plane.fit_plane(points, weight)
    distance = ((points - centroid[:, None]) * normal[:, None]).sum(-1)
    torch.testing.assert_close((weight * distance.square()).sum(-1), smallest)
    _, S = plane.scatter(points, weight)
    torch.testing.assert_close(plane.smallest_singular_value(S), smallest)
    torch.testing.assert_close(torch.linalg.svdvals(S)[:, -1], smallest)


def test_harmonic_mean_is_that_of_the_singular_values(generator):
    points = torch.randn(5, 30, 3, generator=generator, dtype=torch.float64)
    _, S = plane.scatter(points)
    expected = 3 / (1 / torch.linalg.svdvals(S)).sum(-1)
    torch.testing.assert_close(plane.harmonic_mean_singular_value(S), expected)
    assert plane.harmonic_mean_singular_value(torch.zeros(3, 3)).item() == 0


def test_ground_points_lie_on_the_road_plane(generator):
    T_world_camera = se3.exp(torch.randn(6, generator=generator, dtype=torch.float64))
    h = torch.tensor([0.02, 1.45, 0.03], dtype=torch.float64)
    ray = torch.rand(40, 3, generator=generator, dtype=torch.float64) + 0.1
    p_world = plane.ground_points(ray, h, T_world_camera)
    p_camera = se3.transform(se3.inverse(T_world_camera), p_world)
    foot_to_point = p_camera - h
    assert (foot_to_point @ h).abs().max() < 1e-9
    torch.testing.assert_close(
        torch.nn.functional.normalize(p_camera, dim=-1), torch.nn.functional.normalize(ray, dim=-1)
    )
