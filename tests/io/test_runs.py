"""What a run writes beside its map."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.io.datasets import load_dataset
from crowdmap_torch.io.poses import read_poses
from crowdmap_torch.io.runs import write_associations, write_refined_poses, write_road_estimate
from crowdmap_torch.tables import RoadEstimate


@pytest.mark.parametrize("sigmas", [False, True])
def test_poses_that_were_not_refined_come_back_with_the_same_columns(sound, sigmas) -> None:
    if sigmas:
        sound.journeys["a"].poses |= {f"sigma_{k}": [0.3] * 4 for k in ("e", "n", "u", "rot")}
    folder = sound.write()
    source = folder / "journeys" / "a" / "poses.parquet"
    journey = load_dataset(folder).journeys[0]
    write_refined_poses(folder / "out.parquet", journey, journey.T_world_camera)
    before, after = pq.read_table(source), pq.read_table(folder / "out.parquet")
    assert after.schema.equals(before.schema)
    assert after.column("frame").equals(before.column("frame"))
    assert after.column("t_ns").equals(before.column("t_ns"))
    # Through the mount and back: rounding of float64.
    T_before, T_after = (
        read_poses(source).T_world_link,
        read_poses(folder / "out.parquet").T_world_link,
    )
    torch.testing.assert_close(T_after, T_before, atol=1e-14, rtol=0)


def test_refined_poses_and_sigmas_are_written(sound) -> None:
    folder = sound.write()
    journey = load_dataset(folder).journeys[1]
    T = journey.T_world_camera.clone()
    T[:, 0, 3] += 0.25
    sigma = torch.full((4, 3), 0.1, dtype=torch.float64)
    write_refined_poses(folder / "out.parquet", journey, T, sigma_position=sigma)
    again = read_poses(folder / "out.parquet")
    assert again.T_world_link[:, 0, 3].tolist() == [0.25, 1.25, 2.25, 3.25]
    assert again.sigma_position is not None
    assert torch.equal(again.sigma_position, sigma)


def test_every_row_of_the_detection_files_has_an_association(sound) -> None:
    # Anticlockwise: dropped at the door, and still a row of the file.
    sound.journeys["b"].signs["u"][0] = [30.0, 30.0, 50.0, 50.0]
    sound.journeys["b"].signs["v"][0] = [20.0, 30.0, 30.0, 20.0]
    folder = sound.write()
    journeys = load_dataset(folder).journeys
    write_associations(
        folder / "associations.parquet",
        journeys,
        [torch.tensor([1, -1, 0]), torch.tensor([-1, 1])],
        [torch.tensor([0, -1]), torch.tensor([-1, -1])],
        sign_id=("s0", "s1"),
        lane_id=("l0",),
    )
    table = pq.read_table(folder / "associations.parquet")
    assert {f.name: str(f.type) for f in table.schema} == {
        "journey_id": "string",
        "kind": "string",
        "row": "int64",
        "landmark_id": "string",
    }
    rows = [tuple(row.values()) for row in table.to_pylist()]
    # Detections are in the order of frames: rows 1, 2, 0 of signs.parquet, 1, 0 of lanes.parquet.
    assert rows == [
        ("a", "sign", 0, "s0"),
        ("a", "sign", 1, "s1"),
        ("a", "sign", 2, None),
        ("a", "lane", 0, None),
        ("a", "lane", 1, "l0"),
        ("b", "sign", 0, None),
        ("b", "sign", 1, None),
        ("b", "sign", 2, "s1"),
        ("b", "lane", 0, None),
        ("b", "lane", 1, None),
    ]


def test_associations_of_no_journey_are_a_file_without_rows(tmp_path: Path) -> None:
    write_associations(tmp_path / "a.parquet", [], [], [], sign_id=(), lane_id=())
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.num_rows == 0
    assert table.column_names == ["journey_id", "kind", "row", "landmark_id"]


def test_the_road_is_written_frame_by_frame(tmp_path: Path) -> None:
    road = RoadEstimate(
        normal_camera=torch.tensor([[0.0, 1, 0], [0.6, 0.8, 0]], dtype=torch.float64),
        height=torch.tensor([1.4, 1.5], dtype=torch.float64),
        sigma=torch.tensor([0.01, 0.02], dtype=torch.float64),
    )
    write_road_estimate(tmp_path / "road.parquet", torch.tensor([3, 5]), road)
    assert pq.read_table(tmp_path / "road.parquet").to_pylist() == [
        {"frame": 3, "nx": 0.0, "ny": 1.0, "nz": 0.0, "height_m": 1.4, "sigma": 0.01},
        {"frame": 5, "nx": 0.6, "ny": 0.8, "nz": 0.0, "height_m": 1.5, "sigma": 0.02},
    ]
