"""Vertex costs against the plain formulas, and cyclic orders against enumeration."""

from __future__ import annotations

import itertools

import pytest
import torch

from crowdmap_torch.geometry import correspondence, polygon, se3
from crowdmap_torch.geometry.epipolar import epipolar_cost, fundamental


@pytest.fixture
def two_views(generator):
    """Poses of pairs of cameras, and points that each sees."""
    xi = 0.3 * torch.randn(2, 5, 6, dtype=torch.float64, generator=generator)
    T_a, T_b = se3.exp(xi[0]), se3.exp(xi[1])
    p = 0.4 * torch.randn(2, 5, 4, 2, dtype=torch.float64, generator=generator)
    return T_a, T_b, p[0], p[1]


@pytest.mark.parametrize("components", [2, 3])
def test_vertex_costs_are_epipolar_costs_of_all_pairs(two_views, components):
    T_a, T_b, p, q = two_views
    F = fundamental(T_a, T_b)
    expected = epipolar_cost(F[:, None, None], p[:, :, None], q[:, None, :], components=components)
    found = correspondence.vertex_costs(F, p, q, components=components)
    torch.testing.assert_close(found, expected)


def test_a_turned_camera_sees_far_points_where_the_rotation_says(two_views):
    T_a, T_b, p, _ = two_views
    R = T_a[:, :3, :3].mT @ T_b[:, :3, :3]
    ray = torch.nn.functional.pad(p, (0, 1), value=1.0) @ R
    seen_in_b = ray[..., :2] / ray[..., 2:]
    distance = correspondence.rotation_compensated(R, p, seen_in_b)
    assert float(distance.diagonal(dim1=-2, dim2=-1).abs().max()) < 1e-20


def test_points_turned_behind_the_camera_are_infinitely_far():
    half_turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0], dtype=torch.float64))[None]
    p = torch.zeros(1, 1, 2, dtype=torch.float64)
    assert torch.isinf(correspondence.rotation_compensated(half_turn, p, p)).all()


def test_cyclic_sums_are_those_of_every_shift(generator):
    cost = torch.rand(3, 5, 5, dtype=torch.float64, generator=generator)
    sums = correspondence.cyclic_sums(cost)
    for b, s in itertools.product(range(3), range(5)):
        expected = sum(float(cost[b, k, (k + s) % 5]) for k in range(5))
        assert float(sums[b, s]) == pytest.approx(expected)


@pytest.mark.parametrize("n", [3, 4, 5])
def test_the_free_assignment_is_the_cheapest_of_all(n, generator):
    cost = torch.rand(4, n, n, dtype=torch.float64, generator=generator)
    free = correspondence.free_assignment(cost)
    for b in range(4):
        best = min(
            sum(float(cost[b, k, order[k]]) for k in range(n))
            for order in itertools.permutations(range(n))
        )
        assert float(free[b]) == pytest.approx(best)
    assert bool((free <= correspondence.cyclic_sums(cost).amin(-1) + 1e-12).all())


@pytest.mark.parametrize("shape", range(len(polygon.SHAPES)))
def test_the_clearest_order_undoes_a_shift(shape):
    count = polygon.corner_count(torch.tensor([shape]))
    reference = polygon.template(torch.tensor([shape]))
    for start in range(int(count)):
        outline = polygon.roll(reference, torch.tensor([start]), count)
        shift, best, second = correspondence.clearest_order(outline, reference, count)
        assert int(shift) == (-start) % int(count)
        assert float(best) == pytest.approx(0.0)
        assert float(second) > 0.05
