from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import brentq

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import project
from crowdmap_torch.simulate.motion import Motion, Shutter
from crowdmap_torch.simulate.rigs import RigConfig, build_rig
from crowdmap_torch.simulate.vehicle import VehicleConfig, drive_through

READ_OUT_S = 0.04


@pytest.fixture(scope="module")
def rig():
    return build_rig(RigConfig(), 0, np.random.default_rng(5))


@pytest.fixture(scope="module")
def drive(suburb, rig):
    return drive_through(suburb, rig, VehicleConfig(), np.random.default_rng(3))


@pytest.fixture(scope="module")
def seen(suburb, drive, rig):
    """Centres of signs and the frames that see them, far and near, driving and in bends."""
    frame, sign = np.nonzero(np.ones((len(drive), len(suburb.signs)), dtype=bool))
    point = suburb.signs.center[sign]
    p_camera, _, visible = Shutter(drive, rig.camera).see(point[:, None], frame)
    near = visible[:, 0] & (p_camera[:, 0, 2] < 80)
    row = np.flatnonzero(near)[:: max(near.sum() // 60, 1)]
    return point[row], frame[row]


def test_motion_passes_through_the_poses_of_all_frames(drive):
    T = Motion(drive).poses(drive.t)
    assert np.abs(T[:, :3, 3] - drive.p_world_camera).max() < 1e-9
    # The last frame is reached by its turn from the one before.
    assert np.abs(T[:, :3, :3] - drive.R_world_camera).max() < 1e-9


def test_points_in_the_camera_are_those_of_its_poses(drive):
    rng = np.random.default_rng(0)
    t = rng.uniform(-0.1, drive.t[-1] + 0.1, 50)
    point = drive.p_world_camera[rng.integers(0, len(drive), 50)] + rng.normal(size=(50, 3))
    motion = Motion(drive)
    T_camera_world = se3.inverse(torch.from_numpy(motion.poses(t)))
    expected = se3.transform(T_camera_world, torch.from_numpy(point)).numpy()
    assert np.abs(motion.in_camera(point, t) - expected).max() < 1e-9


def test_before_and_after_a_drive_the_camera_goes_straight_on(drive):
    for end in (0, -1):
        t = drive.t[end] + np.array([-0.02, -0.01, 0.01, 0.02]) * (1 if end else -1)
        inside, edge, beyond = Motion(drive).poses(np.array([t[1], drive.t[end], t[2]]))
        step, before = beyond[:3, 3] - edge[:3, 3], edge[:3, 3] - inside[:3, 3]
        # Both steps take 10 ms; the car's acceleration of 1.5 m/s^2 makes 0.15 mm of it.
        assert np.abs(step - before).max() < 5e-4
        assert np.array_equal(beyond[:3, :3], edge[:3, :3])


def test_a_rolling_shutter_shows_what_a_moving_camera_sees_row_by_row(drive, rig, seen):
    points, frames = seen
    motion, height = Motion(drive), rig.camera.height
    _, px, visible = Shutter(drive, rig.camera, READ_OUT_S).see(points[:, None], frames)

    def pixel_if_exposed_with(row: float, k: int) -> np.ndarray:
        t = drive.t[frames[k]] + READ_OUT_S * (row / height - 0.5)
        T_camera_world = se3.inverse(torch.from_numpy(motion.poses(np.array([t]))))
        p = se3.transform(T_camera_world, torch.from_numpy(points[k])[None])
        return project(rig.camera, p)[0].numpy()[0]

    def off_its_row(row: float, k: int) -> float:
        return float(pixel_if_exposed_with(row, k)[1] - row)

    rows = np.flatnonzero(visible[:, 0])
    assert len(rows) > 30
    for k in rows.tolist():
        row: float = brentq(off_its_row, -0.5, height - 0.5, args=(k,), xtol=1e-11)  # type: ignore[assignment]
        assert np.abs(px[k, 0] - pixel_if_exposed_with(row, k)).max() < 1e-6


def test_without_a_read_out_every_row_is_exposed_in_the_frames_middle(drive, rig, seen):
    points, frames = seen
    _, at_once, _ = Shutter(drive, rig.camera).see(points[:, None], frames)
    _, shortest, _ = Shutter(drive, rig.camera, 1e-9).see(points[:, None], frames)
    assert np.abs(at_once - shortest).max() < 1e-4
    # Rows above the middle are exposed before it: nearer to the vanishing point than at once.
    _, rolling, _ = Shutter(drive, rig.camera, READ_OUT_S).see(points[:, None], frames)
    moved = np.abs(rolling - at_once).max(-1)[:, 0]
    above = np.abs(at_once[:, 0, 1] - rig.camera.height / 2) / rig.camera.height
    assert moved.max() > 1.0
    assert moved[above < 0.01].max(initial=0.0) < 0.05 * moved.max()
