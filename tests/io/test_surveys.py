from __future__ import annotations

import json
import math
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.io.surveys import read_survey

BOX = [[0.0, 1.0, 3.0], [0.0, -1.0, 3.0], [0.0, -1.0, 2.0], [0.0, 1.0, 2.0]]
"""A rectangle that faces west, clockwise for a driver who comes from there."""


POINTS = pa.list_(pa.list_(pa.float64()))


POINT = pa.list_(pa.float64())


def write_survey(folder: Path, signs: dict | None, lanes: dict | None = None) -> Path:
    folder.mkdir()
    head = {"format": "crowdmap-map", "version": 1}
    head["origin"] = {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}
    (folder / "map.json").write_text(json.dumps(head))
    kinds = {"corners": POINTS, "points": POINTS, "center": POINT, "normal": POINT}
    for name, columns in (("signs", signs), ("lanes", lanes)):
        if columns is not None:
            arrays = {k: pa.array(v, kinds.get(k)) for k, v in columns.items()}
            pq.write_table(pa.table(arrays), folder / f"{name}.parquet")
    return folder


def flat(corners: list) -> dict:
    return {"sign_id": ["s"], "shape": ["rectangle"], "corners": [corners]}


def sign(**columns: object) -> dict:
    return flat(BOX) | columns


def test_a_survey_needs_little(tmp_path: Path) -> None:
    signs = {"sign_id": ["s"], "shape": ["rectangle"], "corners": [BOX]}
    lanes = {"lane_id": ["l"], "points": [[[0.0, 0, 0], [1.0, 0, 0], [2.0, 1, 0]]]}
    survey = read_survey(write_survey(tmp_path / "survey", signs, lanes))
    assert survey.signs.center_world.tolist() == [[0.0, 0.0, 2.5]]
    # A driver who comes from the west sees a box whose north side is left: it faces west.
    assert survey.signs.normal_world.tolist() == [[-1.0, 0.0, 0.0]]
    assert survey.lane_type.tolist() == [-1]
    assert survey.lane_points.lane.tolist() == [0, 0, 0]


@pytest.mark.parametrize("present", ["signs", "lanes"])
def test_either_file_of_a_survey_may_be_missing(tmp_path: Path, present) -> None:
    signs = {"sign_id": ["s"], "shape": ["rectangle"], "corners": [BOX]}
    lanes = {"lane_id": ["l"], "points": [[[0.0, 0, 0], [1.0, 0, 0]]]}
    folder = write_survey(
        tmp_path / "survey",
        signs if present == "signs" else None,
        lanes if present == "lanes" else None,
    )
    survey = read_survey(folder)
    assert (len(survey.signs), len(survey.lane_id)) == ((1, 0) if present == "signs" else (0, 1))


