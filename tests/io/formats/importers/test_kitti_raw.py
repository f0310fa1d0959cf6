from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import compose, write_new
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.io.formats.importers import kitti_raw
from crowdmap_torch.tables import Origin

ORIGIN = Origin(49.0, 8.4, 110.0)
K = np.array([[700.0, 0, 600], [0, 700, 170], [0, 0, 1]])
R_VELO_CAM = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
FRAMES = 4


def text_of(values: np.ndarray) -> str:
    return " ".join(repr(float(x)) for x in np.ravel(values))


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """A car that drives east, a metre and a tenth of a second a frame, images ten milliseconds after the fixes."""
    folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for name in ("oxts/data", "image_02"):
        (folder / name).mkdir(parents=True)
    for k in range(FRAMES):
        place = geodetic_from_local(np.array([float(k), 0.0, 0.0]), ORIGIN)
        # Yaw 0 is east.
        row = np.concatenate((place, np.zeros(27)))
        row[23] = 0.05
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(text_of(row))
    for name, late in (("oxts", 0), ("image_02", 1)):
        stamps = (f"2011-09-26 13:02:25.{k}{late}0000000" for k in range(FRAMES))
        (folder / name / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    P = K @ np.concatenate((np.eye(3), [[0.06], [0], [0]]), axis=1)
    day = folder.parent
    (day / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012\nS_rect_02: 1242 375\nR_rect_00: {text_of(np.eye(3))}\nP_rect_02: {text_of(P)}\n"
    )
    # The camera is half a metre ahead of the laser, which is a metre ahead of the GPS/IMU unit.
    (day / "calib_velo_to_cam.txt").write_text(
        f"R: {text_of(R_VELO_CAM.T)}\nT: {text_of(R_VELO_CAM.T @ (-0.5, 0, 0))}\n"
    )
    (day / "calib_imu_to_velo.txt").write_text(f"R: {text_of(np.eye(3))}\nT: -1 0 0\n")
    return folder


def test_the_camera_is_where_fixes_and_calibration_put_it(drive: Path, tmp_path: Path):
    asked = Asked(origin=ORIGIN)
    parts = kitti_raw.read((drive,), asked)
    write_new(tmp_path / "DATA", compose([parts], asked))
    (journey,) = load_dataset(tmp_path / "DATA").journeys
    # The last image is after the last fix.
    assert journey.frame_count == FRAMES - 1
    assert parts.notes[0].startswith("1 of 4 images left out")
    # Ten milliseconds on, 1.5 m ahead, and the left colour camera 6 cm to the left.
    expected = [[k + 0.1 + 1.5, 0.06, 0] for k in range(FRAMES - 1)]
    np.testing.assert_allclose(journey.T_world_camera[:, :3, 3], expected, atol=1e-6)
    np.testing.assert_allclose(journey.T_world_camera[0, :3, 2], (1, 0, 0), atol=1e-9)
    np.testing.assert_allclose(journey.rig.camera.K, K)
    assert (journey.rig.camera.width, journey.rig.camera.height) == (1242, 375)
    np.testing.assert_allclose(journey.rig.road_normal_camera, (0, 1, 0), atol=1e-12)
    assert journey.rig.camera_height == 1.65
    assert journey.sigma_position is not None and float(journey.sigma_position[0, 0]) == 0.05


def test_angles_are_those_of_the_unit(drive: Path):
    # Yaw a quarter turn anticlockwise from east, nose down and left side up by 0.1.
    row = np.concatenate(((49.0, 8.4, 110.0), (0.1, 0.1, np.pi / 2), np.zeros(24)))
    (drive / "oxts" / "data" / f"{0:010d}.txt").write_text(text_of(row))
    (drive / "image_02" / "timestamps.txt").unlink()
    track = kitti_raw.read((drive,), Asked(origin=ORIGIN)).track
    assert track is not None
    turns = torch.tensor([[0, 0, np.pi / 2], [0, 0.1, 0], [0.1, 0, 0]], dtype=torch.float64)
    R = torch.linalg.multi_dot([*se3.so3_exp(turns)])
    np.testing.assert_allclose(track.T_world_link[0, :3, :3], R, atol=1e-12)


def test_without_a_calibration_the_poses_are_the_units(drive: Path):
    (drive.parent / "calib_cam_to_cam.txt").unlink()
    parts = kitti_raw.read((drive,), Asked())
    assert parts.rig is None
    assert parts.track is not None and parts.track.link == "flu"


def test_a_drive_with_a_mistake_is_refused(drive: Path):
    with pytest.raises(InputError, match="expected one of image_00"):
        kitti_raw.read((drive,), Asked(camera="front"))
    (drive.parent / "calib_imu_to_velo.txt").write_text("R: 1 0\nT: 0 0 0\n")
    with pytest.raises(InputError, match=r"calib_imu_to_velo\.txt: R: expected 9 finite numbers"):
        kitti_raw.read((drive,), Asked())
    (drive.parent / "calib_imu_to_velo.txt").write_text("T: 0 0 0\n")
    with pytest.raises(InputError, match=r"calib_imu_to_velo\.txt: R is missing"):
        kitti_raw.read((drive,), Asked())
    (drive / "oxts" / "data" / f"{0:010d}.txt").write_text("1 2 3")
    with pytest.raises(InputError, match=r"0000000000\.txt: line 1: expected 30 numbers, found 3"):
        kitti_raw.read((drive,), Asked())
    (drive / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.1\nnoon\n")
    with pytest.raises(InputError, match=r"timestamps\.txt: line 2: expected 2011-09-26"):
        kitti_raw.read((drive,), Asked())
    (drive / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.1\n")
    with pytest.raises(InputError, match="has 1 times for 4 files"):
        kitti_raw.read((drive,), Asked())
    with pytest.raises(InputError, match="the file is missing"):
        kitti_raw.read((drive.parent,), Asked())
