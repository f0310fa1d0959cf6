from __future__ import annotations

from pathlib import Path

import pytest
import torch

from crowdmap_torch.geometry import se3
from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.poses import LinkPoses, read_poses, write_poses


def test_quaternions_and_normals_almost_of_unit_length_are_normalised(sound) -> None:
    for name in ("qx", "qy", "qz", "qw"):
        sound.journeys["b"].poses[name] = [1.0009 * q for q in sound.journeys["b"].poses[name]]
    sound.rigs["b"]["road"]["normal"] = [0.0, 0.9995, 0.0]
    journey = load_dataset(sound.write()).journeys[1]
    R = journey.T_world_camera[:, :3, :3]
    identity = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)
    torch.testing.assert_close(R @ R.mT, identity, atol=1e-14, rtol=0)
    assert float(journey.rig.road_normal_camera.norm()) == pytest.approx(1, abs=1e-15)


def test_sigmas_unknown_in_some_frames_hold_the_median_of_the_others(sound) -> None:
    sound.journeys["b"].poses |= {
        "sigma_e": [0.3, None, 0.5, 0.4],
        "sigma_n": [0.3] * 4,
        "sigma_u": [0.6] * 4,
        "sigma_rot": [0.002] * 4,
    }
    journey = load_dataset(sound.write()).journeys[1]
    assert journey.sigma_position is not None
    assert journey.sigma_rotation is not None
    assert journey.sigma_position[:, 0].tolist() == [0.3, 0.4, 0.5, 0.4]
    assert journey.sigma_rotation.tolist() == [0.002] * 4


def test_position_sigmas_count_only_together(sound) -> None:
    sound.journeys["b"].poses |= {"sigma_e": [0.3] * 4, "sigma_n": [0.3] * 4}
    assert load_dataset(sound.write()).journeys[1].sigma_position is None


def test_poses_are_rotations_of_the_quaternion_convention(sound) -> None:
    # (qx qy qz qw) = (-.5, .5, -.5, .5): z forward along east, x to the south, y down.
    journey = load_dataset(sound.write()).journeys[1]
    p_camera = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    p_world = se3.transform(journey.T_world_camera[0], p_camera)
    assert p_world.tolist() == pytest.approx([3.0, -1.0, -2.0])


def test_poses_come_back_as_they_were_written(tmp_path: Path, generator: torch.Generator):
    frames = 5
    T = se3.exp(torch.randn(frames, 6, generator=generator, dtype=torch.float64))
    poses = LinkPoses(
        frame_number=torch.arange(frames) * 2,
        t_ns=torch.arange(frames) * 10**8,
        T_world_link=T,
        sigma_position=torch.rand(frames, 3, generator=generator, dtype=torch.float64),
        sigma_rotation=None,
    )
    write_poses(tmp_path / "poses.parquet", poses)
    again = read_poses(tmp_path / "poses.parquet")
    assert torch.equal(again.frame_number, poses.frame_number)
    assert torch.equal(again.t_ns, poses.t_ns)
    # Through a quaternion and back: rounding of float64.
    torch.testing.assert_close(again.T_world_link, T, atol=1e-14, rtol=0)
    assert poses.sigma_position is not None and again.sigma_position is not None
    assert torch.equal(again.sigma_position, poses.sigma_position)
    assert again.sigma_rotation is None


@pytest.mark.parametrize(("column", "rule"), [("frame", "11 after 11"), ("t_ns", "5 after 9")])
def test_frames_and_times_that_do_not_increase_are_refused_by_row(sound, column: str, rule: str):
    values = {"frame": [10, 11, 11, 14], "t_ns": [1, 9, 5, 12]}[column]
    sound.journeys["a"].poses[column] = values
    path = sound.write() / "journeys" / "a" / "poses.parquet"
    with pytest.raises(InputError, match=rf"poses\.parquet: row 2: column '{column}': {rule}"):
        read_poses(path)


@pytest.mark.filterwarnings("error")
def test_a_quaternion_beyond_all_bounds_is_refused_in_one_line_alone(sound) -> None:
    sound.journeys["a"].poses["qx"][2] = 1e300
    (rejected,) = load_dataset(sound.write()).rejected
    assert "row 2: quaternion qx qy qz qw has length inf" in rejected.reason
