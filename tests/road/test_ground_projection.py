from __future__ import annotations

import torch
from torch import Tensor
from worlds.road_drives import SimulatedDrives, blind_journey, poses_on_plane, simulate, true_road

from crowdmap_torch.geometry import se3
from crowdmap_torch.road.ground_projection import (
    GroundPoints,
    ground_points_camera,
    lateral_sigma,
    project_to_planes,
    project_to_surface,
)
from crowdmap_torch.simulate.vehicle import VehicleConfig
from crowdmap_torch.tables import Journey, LaneDetections, LanePoints, RoadEstimate

F64 = torch.float64
PITCH, ROLL, HEIGHT = 0.02, -0.01, 1.5


def drive_over_a_plane(ground: Tensor, frame: int, frames: int = 120) -> Journey:
    """A bending drive over z = 0 in one frame of which points of the plane [p, 2] are seen as one marker."""
    heading = 0.3 * torch.sin(torch.arange(frames, dtype=F64) / 20)
    poses = poses_on_plane(heading, 0.8, pitch=PITCH, roll=ROLL)
    journey = blind_journey(poses)
    point = se3.transform(se3.inverse(poses[frame]), torch.nn.functional.pad(ground, (0, 1)))
    ideal = point[:, :2] / point[:, 2:]
    zero = torch.zeros(1, dtype=torch.int64)
    lanes = LaneDetections(zero, zero + frame, zero, torch.ones(1, dtype=F64))
    points = LanePoints(torch.zeros(len(ideal), dtype=torch.int64), ideal, ideal)
    return Journey(**{**journey.__dict__, "lanes": lanes, "lane_points": points})


def road_of(journey: Journey) -> RoadEstimate:
    down = torch.nn.functional.normalize(torch.tensor([ROLL, 1.0, PITCH], dtype=F64), dim=-1)
    height = torch.full((journey.frame_count,), HEIGHT, dtype=F64)
    return RoadEstimate(down.expand(journey.frame_count, 3), height, height * 0 + 1e-4)


def places(journey: Journey, frame: int) -> Tensor:
    """Places on the plane, 5 to 20 m ahead of a frame of a drive and beside its way."""
    ahead = torch.tensor([5.0, 9.0, 14.0, 20.0], dtype=F64)
    aside = torch.tensor([-2.0, 1.5, 3.0, 0.0], dtype=F64)
    pose = journey.T_world_camera[frame]
    way = torch.nn.functional.normalize(pose[:2, 2], dim=0)
    right = torch.stack((way[1], -way[0]))
    return pose[:2, 3] + ahead[:, None] * way + aside[:, None] * right


def test_points_of_a_plane_are_found_by_both_projections() -> None:
    frame = 40
    empty = drive_over_a_plane(torch.zeros(0, 2, dtype=F64), frame)
    ground = places(empty, frame)
    journey = drive_over_a_plane(ground, frame)
    for project, tolerance in ((project_to_planes, 1e-9), (project_to_surface, 5e-3)):
        found = project(journey, road_of(journey))
        assert bool(found.is_on_ground.all())
        # The surface is laid by reckoning along a bending drive, and ruled: millimetres.
        expected = torch.nn.functional.pad(ground, (0, 1))
        torch.testing.assert_close(found.point_world, expected, atol=tolerance, rtol=0)
    on_road, is_met = ground_points_camera(journey, road_of(journey), journey.lane_points)
    at = se3.transform(journey.T_world_camera[frame], on_road)
    assert bool(is_met.all())
    torch.testing.assert_close(at, expected, atol=5e-3, rtol=0)