def test_a_surveyed_sign_may_give_its_centre_only(tmp_path: Path) -> None:
    columns = {
        "sign_id": ["s", "t", "u"],
        "shape": ["rectangle", "octagon", "triangle"],
        "corners": [BOX, None, None],
        "center": [None, [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
        "normal": [None, [0.0, 1.0, 0.0], None],
        "sigma_m": [0.01, None, 0.05],
    }
    signs = read_survey(write_survey(tmp_path / "survey", columns)).signs
    assert signs.has_corners.tolist() == [True, False, False]
    assert signs.center_world.tolist() == [[0.0, 0.0, 2.5], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]
    assert signs.normal_world[:2].tolist() == [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    assert signs.normal_world[2].isnan().all()
    assert signs.sigma.tolist() == [0.01, 0.02, 0.05]


def test_a_survey_without_a_corners_column_is_read(tmp_path: Path) -> None:
    columns = {"sign_id": ["s"], "shape": ["rectangle"], "center": [[1.0, 2.0, 3.0]]}
    signs = read_survey(write_survey(tmp_path / "survey", columns)).signs
    assert signs.center_world.tolist() == [[1.0, 2.0, 3.0]]
    assert not signs.has_corners.any()


def test_a_survey_can_be_read_as_a_map(tmp_path: Path) -> None:
    signs = {"sign_id": ["s"], "shape": ["rectangle"], "corners": [BOX]}
    lanes = {"lane_id": ["l"], "points": [[[0.0, 0, 0], [1.0, 0, 0], [2.0, 1, 0]]]}
    hd_map = read_map(write_survey(tmp_path / "survey", signs, lanes))
    torch.testing.assert_close(hd_map.signs.size, torch.tensor([[2.0, 1.0]], dtype=torch.float64))
    corners = hd_map.signs.corners_world[0, :4]
    torch.testing.assert_close(corners, torch.tensor(BOX, dtype=torch.float64))
    assert hd_map.signs.confidence.tolist() == [1.0]
    assert hd_map.lanes.control_count.tolist() == [3]


SURVEY_FAULTS = {
    "id twice": (
        {"sign_id": ["s", "s"], "shape": ["rectangle"] * 2, "corners": [BOX] * 2},
        "signs.parquet: row 1: column 'sign_id': 's' stands in row 0 too",
    ),
    "id empty": (sign(sign_id=[""]), "row 0: column 'sign_id': expected a name"),
    "id null": (sign(sign_id=pa.array([None], pa.string())), "row 0: column 'sign_id' is null"),
    "shape": (sign(shape=["round"]), "row 0: column 'shape': 'round' is unknown"),
    "corner count": (flat(BOX[:3]), "row 0: rectangle with 3 corners; expected 4"),
    "no corners": (flat([]), "row 0: neither corners nor a center"),
    "two numbers": (flat([[0.0, 1.0]] * 4), "row 0: column 'corners': a point has 2 numbers"),
    "NaN": (flat([[math.nan, 1.0, 2.0], *BOX[1:]]), "row 0: column 'corners': expected finite"),
    "null point": (flat([None, *BOX[1:]]), "row 0: column 'corners': a point is null"),
    "a line": (flat([[float(k), 0.0, 0.0] for k in range(4)]), "row 0: .*they lie on a line"),
    "neither": (
        {"sign_id": ["s"], "shape": ["rectangle"]},
        "signs.parquet: row 0: neither corners nor a center",
    ),
    "centre of two": (sign(center=[[1.0, 2.0]]), "row 0: column 'center': expected 3 numbers"),
    "normal length": (sign(normal=[[-2.0, 0.0, 0.0]]), "row 0: column 'normal': expected a unit"),
    "anticlockwise": (sign(normal=[[1.0, 0.0, 0.0]]), "row 0: corners run anticlockwise"),
    "sigma": (sign(sigma_m=[0.0]), "row 0: column 'sigma_m': expected 1e-06 to"),
}


@pytest.mark.parametrize("fault", SURVEY_FAULTS)
def test_a_fault_of_a_survey_is_one_line(tmp_path: Path, fault) -> None:
    columns, reason = SURVEY_FAULTS[fault]
    folder = write_survey(tmp_path / "survey", columns)
    with pytest.raises(InputError, match=reason) as error:
        read_survey(folder)
    assert "\n" not in str(error.value)


LANE_FAULTS = {
    "one point": ([[[0.0, 0, 0]]], "lanes.parquet: row 0: column 'points': 1 points"),
    "null": ([None], "lanes.parquet: row 0: column 'points' is null"),
    "flat": ([[[0.0, 0], [1.0, 0]]], "row 0: column 'points': a point has 2 numbers"),
    "infinite": ([[[0.0, 0, 0], [math.inf, 0, 0]]], "row 0: column 'points': expected finite"),
}


@pytest.mark.parametrize("fault", LANE_FAULTS)
def test_a_fault_of_a_surveyed_lane_is_one_line(tmp_path: Path, fault) -> None:
    points, reason = LANE_FAULTS[fault]
    folder = write_survey(tmp_path / "survey", None, {"lane_id": ["l"], "points": points})
    with pytest.raises(InputError, match=reason):
        read_survey(folder)


def test_a_folder_without_signs_and_lanes_is_no_survey(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"neither signs\.parquet nor lanes\.parquet"):
        read_survey(write_survey(tmp_path / "survey", None))


@pytest.mark.parametrize(("drive", "signs"), [("kitti-00", 15), ("kitti-05", 4)])
def test_real_surveys_are_read(real_data, drive, signs) -> None:
    survey = read_survey(real_data("kitti-signs") / drive / "survey")
    assert len(survey.signs) == signs
    assert not survey.signs.has_corners.any()
