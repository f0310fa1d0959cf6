from __future__ import annotations

import torch
from road_drives import SimulatedDrives, blind_journey, poses_on_plane, simulate, true_road
from torch import Tensor

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.plane import ground_points
from crowdmap_torch.road.level import (
    level_of,
    normal_camera,
    road_frame,
    slopes_of_normal,
)
from crowdmap_torch.road.placing import place_on_planes, place_on_surface, points_ahead
from crowdmap_torch.road.reckoning import fit_slip
from crowdmap_torch.road.surface import lay_surface, meet
from crowdmap_torch.simulate.vehicle import VehicleConfig

F64 = torch.float64


def test_slopes_and_normals_are_inverse(generator: torch.Generator) -> None:
    journey = blind_journey(poses_on_plane(torch.zeros(3, dtype=F64), 1.0), normal=(0.1, 1.0, 0.05))
    R = road_frame(journey.rig)
    alpha, beta = 0.05 * torch.randn(2, 20, dtype=F64, generator=generator)
    torch.testing.assert_close(slopes_of_normal(normal_camera(alpha, beta, R), R), (alpha, beta))
    torch.testing.assert_close(R @ R.T, torch.eye(3, dtype=F64))
    torch.testing.assert_close(R[1], journey.rig.road_normal_camera)


def test_level_is_the_tilt_on_a_level_road() -> None:
    heading = torch.linspace(0, 2, 50, dtype=F64)
    level = level_of(blind_journey(poses_on_plane(heading, 0.8, pitch=0.02, roll=-0.01)))
    torch.testing.assert_close(level.alpha, torch.full_like(heading, 0.02))
    torch.testing.assert_close(level.beta, torch.full_like(heading, -0.01))
    torch.testing.assert_close(level.turn[1:], -heading.diff())


def test_rays_meet_a_plane_where_the_plane_is(generator: torch.Generator) -> None:
    heading = 0.3 * torch.sin(torch.arange(150, dtype=F64) / 20)
    poses = poses_on_plane(heading, 0.8, pitch=0.02, roll=0.01)
    level = level_of(blind_journey(poses))
    tilt = torch.ones(150, dtype=F64)
    surface = lay_surface(level, 0.02 * tilt, 0.01 * tilt, 1.5 * tilt)
    frame = torch.arange(0, 100, 2)
    ray = torch.rand(50, 3, dtype=F64, generator=generator) * 0.3
    ray = ray - torch.tensor([0.15, -0.1, -1.0], dtype=F64)
    down = torch.nn.functional.normalize(torch.tensor([0.01, 1.0, 0.02], dtype=F64), dim=-1)
    expected = ground_points(ray, 1.5 * down.expand(50, 3), poses[frame])
    found = meet(surface, se3.rotate(poses[frame], ray), frame, torch.full((50,), 10.0, dtype=F64))
    assert bool(found.is_met.all())
    # Measured positions are exact here, so the reckoned world differs by a constant shift.
    shift = surface.shift[frame]
    torch.testing.assert_close(found.point + shift, expected, atol=2e-3, rtol=0)


def test_rays_above_the_horizon_meet_nothing() -> None:
    poses = poses_on_plane(torch.zeros(50, dtype=F64), 0.8)
    level = level_of(blind_journey(poses))
    zero = torch.zeros(50, dtype=F64)
    surface = lay_surface(level, zero, zero, zero + 1.5)
    ray = torch.tensor([[0.0, -0.1, 1.0], [0.0, 0.0, 1.0], [0.0, 0.1, -1.0]], dtype=F64)
    frame = torch.tensor([3, 4, 5])
    found = meet(surface, se3.rotate(poses[frame], ray), frame, torch.ones(3, dtype=F64))
    assert not bool(found.is_met.any())
    assert bool(found.point.isfinite().all())


def test_slip_and_lever_of_a_camera_ahead_of_the_axle() -> None:
    heading = 0.8 * torch.sin(torch.arange(800, dtype=F64) * 0.8 / 25)
    poses = poses_on_plane(heading, 0.8)
    # The camera sits 1.3 m ahead of what rolls along its heading, and squints by one degree.
    mount = torch.tensor([0.0, 0.0, 1.3], dtype=F64)
    ahead = se3.make(torch.eye(3, dtype=F64), mount)
    squint = se3.make(se3.so3_exp(torch.tensor([0.0, 0.0175, 0.0], dtype=F64)), mount * 0)
    level = level_of(blind_journey(poses @ ahead @ squint))
    slip = fit_slip(level, level.alpha * 0)
    # The prior (0.03 rad, 2 m) and the drift that is expected of positions pull a little.
    assert abs(slip.angle - 0.0175) < 1e-3
    assert abs(slip.lever - 1.3) < 0.15


def test_surface_places_points_of_hills_better_than_planes(tmp_path) -> None:
    drives: SimulatedDrives = simulate(
        tmp_path / "hills", "hills", length_m=200.0, vehicle=VehicleConfig(load_deg=1.0)
    )
    truth = drives.truths[0]
    points = truth.journey.lane_points
    marker = truth.lane[truth.journey.lanes.row][points.detection]
    frame = truth.journey.lanes.frame[points.detection]
    off = {}
    for place in (place_on_planes, place_on_surface):
        placed = place(truth.journey, true_road(truth))
        near = placed.is_placed & (placed.depth > 10) & (placed.depth < 20) & (marker >= 0)
        at = se3.transform(truth.T_true_given[frame[near]], placed.point_world[near])
        off[place] = (at[:, 2] - _height_of(marker[near], at, drives)).abs().median()
    # The pose of the seeing frame taken off, not that of the nearest: drift stays in both.
    assert off[place_on_surface] < off[place_on_planes]
    on_road, is_met = points_ahead(truth.journey, true_road(truth), points)
    near = is_met & (on_road[:, 2] > 10) & (on_road[:, 2] < 20) & (marker >= 0)
    at = se3.transform(truth.T_world_camera[frame[near]], on_road[near])
    off_ahead = (at[:, 2] - _height_of(marker[near], at, drives)).abs().median()
    assert off_ahead < 0.75 * off[place_on_planes]


def _height_of(marker: Tensor, at: Tensor, drives: SimulatedDrives) -> Tensor:
    """Height of the true markers, each nearest to a place [m]."""
    lane = drives.survey.lane_points
    own = 1e6 * marker[:, None].to(at)
    place = torch.cat((lane.point_world[:, :2], 1e6 * lane.lane[:, None].to(at)), dim=1)
    nearest = torch.cdist(torch.cat((at[:, :2], own), dim=1), place).argmin(1)
    return lane.point_world[nearest, 2]
