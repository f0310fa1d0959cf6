from __future__ import annotations

import torch
from worlds.road_drives import blind_journey, poses_on_plane

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.plane import ground_points
from crowdmap_torch.road.ego_motion import motion_of
from crowdmap_torch.road.surface import flattened_rays, intersect, lay_surface
from crowdmap_torch.road.vanishing_point import LaneRays

F64 = torch.float64


def test_rays_meet_a_plane_where_the_plane_is(generator: torch.Generator) -> None:
    heading = 0.3 * torch.sin(torch.arange(150, dtype=F64) / 20)
    poses = poses_on_plane(heading, 0.8, pitch=0.02, roll=0.01)
    motion = motion_of(blind_journey(poses))
    tilt = torch.ones(150, dtype=F64)
    surface = lay_surface(motion, 0.02 * tilt, 0.01 * tilt, 1.5 * tilt)
    frame = torch.arange(0, 100, 2)
    ray = torch.rand(50, 3, dtype=F64, generator=generator) * 0.3
    ray = ray - torch.tensor([0.15, -0.1, -1.0], dtype=F64)
    down = torch.nn.functional.normalize(torch.tensor([0.01, 1.0, 0.02], dtype=F64), dim=-1)
    expected = ground_points(ray, 1.5 * down.expand(50, 3), poses[frame])
    found = intersect(
        surface, se3.rotate(poses[frame], ray), frame, torch.full((50,), 10.0, dtype=F64)
    )
    assert bool(found.is_met.all())
    # Measured positions are exact here, so the reckoned world differs by a constant shift.
    shift = surface.shift[frame]
    torch.testing.assert_close(found.point + shift, expected, atol=2e-3, rtol=0)


def test_rays_above_the_horizon_meet_nothing() -> None:
    poses = poses_on_plane(torch.zeros(50, dtype=F64), 0.8)
    motion = motion_of(blind_journey(poses))
    zero = torch.zeros(50, dtype=F64)
    surface = lay_surface(motion, zero, zero, zero + 1.5)
    ray = torch.tensor([[0.0, -0.1, 1.0], [0.0, 0.0, 1.0], [0.0, 0.1, -1.0]], dtype=F64)
    frame = torch.tensor([3, 4, 5])
    found = intersect(surface, se3.rotate(poses[frame], ray), frame, torch.ones(3, dtype=F64))
    assert not bool(found.is_met.any())
    assert bool(found.point.isfinite().all())


def test_places_on_the_way_are_interpolated_and_go_straight_on_beyond() -> None:
    motion = motion_of(blind_journey(poses_on_plane(torch.zeros(50, dtype=F64), 0.8)))
    zero = torch.zeros(50, dtype=F64)
    surface = lay_surface(motion, zero, zero, zero + 1.5)
    station = torch.tensor([-50.0, 10.3, 39.2, 100.0], dtype=F64)
    place, heading, cross = surface.at(station)
    torch.testing.assert_close(place[0] - surface.at(station[:1] * 0)[0][0, 0], station)
    assert float(place[1:].abs().max()) < 1e-9
    assert float(heading.abs().max()) < 1e-9 and float(cross.abs().max()) < 1e-9


def test_a_flat_straight_road_is_flattened_to_itself() -> None:
    motion = motion_of(blind_journey(poses_on_plane(torch.zeros(80, dtype=F64), 0.8)))
    zero = torch.zeros(80, dtype=F64)
    surface = lay_surface(motion, zero, zero, zero + 1.5)
    y = torch.tensor([0.3, 0.1, 0.06, -0.05], dtype=F64)
    x = torch.tensor([-0.2, 0.1, 0.0, 0.1], dtype=F64)
    rays = LaneRays(torch.tensor([0, 0, 1, 1]), torch.tensor([5, 9]), 80, x, y)
    flat = flattened_rays(surface, motion, rays, zero, zero, zero + 1.5)
    torch.testing.assert_close(flat.x[:3], x[:3], atol=1e-6, rtol=0)
    torch.testing.assert_close(flat.y[:3], y[:3], atol=1e-6, rtol=0)
    # Above the horizon: put where no point of a road is.
    assert float(flat.y[3]) == -1.0