def test_points_above_the_horizon_are_not_on_the_ground() -> None:
    journey = drive_over_a_plane(torch.zeros(2, 2, dtype=F64), 40)
    up = torch.tensor([[0.0, -0.2], [0.1, 0.5]], dtype=F64)
    points = LanePoints(journey.lane_points.detection, up, up)
    journey = Journey(**{**journey.__dict__, "lane_points": points})
    for project in (project_to_planes, project_to_surface):
        found = project(journey, road_of(journey))
        assert found.is_on_ground.tolist() == [False, True]
        assert bool(found.point_world.isfinite().all())


def test_no_points_are_nowhere() -> None:
    journey = drive_over_a_plane(torch.zeros(0, 2, dtype=F64), 40)
    assert len(project_to_surface(journey, road_of(journey))) == 0
    on_road, is_met = ground_points_camera(journey, road_of(journey), journey.lane_points)
    assert on_road.shape == (0, 3) and len(is_met) == 0


def test_sigma_is_the_propagated_noise_of_pixel_and_normal() -> None:
    """On a plane, a point at depth d and offset o moves by d n / f for a pixel, by d o / h for a pitch."""
    depth, offset = torch.tensor([4.0, 16.0], dtype=F64), torch.tensor([0.0, 3.0], dtype=F64)
    zero = torch.zeros(2, 3, dtype=F64)
    points = GroundPoints(zero, depth, depth, offset, depth > 0)
    road = RoadEstimate(zero[:1], torch.tensor([HEIGHT], dtype=F64), torch.ones(1, dtype=F64))
    frame = torch.zeros(2, dtype=torch.int64)

    def sigma(**given: float) -> Tensor:
        none = {"sigma_ideal": 0.0, "normal_sigma": 0.0, "drift": 0.0}
        return lateral_sigma(points, frame, road, **{**none, **given})

    slant = (1 + (offset / HEIGHT).square()).sqrt()
    torch.testing.assert_close(sigma(sigma_ideal=1e-3), 1e-3 * depth * slant)
    torch.testing.assert_close(sigma(normal_sigma=1e-3), 1e-3 * depth * slant)
    torch.testing.assert_close(sigma(drift=0.01), 0.01 * depth.sqrt())


def test_surface_places_points_of_hills_better_than_planes(tmp_path) -> None:
    drives: SimulatedDrives = simulate(
        tmp_path / "hills", "hills", length_m=200.0, vehicle=VehicleConfig(load_deg=1.0)
    )
    truth = drives.truths[0]
    points = truth.journey.lane_points
    marker = truth.lane[truth.journey.lanes.row][points.detection]
    frame = truth.journey.lanes.frame[points.detection]
    off = {}
    for place in (project_to_planes, project_to_surface):
        ground = place(truth.journey, true_road(truth))
        near = ground.is_on_ground & (ground.depth > 10) & (ground.depth < 20) & (marker >= 0)
        at = se3.transform(truth.T_true_given[frame[near]], ground.point_world[near])
        off[place] = (at[:, 2] - _height_of(marker[near], at, drives)).abs().median()
    # The pose of the seeing frame taken off, not that of the nearest: drift stays in both.
    assert off[project_to_surface] < off[project_to_planes]
    on_road, is_met = ground_points_camera(truth.journey, true_road(truth), points)
    near = is_met & (on_road[:, 2] > 10) & (on_road[:, 2] < 20) & (marker >= 0)
    at = se3.transform(truth.T_world_camera[frame[near]], on_road[near])
    off_ahead = (at[:, 2] - _height_of(marker[near], at, drives)).abs().median()
    assert off_ahead < 0.75 * off[project_to_planes]


def _height_of(marker: Tensor, at: Tensor, drives: SimulatedDrives) -> Tensor:
    """Height of the true markers, each nearest to a place [m]."""
    lane = drives.survey.lane_points
    own = 1e6 * marker[:, None].to(at)
    place = torch.cat((lane.point_world[:, :2], 1e6 * lane.lane[:, None].to(at)), dim=1)
    nearest = torch.cdist(torch.cat((at[:, :2], own), dim=1), place).argmin(1)
    return lane.point_world[nearest, 2]
