from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.simulate.files import write_rig
from crowdmap_torch.simulate.rigs import RigConfig, build_rig, letters, rotation_from_rpy


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("camera", ["brown", "fisheye", "pinhole"])
def test_a_rig_comes_back_from_its_files(tmp_path: Path, camera: str, index: int):
    rig = build_rig(RigConfig(camera=camera), index, np.random.default_rng(index))
    write_rig(tmp_path / rig.rig_id, rig)
    read = read_rig(tmp_path / rig.rig_id)
    assert torch.equal(read.camera.K, rig.camera.K)
    assert torch.equal(read.camera.distortion, rig.camera.distortion)
    assert read.camera_height == rig.camera_height
    # Through the chain of a URDF's joints: rounding of float64.
    assert np.abs(read.T_link_camera.numpy() - rig.T_link_camera).max() < 1e-12
    assert np.abs(read.road_normal_camera.numpy() - rig.road_normal_camera).max() < 1e-12


def test_no_two_rigs_have_one_name():
    assert [letters(index) for index in (0, 1, 25, 26, 27, 52, 702)] == [
        *("a", "b", "z", "aa", "ab", "ba", "aaa")
    ]
    assert len({letters(index) for index in range(2000)}) == 2000


def test_the_first_rig_has_no_mount_and_the_others_differ_in_their_pose_links():
    rigs = [build_rig(RigConfig(), index, np.random.default_rng(index)) for index in range(3)]
    assert [rig.urdf is None for rig in rigs] == [True, False, False]
    assert [rig.pose_link for rig in rigs] == [None, "base_link", "imu_link"]
    assert np.array_equal(rigs[0].T_link_camera, np.eye(4))


def test_a_camera_looks_ahead_and_down_by_its_pitch():
    config = RigConfig(camera_pitch_deg=5.0)
    rig = build_rig(config, 0, np.random.default_rng(1))
    ahead, left, up = rig.R_body_camera[:, 2]
    assert ahead > 0.99
    assert np.degrees(np.arcsin(-up)) == pytest.approx(5.0, abs=0.5)
    assert abs(np.degrees(np.arcsin(left))) < 0.6
    assert np.linalg.norm(rig.road_normal_camera) == pytest.approx(1)


def test_rpy_turns_about_fixed_axes_roll_first():
    R = rotation_from_rpy(0.0, 0.0, np.pi / 2)
    assert R @ [1, 0, 0] == pytest.approx([0, 1, 0])
    R = rotation_from_rpy(np.pi / 2, 0.0, np.pi / 2)
    assert R @ [0, 1, 0] == pytest.approx([0, 0, 1])
    assert np.linalg.det(rotation_from_rpy(0.3, -0.2, 1.1)) == pytest.approx(1)


def test_an_unknown_camera_is_refused():
    with pytest.raises(ValueError, match="camera 'wide': expected one of"):
        build_rig(replace(RigConfig(), camera="wide"), 0, np.random.default_rng(0))
