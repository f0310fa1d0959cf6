"""Calibrations that were found: rigs put right, names of folders, and what breaks calibration.json."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.found_calibration import (
    folder_name,
    read_calibration,
    write_calibration,
    write_corrected_rigs,
)
from crowdmap_torch.io.rigs import read_rig
from crowdmap_torch.noise.calibration import corrected_rig
from crowdmap_torch.tables import Rig

F64 = torch.float64


def rig() -> Rig:
    K = torch.tensor([[1000.0, 0, 640], [0, 1010.0, 400], [0, 0, 1]], dtype=F64)
    T = torch.eye(4, dtype=F64)
    T[:3, :3] = se3.so3_exp(torch.tensor([1.2, -1.1, 1.3], dtype=F64))
    T[:3, 3] = torch.tensor([1.5, 0.1, 1.2], dtype=F64)
    distortion = torch.tensor([-0.1, 0.02, 1e-4, -2e-4], dtype=F64)
    return Rig(
        rig_id="a",
        camera=Camera("brown_conrady", 1280, 800, K, distortion),
        T_link_camera=T,
        road_normal_camera=torch.tensor([0.0, 1.0, 0.0], dtype=F64),
        camera_height=1.4,
    )


def test_a_rig_put_right_is_read_as_it_was_found(tmp_path: Path) -> None:
    numbers = {
        "mount_deg": ((0.3, -0.2, 0.5), (0.1, 0.1, 0.1)),
        "mount_m": ((0.02, 0.0, -0.03), (0.01, 0.01, 0.01)),
        "focal": ((0.004,), (0.001,)),
        "principal_px": ((2.0, -1.0), (0.5, 0.5)),
        "height_m": ((-0.05,), (0.01,)),
        "clock_s": ((0.01,), (0.001,)),
    }
    stated = rig()
    right = corrected_rig(stated, numbers)
    assert right.camera.K[0, 0] == 1000 * 1.004 and right.camera.K[1, 1] == 1010 * 1.004
    assert right.camera.K[:2, 2].tolist() == [642.0, 399.0]
    assert right.camera_height == pytest.approx(1.35)
    # A point of the road's normal is the same direction for the camera that turned.
    turn = stated.T_link_camera[:3, :3].mT @ right.T_link_camera[:3, :3]
    torch.testing.assert_close(turn @ right.road_normal_camera, stated.road_normal_camera)
    angle = torch.rad2deg(se3.so3_log(turn))
    torch.testing.assert_close(angle, torch.tensor([0.3, -0.2, 0.5], dtype=F64))
    write_corrected_rigs(tmp_path, [("car 7", right), ("b", replace(right, rig_id="b"))])
    read = read_rig(tmp_path / folder_name("car 7"))
    torch.testing.assert_close(read.T_link_camera, right.T_link_camera)
    torch.testing.assert_close(read.camera.K, right.camera.K, rtol=0, atol=0)
    torch.testing.assert_close(read.road_normal_camera, right.road_normal_camera)
    assert read.camera_height == right.camera_height and (tmp_path / "b" / "rig.yaml").exists()


def test_cars_have_folders_of_their_own_whatever_they_are_called() -> None:
    names = ["vehicle-7", "../x", "a/b", "a_b", "", "ä" * 300, "..", "a b"]
    folders = [folder_name(name) for name in names]
    assert folders[0] == "vehicle-7" and len(set(folders)) == len(names)
    for name in folders:
        assert name and len(name) < 100 and name not in (".", "..") and "/" not in name


def test_numbers_are_read_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    parameters = {"focal": {"estimate": [0.001], "sigma": [1e-4], "prior_sigma": [0.002]}}
    write_calibration(path, {"a": {"rig": "r", "parameters": parameters}})
    assert read_calibration(path) == {"a": {"focal": ((0.001,), (1e-4,))}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": [0.0]}, r"cars\.a\.parameters\.focal\.sigma: expected numbers above 0"),
        ({"sigma": [1.0, 2.0]}, r"focal\.sigma"),
        ({"estimate": ["x"]}, r"focal\.estimate"),
        ({"estimate": [-1.0]}, r"focal\.estimate: expected -0\.5 to 1 \(a share"),
        ({"estimate": [float("inf")]}, "calibration.json"),
    ],
)
def test_what_breaks_the_format_is_named(tmp_path: Path, change: dict, message: str) -> None:
    path = tmp_path / "calibration.json"
    focal = {"estimate": [0.001], "sigma": [1e-4], **change}
    content = {
        "format": "crowdmap-calibration",
        "version": 1,
        "cars": {"a": {"parameters": {"focal": focal}}},
    }
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_calibration(path)
