from __future__ import annotations

import torch
from worlds.lines import arc, curves_of_points, samples_of

from crowdmap_torch.crowd_lanes.extend_ends import extended, supported_rows
from crowdmap_torch.crowd_lanes.splines import match
from crowdmap_torch.tables import concatenate


def test_curves_grow_as_far_as_two_owners_saw() -> None:
    point, direction = arc(1e6, 60.0)
    ends = (52.0, 57.0, 60.0)
    samples = concatenate(
        [samples_of(point[: int(e)], direction[: int(e)], owner=k) for k, e in enumerate(ends)]
    )
    longer, of = extended(curves_of_points(point[10:45]), 20.0)
    assert (of == 0).all()
    longer = curves_of_points(longer)
    matched = match(samples, longer, gate=0.7)
    seen = supported_rows(longer, samples, matched, 2)
    x = longer.point[seen, 0]
    assert float(x.min()) < 1.5
    assert abs(float(x.max()) - 57.0) < 2.5


def test_straight_ends_go_on_in_the_direction_and_slope_of_the_curve() -> None:
    point, _ = arc(1e9, 30.0)
    longer, _ = extended(curves_of_points(point), 5.0)
    assert len(longer) == 31 + 2 * 5
    expected = torch.arange(-5.0, 35.5, 1.0, dtype=torch.float64)
    torch.testing.assert_close(longer[:, 0], expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(longer[:, 2], 0.03 * expected, atol=1e-6, rtol=0)


def test_a_ring_has_no_ends() -> None:
    angle = torch.linspace(0, 2 * torch.pi, 201, dtype=torch.float64)
    ring = 20 * torch.stack((angle.cos(), angle.sin(), 0 * angle), 1)
    curves = curves_of_points(ring)
    point, _ = extended(curves, 8.0)
    assert len(point) == len(curves.point)


def test_points_that_nobody_saw_are_not_supported() -> None:
    point, direction = arc(1e6, 40.0)
    curves = curves_of_points(point, point + 20.0)
    samples = samples_of(point, direction)
    matched = match(samples, curves, gate=0.7)
    assert torch.equal(supported_rows(curves, samples, matched, 1), curves.curve == 0)
    assert not supported_rows(curves, samples, matched, 2).any()
