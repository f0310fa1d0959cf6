from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from worlds import foreign

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, CarRig
from crowdmap_torch.io.formats.composing.rig import described_rig, read_given_rig
from crowdmap_torch.io.rigs import read_camera, read_rig


def car(tmp_path: Path, T_link_camera: np.ndarray, height: float | None = 1.4) -> CarRig:
    camera = read_camera(foreign.write_rig(tmp_path / "given"))
    return CarRig("log", camera, T_link_camera, np.array([0.0, 1.0, 0.0]), height)


@pytest.mark.parametrize("pitch", [0.3, np.pi / 2, -np.pi / 2])
def test_a_described_mount_is_read_back(tmp_path: Path, pitch: float):
    cos, sin = np.cos(pitch), np.sin(pitch)
    turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    xi = torch.tensor([1.0, -0.2, 0.7, 0.1, 0.0, -2.0], dtype=torch.float64)
    T = se3.exp(xi).numpy()
    T[:3, :3] = T[:3, :3] @ turn
    described_rig(car(tmp_path, T), Asked()).write(tmp_path / "log")
    rig = read_rig(tmp_path / "log")
    np.testing.assert_allclose(rig.T_link_camera, T, atol=1e-9)
    assert rig.camera_height == 1.4


def test_a_camera_whose_height_nobody_knows_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="give it by --camera-height"):
        described_rig(car(tmp_path, np.eye(4), None), Asked())


def test_what_is_said_of_the_height_counts(tmp_path: Path):
    described_rig(car(tmp_path, np.eye(4)), Asked(camera_height=2.0)).write(tmp_path / "log")
    assert read_rig(tmp_path / "log").camera_height == 2.0


def test_a_given_rig_comes_with_its_mount(tmp_path: Path):
    given = read_given_rig(foreign.write_rig(tmp_path / "car", mount=True) / "rig.yaml")
    given.write(tmp_path / "copy")
    assert (given.rig_id, given.has_mount) == ("rig", True)
    np.testing.assert_allclose(
        read_rig(tmp_path / "copy").T_link_camera, read_rig(tmp_path / "car").T_link_camera
    )
    with pytest.raises(InputError, match=r"expected a file rig\.yaml"):
        read_given_rig(tmp_path / "car" / "car.urdf")
