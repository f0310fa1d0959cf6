from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.poses import read_poses
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.simulate import files
from crowdmap_torch.simulate.dataset import make_journey


@pytest.fixture(scope="module")
def journey(suburb_config, suburb, fleet):
    """The first drive along the suburb."""
    return make_journey(suburb_config, suburb, fleet, 0)


def test_poses_are_written_frame_by_frame(journey, tmp_path: Path):
    path = tmp_path / "poses.parquet"
    started_ns = 5 * 10**9
    files.write_drive_poses(
        path, journey.drive, journey.T_reported, started_ns, (np.array([0.1, 0.2, 0.3]), 0.004)
    )
    poses = read_poses(path)
    assert np.array_equal(poses.frame_number.numpy(), journey.drive.frame)
    # Through a quaternion and back: rounding of float64.
    assert np.abs(poses.T_world_link.numpy() - journey.T_reported).max() < 1e-12
    seconds = (poses.t_ns.numpy() - started_ns) / 1e9
    assert np.abs(seconds - journey.drive.t).max() <= 0.5e-9
    assert poses.sigma_position is not None and poses.sigma_rotation is not None
    assert (poses.sigma_position.numpy() == [0.1, 0.2, 0.3]).all()
    files.write_drive_poses(path, journey.drive, journey.T_reported, started_ns)
    assert read_poses(path).sigma_position is None


def test_every_detection_is_a_row_with_the_corners_of_its_shape(suburb, journey, tmp_path: Path):
    files.write_sign_rows(tmp_path / "signs.parquet", journey.signs, journey.drive, suburb)
    table = pq.read_table(tmp_path / "signs.parquet").to_pylist()
    assert len(table) == len(journey.signs)
    for row, shape in zip(table, journey.signs.shape.tolist(), strict=True):
        assert row["shape"] == polygon.SHAPES[shape]
        assert len(row["u"]) == len(row["v"]) == int(polygon.CORNER_COUNT[shape])
    files.write_lane_rows(tmp_path / "lanes.parquet", journey.lanes, journey.drive)
    points = [len(u) for u in pq.read_table(tmp_path / "lanes.parquet")["u"].to_pylist()]
    assert points == journey.lanes.count.tolist()


def test_the_survey_is_the_world_to_the_last_corner(suburb, tmp_path: Path):
    files.write_survey(tmp_path, suburb, {})
    survey = read_survey(tmp_path)
    assert survey.sign_id == tuple(suburb.signs.sign_id)
    # The centre is the mean of the corners: rounding of float64.
    assert np.abs(survey.signs.center_world.numpy() - suburb.signs.center).max() < 1e-9
    assert survey.lane_id == suburb.markers.lane_id
    # A marker's ends are kept, whatever is thinned between them.
    for lane in range(len(suburb.markers)):
        ends = survey.lane_points.point_world[survey.lane_points.lane == lane][[0, -1]].numpy()
        true = suburb.markers.points_of(lane)[[0, -1]]
        assert (
            np.abs(ends - (true[::-1] if suburb.markers.is_oncoming[lane] else true)).max() < 1e-9
        )


def test_a_truth_of_no_detections_has_no_rows(suburb, journey, tmp_path: Path):
    none = np.zeros(0, dtype=np.int64)
    lanes = replace(
        journey.lanes,
        **{
            name: getattr(journey.lanes, name)[:0]
            for name in ("frame", "count", "px", "type", "score", "marker", "is_merged")
        },
    )
    files.write_truth(
        tmp_path, suburb, journey.drive, journey.T_world_link, 0, journey.signs[none], lanes
    )
    assert pq.read_table(tmp_path / "signs.parquet").num_rows == 0
    assert pq.read_table(tmp_path / "lanes.parquet").num_rows == 0
    assert pq.read_table(tmp_path / "road.parquet").num_rows == len(journey.drive)
