"""The point nearest to many rays."""

from __future__ import annotations

import math

import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.triangulation import midpoint_ragged


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def midpoint(origin: torch.Tensor, ray: torch.Tensor, weight: torch.Tensor | None = None):
    """The point nearest to the rays of each row of a batch."""
    points = math.prod(origin.shape[:-2])
    group = torch.arange(points).repeat_interleave(origin.shape[-2])
    weight = None if weight is None else weight.flatten()
    point, _ = midpoint_ragged(origin.reshape(-1, 3), ray.reshape(-1, 3), group, points, weight)
    return point.reshape(*origin.shape[:-2], 3)


def rays_to(point: torch.Tensor, count: int, generator: torch.Generator):
    shape = (*point.shape[:-1], count, 3)
    origin = point[..., None, :] + 20 * torch.randn(shape, generator=generator, dtype=point.dtype)
    length = 0.1 + torch.rand((*shape[:-1], 1), generator=generator, dtype=point.dtype)
    return origin, (point[..., None, :] - origin) * length


def test_rays_through_a_point_give_that_point_kilometres_from_the_origin(generator):
    point = 5000 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    origin, ray = rays_to(point, 6, generator)
    # 1e-12 of the coordinates, times the condition of random rays
    torch.testing.assert_close(midpoint(origin, ray), point, atol=1e-8, rtol=0)


def test_midpoint_minimises_the_sum_of_squared_distances(generator):
    point = torch.randn(3, generator=generator, dtype=torch.float64)
    origin, ray = rays_to(point, 5, generator)
    ray = ray + torch.randn(5, 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(5, generator=generator, dtype=torch.float64)

    def cost(x: torch.Tensor) -> torch.Tensor:
        direction = torch.nn.functional.normalize(ray, dim=-1)
        return (weight * torch.linalg.cross(x - origin, direction).square().sum(-1)).sum()

    gradient = torch.func.grad(cost)(midpoint(origin, ray, weight))
    assert gradient.abs().max() < 1e-9


def test_two_skew_lines_meet_in_the_middle_of_their_common_perpendicular():
    origin = torch.tensor([[0.0, 0, 0], [5.0, 7.0, 2.0]], dtype=torch.float64)
    ray = torch.tensor([[3.0, 0, 0], [0, -2.0, 0]], dtype=torch.float64)
    expected = torch.tensor([5.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(midpoint(origin, ray), expected)


def test_midpoint_moves_with_the_world(generator):
    point = torch.randn(7, 3, generator=generator, dtype=torch.float64)
    origin, ray = rays_to(point, 5, generator)
    ray = ray + torch.randn(7, 5, 3, generator=generator, dtype=torch.float64)
    T = se3.exp(torch.tensor([3.0, -2, 5, 0.4, -0.8, 1.5], dtype=torch.float64))
    moved = midpoint(se3.transform(T, origin), se3.rotate(T, ray))
    torch.testing.assert_close(moved, se3.transform(T, midpoint(origin, ray)))


def test_ragged_groups_are_the_same_as_one_by_one(generator):
    sizes = torch.tensor([2, 5, 0, 9, 3])
    group = torch.repeat_interleave(torch.arange(5), sizes)
    group = group[torch.randperm(len(group), generator=generator)]
    origin, ray = torch.randn(2, len(group), 3, generator=generator, dtype=torch.float64)
    weight = torch.rand(len(group), generator=generator, dtype=torch.float64)
    point, smallest = midpoint_ragged(origin, ray, group, 5, weight)
    for g in (0, 1, 3, 4):
        mine = group == g
        alone = midpoint(origin[mine], ray[mine], weight[mine])
        torch.testing.assert_close(point[g], alone, atol=1e-9, rtol=1e-9)
    assert smallest[2] == 0
    assert point.isfinite().all()


def test_rays_of_weight_zero_are_padding(generator):
    point = torch.randn(1, 3, generator=generator, dtype=torch.float64)
    origin, ray = rays_to(point, 4, generator)
    padded_origin = torch.cat((origin, torch.full((1, 2, 3), 99.0, dtype=torch.float64)), dim=1)
    padded_ray = torch.cat((ray, torch.zeros(1, 2, 3, dtype=torch.float64)), dim=1)
    weight = torch.tensor([[1.0, 1, 1, 1, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(
        midpoint(padded_origin, padded_ray, weight), midpoint(origin, ray), atol=1e-9, rtol=0
    )


@pytest.mark.parametrize("degrees", [0.5, 5.0, 90.0])
def test_smallest_eigenvalue_is_the_parallax(degrees):
    a = math.radians(degrees)
    ray = torch.tensor([[1.0, 0, 0], [math.cos(a), math.sin(a), 0]], dtype=torch.float64)
    group = torch.zeros(2, dtype=torch.long)
    _, smallest = midpoint_ragged(torch.zeros_like(ray), ray, group, 1)
    assert smallest.item() == pytest.approx(math.sin(a / 2) ** 2, abs=1e-12)


def test_parallel_rays_give_a_finite_point_and_no_parallax():
    origin = torch.tensor([[0.0, 0, 0], [0.0, 2.0, 0]], dtype=torch.float64)
    ray = torch.tensor([[1.0, 0, 0], [2.0, 0, 0]], dtype=torch.float64)
    point, smallest = midpoint_ragged(origin, ray, torch.zeros(2, dtype=torch.long), 1)
    torch.testing.assert_close(point[0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    assert smallest.item() == pytest.approx(0, abs=1e-15)
