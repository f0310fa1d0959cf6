from __future__ import annotations

from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import plane, polygon, se3
from crowdmap_torch.geometry.camera import project, unproject
from crowdmap_torch.simulate.dataset import (
    SimulatedJourney,
    SimulationConfig,
    make_fleet,
    make_journey,
    make_world,
)
from crowdmap_torch.simulate.fleet import NO_ERRORS, FleetConfig, VehicleErrors
from crowdmap_torch.simulate.lane_perception import detect_lanes
from crowdmap_torch.simulate.positioning import PositioningConfig
from crowdmap_torch.simulate.rigs import RigConfig
from crowdmap_torch.simulate.sign_detections import DAY as DAY_SIGNS
from crowdmap_torch.simulate.vehicle import VehicleConfig, drive_through
from crowdmap_torch.simulate.worlds import WORLD_PRESETS

EXACT_SIGNS = replace(
    DAY_SIGNS,
    pixel_noise_px=0.0,
    outliers=0.0,
    wrong_shape=0.0,
    ghosts_per_frame=0.0,
    ghost_runs_per_frame=0.0,
    vehicle_signs_per_frame=0.0,
)
EXACT_POSES: PositioningConfig = replace(
    PositioningConfig(),
    **{
        f.name: 0.0
        for f in fields(PositioningConfig)
        if f.name in ("drift_m", "drift_rot_deg")
        or (f.name.startswith(("bias", "white")) and "length" not in f.name)
    },
)
SIZES: dict[str, Any] = {
    "mount_error_deg": 0.2,
    "mount_error_m": 0.02,
    "focal_error": 0.002,
    "principal_error_px": 1.5,
    "height_error_m": 0.03,
    "clock_error_s": 0.015,
    "read_out_s": 0.02,
    "box_error": 0.01,
    "box_error_mean": 0.01,
    "corner_error_px": 0.5,
    "lane_error_m": 0.03,
}
SMALL = SimulationConfig(
    world=replace(WORLD_PRESETS["street"], length_m=120.0),
    rig=RigConfig(camera="pinhole"),
    positioning=EXACT_POSES,
    signs=EXACT_SIGNS,
    lanes=replace(SimulationConfig().lanes, max_lanes=0),
    seed=6,
)


def journey_with(index: int = 1, **sizes: Any) -> tuple[SimulatedJourney, VehicleErrors]:
    """The journey of a vehicle with a mount, and the errors of the vehicle."""
    config = replace(SMALL, fleet=FleetConfig(**sizes))
    made = make_journey(config, make_world(config), make_fleet(config), index)
    return made, made.vehicle.errors


def corners_camera(journey: SimulatedJourney, T_world_camera: np.ndarray) -> torch.Tensor:
    """The true corners of each detection in the camera's frame, in the order of the sign."""
    world = make_world(SMALL)
    rows = journey.signs
    corners = torch.from_numpy(world.signs.corners()[rows.sign])
    T = se3.inverse(torch.from_numpy(T_world_camera[rows.frame]))
    return se3.transform(T[:, None], corners)


def detected(journey: SimulatedJourney, like: torch.Tensor) -> torch.Tensor:
    """Detected corners in the order of those that they are like."""
    shape = torch.from_numpy(journey.signs.shape)
    found, count = torch.from_numpy(journey.signs.corners_px), polygon.corner_count(shape)
    shift, _ = polygon.best_shift(like, found, count)
    return polygon.roll(found, shift, count)


