from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
from worlds.curves import closest_parameter, evaluate

from crowdmap_torch.geometry import polygon, se3
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.landmarks import read_lanes, read_signs, write_lanes, write_signs
from crowdmap_torch.io.maps import read_map, write_map


def test_a_sign_on_its_side_is_written_upright(hd_map, tmp_path: Path) -> None:
    turn = torch.zeros(len(hd_map.signs), 6, dtype=torch.float64)
    turn[:, 5] = math.pi / 2
    lying = replace(hd_map.signs, T_world_sign=se3.retract(hd_map.signs.T_world_sign, turn))
    write_map(replace(hd_map, signs=lying), tmp_path / "map", min_confidence=0)
    again = read_map(tmp_path / "map").signs
    box = (again.shape == polygon.RECTANGLE) | (again.shape == polygon.DIAMOND)
    torch.testing.assert_close(again.size[box], lying.size[box].flip(-1))
    assert (again.T_world_sign[box, 2, 1] > 0.9).all()
    # A triangle has one up axis only: it lies on its side.
    assert (again.T_world_sign[:2, 2, 1].abs() < 0.2).all()
    # The outline is the same, the first corner may be another.
    mean = again.corners_world[box, :4].mean(1)
    torch.testing.assert_close(mean, lying.corners_world[box, :4].mean(1))


def test_lane_points_lie_on_the_spline_at_most_a_metre_apart(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map")
    table = pq.read_table(tmp_path / "map" / "lanes.parquet")
    packed = hd_map.lanes.select(torch.arange(2))
    for row, start in enumerate(packed.control_start.tolist()):
        points = torch.tensor(table.column("points")[row].as_py(), dtype=torch.float64)
        control = packed.control.point_world[start : start + int(packed.control_count[row])]
        assert points.diff(dim=0).norm(dim=-1).max() <= 1.0
        torch.testing.assert_close(points[[0, -1]], control[[0, -1]])
        t = closest_parameter(control, points)
        on_curve = evaluate(control, t)
        # The closest parameter is found by iteration.
        assert (on_curve - points).norm(dim=-1).max() < 1e-6


MAP_FAULTS = {
    "covariance": ("signs", "covariance", [0.0] * 8, "expected 9 numbers, found 8"),
    "confidence": ("signs", "confidence", 1.1, "expected 0 to 1, found 1.1"),
    "width": ("signs", "width_m", 0.0, "expected a number above 0"),
    "type": ("lanes", "type", "dotted", "'dotted' is unknown"),
    "sigma": ("lanes", "sigma_m", [0.1], "1 numbers for 5 control points"),
    "one control point": ("lanes", "control_points", [[0.0] * 3], "1 points; expected 2 or more"),
}


@pytest.mark.parametrize("fault", MAP_FAULTS)
def test_a_fault_of_a_map_is_one_line(hd_map, tmp_path: Path, fault) -> None:
    file, name, value, reason = MAP_FAULTS[fault]
    write_map(hd_map, tmp_path / "map")
    path = tmp_path / "map" / f"{file}.parquet"
    table = pq.read_table(path)
    values = [value, *table.column(name).to_pylist()[1:]]
    place = table.column_names.index(name)
    pq.write_table(
        table.set_column(place, name, pa.array(values, table.schema.field(name).type)), path
    )
    with pytest.raises(InputError, match=f"{file}.parquet: row 0: .*{reason}"):
        read_map(tmp_path / "map")


def test_signs_and_lanes_come_back_with_their_ids(hd_map, tmp_path: Path) -> None:
    write_signs(tmp_path / "signs.parquet", hd_map.signs, hd_map.sign_id, hd_map.type_names)
    signs, sign_id, _ = read_signs(tmp_path / "signs.parquet")
    assert sign_id == hd_map.sign_id
    torch.testing.assert_close(signs.corners_world, hd_map.signs.corners_world)
    assert torch.equal(signs.n_observations, hd_map.signs.n_observations)
    write_lanes(tmp_path / "lanes.parquet", hd_map.lanes, hd_map.lane_id)
    lanes, lane_id = read_lanes(tmp_path / "lanes.parquet")
    assert lane_id == hd_map.lane_id
    packed = hd_map.lanes.select(torch.arange(len(hd_map.lanes)))
    assert torch.equal(lanes.control.point_world, packed.control.point_world)
    assert torch.equal(lanes.control.sigma, packed.control.sigma)


def test_every_landmark_needs_an_id(hd_map, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 ids for 6 landmarks; expected one for each"):
        write_signs(tmp_path / "signs.parquet", hd_map.signs, ("a",), hd_map.type_names)
    assert not (tmp_path / "signs.parquet").exists()
