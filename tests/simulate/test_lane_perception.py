from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry.camera import project
from crowdmap_torch.simulate.lane_perception import DAY, detect_lanes
from crowdmap_torch.simulate.rigs import RigConfig, build_rig
from crowdmap_torch.simulate.vehicle import VehicleConfig, drive_through
from crowdmap_torch.simulate.worlds import WORLD_PRESETS, build_world

PERFECT = replace(
    DAY,
    lane_noise_px=0.0,
    missed_lanes=0.0,
    lane_occlusions_per_km=0.0,
    lane_point_outliers=0.0,
    wrong_lane_type=0.0,
    null_lane_type=0.0,
    merged_lanes=0.0,
    false_lanes=0.0,
)


@pytest.fixture(scope="module")
def rig():
    return build_rig(RigConfig(), 0, np.random.default_rng(5))


@pytest.fixture(scope="module")
def drive(suburb, rig):
    return drive_through(suburb, rig, VehicleConfig(), np.random.default_rng(3))


def _detect(world, drive, rig, config, seed=0):
    rng = np.random.default_rng(seed)
    return detect_lanes(world, drive, rig.camera, config, rng, frame_rate_hz=15.0)


def _off_marker_px(world, drive, rig, rows, sample=400):
    """Distance [px] of detected points from the images of their markers, near ones only."""
    first = np.cumsum(rows.count) - rows.count
    off = []
    for row in np.linspace(0, len(rows) - 1, sample).astype(int):
        p = world.markers.points_of(int(rows.marker[row])) - drive.p_world_camera[rows.frame[row]]
        p = p @ drive.R_world_camera[rows.frame[row]]
        p = p[(p[:, 2] > 3) & (p[:, 2] < 60)]
        px, _ = project(rig.camera, torch.from_numpy(p))
        points = rows.px[first[row] : first[row] + rows.count[row]]
        a, b = px.numpy()[:-1], px.numpy()[1:]
        side = b - a
        share = ((points[:, None] - a) * side).sum(-1) / (side**2).sum(-1)
        foot = a + np.clip(share, 0, 1)[..., None] * side
        off.append(np.linalg.norm(points[:, None] - foot, axis=-1).min(-1))
    return np.concatenate(off)


def test_perfect_points_lie_on_their_marker(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, PERFECT)
    assert _off_marker_px(suburb, drive, rig, rows).max() < 0.05
    types = np.array(["solid", "dashed", "double", "curb"])[rows.type]
    assert (types == np.array(suburb.markers.type)[rows.marker]).all()


def test_noise_is_as_stated(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, replace(PERFECT, lane_noise_px=0.7))
    # What is left is the part of the noise that is square to the image of the marker.
    rms = np.sqrt((_off_marker_px(suburb, drive, rig, rows) ** 2).mean())
    assert rms == pytest.approx(0.7, abs=0.07)


def test_a_frame_has_at_most_five_markers_with_8_to_20_points(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, DAY)
    assert np.bincount(rows.frame[rows.marker >= 0]).max() <= 5
    solid = rows.count[np.isin(rows.marker, np.flatnonzero(suburb.markers.dash_m == 0))]
    assert solid.max() <= 20 and np.median(solid) >= 8
    assert rows.count.min() >= 3 and rows.count.sum() == len(rows.px)


def test_dash_gaps_leave_out_points(suburb, drive, rig):
    rows = _detect(suburb, drive, rig, PERFECT)
    dashed = np.flatnonzero(suburb.markers.dash_m > 0)
    first = np.cumsum(rows.count) - rows.count
    checked = 0
    for row in np.flatnonzero(np.isin(rows.marker, dashed))[::40]:
        marker = int(rows.marker[row])
        p = suburb.markers.points_of(marker) - drive.p_world_camera[rows.frame[row]]
        p = p @ drive.R_world_camera[rows.frame[row]]
        px, visible = project(rig.camera, torch.from_numpy(p))
        parameter = np.arange(len(p)) * 0.25
        points = rows.px[first[row] : first[row] + rows.count[row]]
        distance = np.linalg.norm(points[:, None] - px.numpy(), axis=-1)
        nearest = np.where(visible.numpy() & (p[:, 2] < 60), distance, np.inf).argmin(-1)
        period = suburb.markers.dash_m[marker] + suburb.markers.gap_m[marker]
        phase = np.mod(parameter[nearest], period)
        assert ((phase <= suburb.markers.dash_m[marker] + 0.25) | (phase > period - 0.25)).all()
        checked += len(points)
    assert checked > 100


def test_faults_come_as_often_as_asked_for(suburb, drive, rig):
    perfect = len(_detect(suburb, drive, rig, PERFECT))
    config = replace(DAY, lane_occlusions_per_km=0.0)
    rows = _detect(suburb, drive, rig, config)
    true = rows.marker >= 0
    assert true.sum() / perfect == pytest.approx(1 - config.missed_lanes, abs=0.02)
    assert (~true).mean() == pytest.approx(config.false_lanes, abs=0.006)
    assert 0.002 < rows.is_merged.mean() < 0.02
    kinds = np.array([("solid", "dashed", "double", "curb").index(t) for t in suburb.markers.type])
    known = true & (rows.type >= 0)
    wrong = (rows.type[known] != kinds[rows.marker[known]]).mean()
    assert wrong == pytest.approx(0.75 * config.wrong_lane_type, abs=0.012)


def test_neighbouring_markers_are_a_lane_apart():
    for name, config in WORLD_PRESETS.items():
        world = build_world(config, np.random.default_rng(1))
        along = [k for k in range(len(world.markers)) if world.markers.length()[k] > 200]
        places = [world.markers.points_of(k)[len(world.markers.points_of(k)) // 2] for k in along]
        gaps = np.linalg.norm(np.array(places)[:, None] - np.array(places)[None], axis=-1)
        np.fill_diagonal(gaps, np.inf)
        assert gaps.min() >= 3.2 and gaps.min(0).max() <= 3.75, name


def test_markers_that_cross_the_road_are_seen_and_interrupt_ours(rig):
    config = replace(WORLD_PRESETS["street"], crossings_per_km=4.0)
    world = build_world(config, np.random.default_rng(0))
    drive = drive_through(world, rig, VehicleConfig(), np.random.default_rng(0))
    rows = _detect(world, drive, rig, PERFECT)
    across = np.flatnonzero(np.isnan(world.markers.station))
    assert len(across) and np.isin(rows.marker, across).sum() > 20
    pieces = [k for k in range(len(world.markers)) if world.markers.type[k] == "double"]
    assert len(pieces) >= 2
    assert _off_marker_px(world, drive, rig, rows).max() < 0.05
