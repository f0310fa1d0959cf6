from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from crowdmap_torch.simulate.rigs import RigConfig, build_rig
from crowdmap_torch.simulate.vehicle import VehicleConfig, drive_through
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, build_world

RIG = build_rig(RigConfig(), 1, np.random.default_rng(0))


def _world(name: str, **changes):
    return build_world(replace(WORLD_PRESETS[name], **changes), np.random.default_rng(2))


@pytest.mark.parametrize(("name", "direction"), [("hills", 1), ("block", 1), ("block", -1)])
def test_camera_is_its_height_above_the_road_that_it_drives_on(name: str, direction: int):
    world = _world(name, length_m=400.0)
    drive = drive_through(
        world, RIG, VehicleConfig(), np.random.default_rng(0), direction=direction
    )
    down_world = (drive.R_world_camera @ drive.road_normal_camera[..., None])[..., 0]
    foot = drive.p_world_camera + drive.camera_height[:, None] * down_world
    np.testing.assert_allclose(foot, world.road.surface(drive.station, drive.offset), atol=1e-9)
    # Around that point the surface touches the plane: 1 m to the side it is off by its twist only.
    beside = world.road.surface(drive.station, drive.offset + 1.0) - foot
    assert np.abs((beside * down_world).sum(-1)).max() < 1e-9
    ahead = world.road.surface(drive.station + 1.0, drive.offset) - foot
    assert np.abs((ahead * down_world).sum(-1)).max() < 0.02


@pytest.mark.parametrize("direction", [1, -1])
def test_camera_looks_where_the_car_goes(direction: int):
    world = _world("block", length_m=400.0)
    drive = drive_through(
        world, RIG, VehicleConfig(), np.random.default_rng(1), direction=direction
    )
    way = np.diff(drive.p_world_camera, axis=0)
    moving = np.linalg.norm(way, axis=-1) > 0.2
    way = way[moving] / np.linalg.norm(way[moving], axis=-1, keepdims=True)
    cosine = (way * drive.R_world_camera[:-1][moving][:, :, 2]).sum(-1)
    assert cosine.min() > np.cos(np.radians(6))  # mount, load, and half a frame of turning
    # Right-hand traffic: the road's middle is on the left.
    assert (np.sign(drive.offset) == -direction).all()


def test_true_pose_stands_still_at_a_light_while_frames_go_on():
    world = _world("suburb", length_m=400.0)
    config = VehicleConfig(stop_probability=1.0, stop_s=(8.0, 8.0), frame_loss=0.0)
    drive = drive_through(world, RIG, config, np.random.default_rng(0))
    stands = drive.speed == 0
    assert stands.sum() >= 8 * config.frame_rate_hz - 2
    # Once the springs are at rest, a second after the stop, nothing moves.
    first = np.flatnonzero(stands)[0] + 60
    rows = slice(first, first + 45)
    assert np.ptp(drive.p_world_camera[rows], axis=0).max() < 1e-9
    assert np.ptp(drive.R_world_camera[rows], axis=0).max() < 1e-4
    assert np.ptp(drive.distance[rows]) < 1e-9


def test_speed_and_acceleration_are_those_of_the_road_and_the_driver():
    world = _world("highway")
    config = VehicleConfig(frame_loss=0.0)
    drive = drive_through(world, RIG, config, np.random.default_rng(0))
    step = np.linalg.norm(np.diff(drive.p_world_camera, axis=0), axis=-1) * config.frame_rate_hz
    assert np.median(step) == pytest.approx(25.0, rel=0.15)
    assert np.abs(np.diff(drive.speed)).max() * config.frame_rate_hz < 1.05 * config.acceleration
    assert drive.distance[-1] == pytest.approx(world.config.length_m, rel=0.02)


def test_body_leaves_calibration_by_load_and_suspension_but_not_more_than_stated():
    world = _world("suburb", length_m=400.0)
    angles = []
    for seed in range(12):
        drive = drive_through(world, RIG, VehicleConfig(), np.random.default_rng(seed))
        cosine = drive.road_normal_camera @ RIG.road_normal_camera
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    means = np.array([a.mean() for a in angles])
    assert means.max() > 0.5 and np.ptp(means) > 0.3  # journeys differ
    assert max(a.max() for a in angles) < 2.0 and np.concatenate(angles).mean() < 1.5


def test_lost_frames_leave_gaps_in_numbers_and_times():
    world = _world("suburb", length_m=400.0)
    config = VehicleConfig(frame_loss=0.02, gap_s=2.0)
    drive = drive_through(world, RIG, config, np.random.default_rng(0))
    steps = np.diff(drive.frame)
    assert (steps >= 1).all() and steps.max() >= 30
    np.testing.assert_allclose(np.diff(drive.t), steps / config.frame_rate_hz)


def test_cars_change_lanes_and_journeys_start_at_differing_stations():
    world = _world("suburb", length_m=400.0)
    config = VehicleConfig(lane_changes_per_km=8.0)
    drives = [drive_through(world, RIG, config, np.random.default_rng(k)) for k in range(6)]
    width = abs(np.diff(world.lane_centres[1])[0])
    assert max(np.ptp(d.offset) for d in drives) > 0.9 * width
    assert np.ptp([d.station[0] for d in drives]) > 5.0