def against_stated(journey: SimulatedJourney) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners in the stated camera, where it would see them, and detected minus that [px]; of real corners only."""
    rig = journey.vehicle.rig
    p = corners_camera(journey, journey.T_reported @ rig.T_link_camera)
    px, _ = project(rig.camera, p)
    mask = polygon.corner_mask(torch.from_numpy(journey.signs.shape))
    error = detected(journey, px) - px
    return p[mask].numpy(), px[mask].numpy(), error[mask].numpy()


def test_a_fleet_without_errors_sees_what_its_rigs_state():
    journey, errors = journey_with()
    assert errors == NO_ERRORS
    _, _, error = against_stated(journey)
    assert np.abs(error).max() < 1e-6


@pytest.mark.parametrize("index", [0, 1])
def test_the_truth_through_the_true_calibration_is_what_was_detected(index: int):
    """With and without a mount file; shutter and detector apart, which have tests of their own."""
    own = ("read_out_s", "box_error", "box_error_mean", "corner_error_px")
    journey, _ = journey_with(index, **{k: v for k, v in SIZES.items() if k not in own})
    stated, true = journey.vehicle.rig, journey.vehicle.true_rig
    p = corners_camera(journey, journey.T_world_link @ stated.T_link_camera)
    px, _ = project(true.camera, p)
    assert (detected(journey, px) - px).abs().max() < 1e-6
    assert np.abs(against_stated(journey)[2]).max() > 1.0


def test_a_turned_mount_moves_pixels_by_the_turn():
    journey, errors = journey_with(mount_error_deg=0.2)
    p, _, error = against_stated(journey)
    w = np.radians(errors.mount_rotation_deg)
    moved = -np.cross(w, p)
    focal = float(journey.vehicle.rig.camera.K[0, 0])
    expected = focal * (moved[:, :2] - p[:, :2] / p[:, 2:] * moved[:, 2:]) / p[:, 2:]
    # What is left is of second order: 8 px times the turn of 6 mrad.
    assert np.abs(expected).max() > 2.0
    assert np.abs(error - expected).max() < 0.05


def test_a_shifted_mount_moves_points_by_the_shift():
    journey, errors = journey_with(mount_error_m=0.02)
    p, px, error = against_stated(journey)
    shifted, _ = project(
        journey.vehicle.rig.camera, torch.from_numpy(p - np.array(errors.mount_place_m))
    )
    assert np.abs(error - (shifted.numpy() - px)).max() < 1e-6
    assert np.abs(error).max() > 0.3


def test_focal_length_and_principal_point_are_off_as_drawn():
    journey, errors = journey_with(focal_error=0.002, principal_error_px=1.5)
    _, px, error = against_stated(journey)
    centre = journey.vehicle.rig.camera.K[:2, 2].numpy()
    expected = errors.focal_share * (px - centre) + np.array(errors.principal_point_px)
    assert np.abs(error - expected).max() < 1e-6


def test_a_higher_camera_is_higher_above_the_road_and_nothing_else():
    flat, errors = journey_with(0)[0], journey_with(0, height_error_m=0.03)[1]
    higher, _ = journey_with(0, height_error_m=0.03)
    rise = higher.drive.camera_height - flat.drive.camera_height
    assert np.abs(rise - errors.camera_height_m).max() < 1e-12
    up = higher.drive.p_world_camera - flat.drive.p_world_camera
    assert np.abs(np.linalg.norm(up, axis=-1) - abs(errors.camera_height_m)).max() < 1e-12
    # Its poses say so: on the vehicle it is where it is stated.
    assert np.abs(against_stated(higher)[2]).max() < 1e-6


def test_a_late_picture_is_taken_where_the_car_is_by_then():
    journey, errors = journey_with(clock_error_s=0.015)
    true, reported = journey.T_world_link[:, :3, 3], journey.T_reported[:, :3, 3]
    velocity = np.gradient(true, journey.drive.t, axis=0)
    moves = journey.drive.speed > 3.0
    late = ((true - reported) * velocity).sum(-1)[moves] / (velocity**2).sum(-1)[moves]
    # Central differences over 0.13 s know the velocity of a body that shakes to some per cent.
    assert np.abs(late - errors.clock_s).max() < 0.1 * abs(errors.clock_s)
    assert np.abs(np.median(late) - errors.clock_s) < 0.01 * abs(errors.clock_s)


def test_boxes_are_too_large_about_the_mean_of_their_corners():
    right, (wrong, errors) = (
        journey_with()[0],
        journey_with(box_error=0.01, box_error_mean=0.01, corner_error_px=0.5),
    )
    assert np.array_equal(right.signs.frame, wrong.signs.frame)
    count = polygon.CORNER_COUNT.numpy()[right.signs.shape]
    for shape_count in np.unique(count):
        before = right.signs.corners_px[count == shape_count][:, :shape_count]
        after = wrong.signs.corners_px[count == shape_count][:, :shape_count]
        middle = before.mean(1, keepdims=True)
        expected = middle + (1 + errors.box_share) * (before - middle) + np.array(errors.corner_px)
        assert np.abs(after - expected).max() < 1e-9
    assert abs(errors.box_share) > 1e-3


@pytest.mark.parametrize("direction", [1, -1])
def test_lane_points_lie_to_the_drivers_left(direction: int):
    config = replace(SMALL, world=replace(WORLD_PRESETS["motorway"], length_m=120.0, lanes_back=2))
    world, rig = make_world(config), make_fleet(config)[0].rig
    drive = drive_through(
        world, rig, VehicleConfig(), np.random.default_rng(1), direction=direction
    )
    exact = replace(
        SimulationConfig().lanes,
        lane_noise_px=0.0,
        lane_point_outliers=0.0,
        false_lanes=0.0,
        merged_lanes=0.0,
    )
    off = {}
    for left in (0.0, 0.03):
        rows = detect_lanes(
            world,
            drive,
            rig.camera,
            exact,
            np.random.default_rng(2),
            frame_rate_hz=15.0,
            errors=VehicleErrors(lane_left_m=left),
        )
        frame, marker = np.repeat(rows.frame, rows.count), np.repeat(rows.marker, rows.count)
        ideal, _ = unproject(rig.camera, torch.from_numpy(rows.px))
        ray = torch.cat((ideal, torch.ones_like(ideal[:, :1])), dim=-1)
        h = torch.from_numpy(drive.road_normal_camera * drive.camera_height[:, None])[frame]
        T = torch.eye(4, dtype=torch.float64).repeat(len(frame), 1, 1)
        T[:, :3, :3] = torch.from_numpy(drive.R_world_camera[frame])
        T[:, :3, 3] = torch.from_numpy(drive.p_world_camera[frame])
        point = plane.ground_points(ray, h, T).numpy()
        begin = world.markers.point[world.markers.start[marker]]
        leftwards = world.road.leftwards(np.zeros(1))[0] * direction
        off[left] = (point - begin) @ leftwards
    # The road is a plane and straight: what is left is rounding.
    assert np.abs(off[0.0]).max() < 1e-6
    assert np.abs(off[0.03] - 0.03).max() < 1e-6


def test_a_vehicle_has_the_same_errors_in_all_its_drives_and_all_fleets():
    config = replace(SMALL, fleet=FleetConfig(vehicles=3, **SIZES), journeys=6)
    world, fleet = make_world(config), make_fleet(config)
    journeys = [make_journey(config, world, fleet, k) for k in (0, 3)]
    assert journeys[0].vehicle == journeys[1].vehicle
    larger = make_fleet(replace(config, fleet=replace(config.fleet, vehicles=5)))
    assert [v.errors for v in larger[:3]] == [v.errors for v in fleet]
    assert [v.vehicle_id for v in larger] == [f"vehicle-{c}" for c in "abcde"]
    assert [v.rig.rig_id for v in larger] == ["rig-a", "rig-b", "rig-a", "rig-b", "rig-a"]
    assert len({v.errors for v in larger}) == 5


@pytest.mark.parametrize("name", SIZES)
def test_each_error_grows_with_its_size_and_leaves_the_others_alone(name: str):
    alone, twice, none = (
        make_fleet(replace(SMALL, fleet=FleetConfig(**sizes)))[0].errors
        for sizes in ({name: SIZES[name]}, {name: 2 * SIZES[name]}, {})
    )
    every = make_fleet(replace(SMALL, fleet=FleetConfig(**SIZES)))[0].errors
    changed = [
        f for f, value in asdict(alone).items() if not np.array_equal(value, getattr(none, f))
    ]
    assert len(changed) == 1
    once, double = (np.array(getattr(e, changed[0])) for e in (alone, twice))
    np.testing.assert_allclose(double, 2 * once)
    if not name.startswith("box"):
        assert getattr(every, changed[0]) == getattr(alone, changed[0])


def test_errors_are_spread_as_asked_for():
    fleet = make_fleet(replace(SMALL, fleet=FleetConfig(vehicles=400, **SIZES)))
    drawn = [v.errors for v in fleet]
    for field, sigma in (
        ("mount_rotation_deg", 0.2),
        ("focal_share", 0.002),
        ("principal_point_px", 1.5),
        ("camera_height_m", 0.03),
        ("clock_s", 0.015),
        ("lane_left_m", 0.03),
    ):
        values = np.array([getattr(e, field) for e in drawn]).ravel()
        # 400 draws at least: 3.5 % 1-sigma of a standard deviation.
        assert values.std() == pytest.approx(sigma, rel=0.12)
        assert abs(values.mean()) < 0.2 * sigma
    assert np.mean([e.box_share for e in drawn]) == pytest.approx(0.01, rel=0.2)
    read_out = np.array([e.read_out_s for e in drawn])
    assert read_out.min() >= 0.016 and read_out.max() <= 0.024


def test_vehicles_of_one_rig_can_have_one_detector():
    config = replace(SMALL, fleet=FleetConfig(vehicles=4, one_detector=True, **SIZES))
    fleet = [v.errors for v in make_fleet(config)]
    for field in ("box_share", "corner_px", "lane_left_m"):
        assert getattr(fleet[0], field) == getattr(fleet[2], field) != getattr(fleet[1], field)
    assert fleet[0].clock_s != fleet[2].clock_s


def test_every_vehicle_drives_both_ways_where_the_world_does():
    config = replace(
        SMALL,
        world=replace(WORLD_PRESETS["block"], length_m=300.0),
        vehicle=VehicleConfig(frame_rate_hz=2.0),
        fleet=FleetConfig(vehicles=3),
    )
    world, fleet = make_world(config), make_fleet(config)
    journeys = [make_journey(config, world, fleet, k) for k in range(6)]
    ways = {(j.vehicle.vehicle_id, j.drive.direction) for j in journeys}
    assert ways == {(f"vehicle-{c}", d) for c in "abc" for d in (1, -1)}
