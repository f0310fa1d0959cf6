"""The epipolar constraint and its cost."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.epipolar import sampson_epipolar_distance

from crowdmap_torch.geometry import epipolar, se3


@pytest.fixture
def views():
    """Two cameras, and 200 points in front of both, seen by each on the plane z = 1."""
    generator = torch.Generator().manual_seed(0)
    xi = torch.randn(2, 6, generator=generator, dtype=torch.float64)
    T_a, T_b = se3.exp(xi * torch.tensor([1.0, 1, 1, 0.1, 0.1, 0.1], dtype=torch.float64))
    p = torch.randn(200, 3, generator=generator, dtype=torch.float64) * 3
    p[:, 2] = p[:, 2].abs() + 12
    a, b = (se3.transform(se3.inverse(T), p) for T in (T_a, T_b))
    return T_a, T_b, a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:], b[:, 2]


def test_views_of_one_point_satisfy_the_constraint(views):
    T_a, T_b, p, q, _ = views
    F = epipolar.fundamental(T_a, T_b)
    # a baseline of metres and float64: pure rounding, squared
    assert epipolar.epipolar_cost(F, p, q).max() < 1e-28
    assert epipolar.epipolar_cost(F, p, q, components=3).max() < 1e-28


def test_exchanging_the_views_changes_nothing(views):
    T_a, T_b, p, q, _ = views
    q = q.roll(1, 0)
    there = epipolar.epipolar_cost(epipolar.fundamental(T_a, T_b), p, q)
    back = epipolar.epipolar_cost(epipolar.fundamental(T_b, T_a), q, p)
    torch.testing.assert_close(there, back)


def test_cost_agrees_with_kornia(views):
    T_a, T_b, p, q, _ = views
    q = q.roll(1, 0)
    F = epipolar.fundamental(T_a, T_b)
    # kornia's constraint reads x2^T F x1
    expected = sampson_epipolar_distance(q[None], p[None], F[None], eps=0.0)[0]
    torch.testing.assert_close(epipolar.epipolar_cost(F, p, q), expected)


def test_cost_with_three_components_is_the_printed_formula(views):
    T_a, T_b, p, q, _ = views
    q = q.roll(1, 0)
    F = epipolar.fundamental(T_a, T_b)
    one = torch.ones(len(p), 1, dtype=torch.float64)
    ph, qh = torch.cat((p, one), -1), torch.cat((q, one), -1)
    value = torch.einsum("ni,ij,nj->n", ph, F, qh)
    norms = (ph @ F).square().sum(-1) + (qh @ F.T).square().sum(-1)
    printed = value.square() / norms
    torch.testing.assert_close(epipolar.epipolar_cost(F, p, q, components=3), printed)
    torch.testing.assert_close(epipolar.epipolar_cost(F, ph, qh, components=3), printed)


def test_cost_is_the_squared_distance_that_closes_the_constraint(views):
    T_a, T_b, p, q, _ = views
    F = epipolar.fundamental(T_a, T_b)
    line = torch.einsum("ij,nj->ni", F, torch.nn.functional.pad(q, (0, 1), value=1.0))
    normal = torch.nn.functional.normalize(line[:, :2], dim=-1)
    cost = epipolar.epipolar_cost(F, p + 1e-4 * normal, q)
    # an error in one image alone is shared between two: at most all of it, for like cameras about
    # half
    assert (cost <= 1e-8 * (1 + 1e-6)).all()
    assert (cost > 0.2e-8).all()


def test_cost_does_not_depend_on_the_baseline_and_is_zero_without_one(views):
    T_a, T_b, p, q, _ = views
    q = q.roll(1, 0)
    F = epipolar.fundamental(T_a, T_b)
    cost = epipolar.epipolar_cost(F, p, q)
    torch.testing.assert_close(epipolar.epipolar_cost(1e-6 * F, p, q), cost)
    still = epipolar.fundamental(T_a, T_a)
    assert torch.equal(epipolar.epipolar_cost(still * 0, p, q), torch.zeros_like(cost))
