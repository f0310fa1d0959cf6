from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.exporters.trajectories import write_kitti, write_tum
from crowdmap_torch.io.poses import LinkPoses, write_poses


@pytest.fixture
def poses() -> LinkPoses:
    generator = torch.Generator().manual_seed(2)
    xi = torch.randn(5, 6, dtype=torch.float64, generator=generator)
    xi[:, :3] *= 0.5
    return LinkPoses(
        frame_number=torch.arange(5),
        t_ns=1_777_777_777_123_456_789 + 66_666_667 * torch.arange(5),
        T_world_link=se3.exp(xi),
        sigma_position=None,
        sigma_rotation=None,
    )


@pytest.fixture
def run(poses: LinkPoses, tmp_path: Path) -> Path:
    (tmp_path / "run" / "journeys" / "a").mkdir(parents=True)
    write_poses(tmp_path / "run" / "journeys" / "a" / "poses.parquet", poses)
    (tmp_path / "out").mkdir()
    return tmp_path / "run"


def test_tum_lines_are_the_poses(run: Path, poses: LinkPoses, tmp_path: Path):
    write_tum(run, tmp_path / "out")
    lines = (tmp_path / "out" / "a.tum").read_text().splitlines()
    seconds = [line.split()[0] for line in lines]
    assert [int(t.replace(".", "")) for t in seconds] == poses.t_ns.tolist()
    number = torch.tensor(
        [[float(x) for x in line.split()[1:]] for line in lines], dtype=torch.float64
    )
    back = se3.make(se3.from_quaternion(number[:, 3:]), number[:, :3])
    torch.testing.assert_close(back, poses.T_world_link, rtol=0, atol=1e-8)


def test_kitti_lines_are_the_poses(run: Path, poses: LinkPoses, tmp_path: Path):
    write_kitti(run, tmp_path / "out")
    rows = np.loadtxt(tmp_path / "out" / "a.kitti").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, poses.T_world_link[:, :3], rtol=0, atol=1e-10)


def test_a_folder_without_journeys_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="expected a RUN"):
        write_tum(tmp_path, tmp_path)
