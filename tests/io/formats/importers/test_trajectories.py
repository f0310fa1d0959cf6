"""The formats of poses that are lines of numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import foreign

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.parts import Asked, Track
from crowdmap_torch.io.formats.importers import euroc, kitti_odometry, tum

TURN = f"0 0 0 {-foreign.HALF} 0 0 {foreign.HALF}"


def track(parts) -> Track:
    assert parts.track is not None
    return parts.track


def test_a_tum_trajectory_keeps_its_times_to_the_nanosecond(tmp_path: Path):
    path = tmp_path / "drive.txt"
    path.write_text(f"1403636579.763555527 {TURN}\n1403636579.763555528 {TURN}\n")
    found = track(tum.read((path,), Asked()))
    assert found.t_ns.tolist() == [1403636579763555527, 1403636579763555528]
    assert (found.world, found.link) == (None, None)
    # A level camera that looks north.
    np.testing.assert_allclose(found.T_world_link[0, :3, 2], (0, 1, 0), atol=1e-12)


def test_euroc_has_the_real_part_first(tmp_path: Path):
    folder = tmp_path / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    row = f"1403636579763555527,1,2,3,{foreign.HALF},{-foreign.HALF},0,0"
    (folder / "data.csv").write_text(f"#timestamp, p_RS_R_x [m]\n{row}\n")
    found = track(euroc.read((tmp_path,), Asked()))
    assert found.t_ns.tolist() == [1403636579763555527]
    np.testing.assert_allclose(found.T_world_link[0, :3, 2], (0, 1, 0), atol=1e-12)
    assert found.T_world_link[0, :3, 3].tolist() == [1, 2, 3]
    (folder / "data.csv").write_text(f"{row}{',0' * 9}\n")
    assert track(euroc.read((folder / "data.csv",), Asked())).t_ns.tolist() == [1403636579763555527]
    with pytest.raises(InputError, match=r"the file is missing; is .* the right folder"):
        euroc.read((folder,), Asked())


def test_kitti_poses_are_the_first_cameras(tmp_path: Path):
    path = tmp_path / "00.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n0 0 1 5 0 1 0 6 -1 0 0 7\n")
    (tmp_path / "times.txt").write_text("0.0\n1.037e-01\n")
    found = track(kitti_odometry.read((path,), Asked()))
    assert (found.world, found.link) == ("rdf", "camera")
    assert found.t_ns.tolist() == [0, 103_700_000]
    assert found.T_world_link[1].tolist() == [
        [0, 0, 1, 5],
        [0, 1, 0, 6],
        [-1, 0, 0, 7],
        [0, 0, 0, 1],
    ]
    both = kitti_odometry.read((tmp_path / "times.txt", path), Asked())
    np.testing.assert_array_equal(track(both).T_world_link, found.T_world_link)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "has no rows; expected lines of 8 numbers"),
        ("1 2 3\n", "line 1: expected 8 numbers t x y z qx qy qz qw, found 3 values"),
        (f"# t\n1 {TURN}\n1 {TURN}\n", "line 3: its time 1 is not after that of the line before"),
        ("1 0 0 x 0 0 0 1\n", "line 1: z: expected a finite number, found 'x'"),
        ("1 0 0 nan 0 0 0 1\n", "line 1: z: expected a finite number, found 'nan'"),
        ("1 0 0 0 0 0 0 2\n", "line 1: the quaternion has length 2; expected 1"),
    ],
)
def test_a_trajectory_with_a_mistake_is_refused(tmp_path: Path, text: str, expected: str):
    (tmp_path / "drive.txt").write_text(text)
    with pytest.raises(InputError, match=rf"drive\.txt: {expected}"):
        tum.read((tmp_path / "drive.txt",), Asked())


def test_kitti_poses_with_a_mistake_are_refused(tmp_path: Path):
    path, clock = tmp_path / "00.txt", tmp_path / "times.txt"
    path.write_text("1 0 0 0 0 1 0 0 0 0 -1 0\n")
    clock.write_text("0\n1\n")
    with pytest.raises(
        InputError, match=r"00\.txt: line 1: its first three columns are no rotation"
    ):
        kitti_odometry.read((path,), Asked())
    path.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(InputError, match=r"times\.txt: has 2 times for the 1 poses"):
        kitti_odometry.read((path,), Asked())
    with pytest.raises(InputError, match="a file of times alone"):
        kitti_odometry.read((clock,), Asked())
    clock.unlink()
    with pytest.raises(InputError, match=r"times\.txt: the file is missing"):
        kitti_odometry.read((path,), Asked())
