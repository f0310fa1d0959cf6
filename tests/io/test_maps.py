"""Maps and surveys: written and read again, column by column, and which line names each fault."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.geometry import polygon, se3, spline
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.tables import ControlPoints, HdMap, Lanes, Origin, Signs

MAP_SIGN_COLUMNS = {
    "sign_id": "string",
    "shape": "string",
    "type": "string",
    "corners": "list<element: list<element: double>>",
    "center": "list<element: double>",
    "normal": "list<element: double>",
    "width_m": "double",
    "height_m": "double",
    "covariance": "list<element: double>",
    "n_journeys": "int64",
    "n_observations": "int64",
    "first_seen_ns": "int64",
    "last_seen_ns": "int64",
    "confidence": "double",
}
MAP_LANE_COLUMNS = {
    "lane_id": "string",
    "type": "string",
    "control_points": "list<element: list<element: double>>",
    "points": "list<element: list<element: double>>",
    "sigma_m": "list<element: double>",
    "n_journeys": "int64",
    "n_observations": "int64",
    "first_seen_ns": "int64",
    "last_seen_ns": "int64",
    "confidence": "double",
}


@pytest.fixture
def hd_map(generator) -> HdMap:
    """One sign of every shape, upright within a few degrees, and two lane pieces."""
    n = len(polygon.SHAPES)
    # Faces west: x to the north's right hand (south), y up, z to the west.
    R = torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    tilt = 0.05 * torch.randn(n, 3, dtype=torch.float64, generator=generator)
    p = 50 * torch.randn(n, 3, dtype=torch.float64, generator=generator)
    A = torch.randn(n, 3, 3, dtype=torch.float64, generator=generator)
    support = torch.arange(n)
    none = torch.full((n,), -1)
    signs = Signs(
        shape=support,
        type=torch.tensor([0, -1, 1, 1, 0, -1]),
        T_world_sign=se3.make(R @ se3.so3_exp(tilt), p),
        size=0.5 + torch.rand(n, 2, dtype=torch.float64, generator=generator),
        covariance=A @ A.mT,
        journey=none,
        tracklet=none,
        frame=none,
        n_journeys=support + 3,
        n_observations=support + 30,
        first_seen_ns=support + 10**18,
        last_seen_ns=support + 2 * 10**18,
        confidence=torch.tensor([0.9, 0.4, 1.0, 0.5, 0.0, 0.7], dtype=torch.float64),
    )
    station = torch.linspace(0, 1, 7, dtype=torch.float64)[:, None]
    curve = torch.cat((30 * station, 4 * station.square(), 0.3 * station), dim=-1)
    lanes = Lanes(
        type=torch.tensor([1, -1]),
        control_start=torch.tensor([2, 0]),
        control_count=torch.tensor([5, 2]),
        journey=none[:2],
        tracklet=none[:2],
        frame=none[:2],
        n_journeys=torch.tensor([3, 4]),
        n_observations=torch.tensor([300, 400]),
        first_seen_ns=torch.tensor([1, 2]),
        last_seen_ns=torch.tensor([3, 4]),
        confidence=torch.tensor([0.9, 0.8], dtype=torch.float64),
        control=ControlPoints(point_world=curve, sigma=0.01 + station[:, 0]),
    )
    return HdMap(
        origin=Origin(32.9, -117.2, 120.0),
        signs=signs,
        lanes=lanes,
        sign_id=tuple(f"s{k}" for k in range(n)),
        lane_id=("l0", "l1"),
        type_names=("DE:274", "US:R1-1"),
        shared_covariance=0.1 * torch.eye(3, dtype=torch.float64),
        provenance={"version": "0.1.0", "journeys": ["a", "b"]},
    )


def schema(path: Path) -> dict[str, str]:
    return {f.name: str(f.type) for f in pq.read_schema(path)}


# --- writing ---------------------------------------------------------------------------------


def test_a_map_has_the_files_and_columns_of_the_format(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map")
    assert sorted(p.name for p in (tmp_path / "map").iterdir()) == [
        "lanes.parquet",
        "map.json",
        "signs.parquet",
        "tentative_signs.parquet",
    ]
    assert schema(tmp_path / "map" / "signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "tentative_signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "lanes.parquet") == MAP_LANE_COLUMNS
    head = json.loads((tmp_path / "map" / "map.json").read_text())
    assert head["format"] == "crowdmap-map"
    assert head["version"] == 1
    assert head["origin"] == {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}
    assert head["shared_covariance"] == [0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]
    assert head["provenance"] == {"version": "0.1.0", "journeys": ["a", "b"]}


def test_improbable_signs_are_tentative(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0.5)
    certain = pq.read_table(tmp_path / "map" / "signs.parquet").column("sign_id").to_pylist()
    tentative = pq.read_table(tmp_path / "map" / "tentative_signs.parquet")
    assert certain == ["s0", "s2", "s3", "s5"]
    assert tentative.column("sign_id").to_pylist() == ["s1", "s4"]


def test_a_map_comes_back_as_it_was_written(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0)
    again = read_map(tmp_path / "map")
    assert again.origin == hd_map.origin
    assert again.sign_id == hd_map.sign_id
    assert again.lane_id == hd_map.lane_id
    assert again.type_names == hd_map.type_names
    assert again.provenance == hd_map.provenance
    # Coordinates of 100 m in float64.
    torch.testing.assert_close(again.shared_covariance, hd_map.shared_covariance)
    for name in ("T_world_sign", "size", "corners_world", "covariance", "confidence"):
        torch.testing.assert_close(
            getattr(again.signs, name), getattr(hd_map.signs, name), atol=1e-12, rtol=1e-12
        )
    support = ("n_journeys", "n_observations", "first_seen_ns", "last_seen_ns")
    for name in ("shape", "type", "journey", "tracklet", "frame", *support):
        assert torch.equal(getattr(again.signs, name), getattr(hd_map.signs, name)), name
    packed = hd_map.lanes.select(torch.arange(2))
    for name in ("type", "control_start", "control_count", "confidence", *support):
        assert torch.equal(getattr(again.lanes, name), getattr(packed, name)), name
    assert torch.equal(again.lanes.control.point_world, packed.control.point_world)
    assert torch.equal(again.lanes.control.sigma, packed.control.sigma)


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
        t = spline.closest_parameter(control, points)
        on_curve = spline.evaluate(control, t)
        # The closest parameter is found by iteration.
        assert (on_curve - points).norm(dim=-1).max() < 1e-6


def test_a_map_without_signs_and_lanes_is_a_map(hd_map, tmp_path: Path) -> None:
    none = torch.zeros(0, dtype=torch.int64)
    empty = replace(
        hd_map,
        signs=hd_map.signs[none],
        lanes=hd_map.lanes.select(none),
        sign_id=(),
        lane_id=(),
        type_names=(),
    )
    write_map(empty, tmp_path / "map")
    assert schema(tmp_path / "map" / "signs.parquet") == MAP_SIGN_COLUMNS
    assert schema(tmp_path / "map" / "lanes.parquet") == MAP_LANE_COLUMNS
    again = read_map(tmp_path / "map")
    assert len(again.signs) == len(again.lanes) == len(again.lanes.control.point_world) == 0
    survey = read_survey(tmp_path / "map")
    assert len(survey.signs) == len(survey.lane_points) == 0


def test_numbers_that_are_not_finite_are_not_written(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map")
    covariance = hd_map.signs.covariance.clone()
    covariance[2, 1, 1] = math.nan
    broken = replace(hd_map, signs=replace(hd_map.signs, covariance=covariance))
    with pytest.raises(ValueError, match=r"covariance: value .* is not finite"):
        write_map(broken, tmp_path / "map")
    # The older map is untouched.
    assert read_map(tmp_path / "map").sign_id == ("s0", "s2", "s3", "s5")


# --- surveys ---------------------------------------------------------------------------------


def test_a_map_is_a_survey(hd_map, tmp_path: Path) -> None:
    write_map(hd_map, tmp_path / "map", min_confidence=0)
    survey = read_survey(tmp_path / "map")
    assert survey.sign_id == hd_map.sign_id
    torch.testing.assert_close(survey.signs.corners_world, hd_map.signs.corners_world)
    torch.testing.assert_close(survey.signs.center_world, hd_map.signs.center_world)
    torch.testing.assert_close(survey.signs.normal_world, hd_map.signs.normal_world)
    assert survey.signs.sigma.tolist() == [0.02] * 6
    assert survey.signs.has_corners.all()
    assert survey.lane_id == hd_map.lane_id
    assert torch.equal(survey.lane_type, hd_map.lanes.type)
    assert survey.lane_points.lane.bincount().tolist()[1] >= 2


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


def flat(corners: list) -> dict:
    return {"sign_id": ["s"], "shape": ["rectangle"], "corners": [corners]}


def sign(**columns: object) -> dict:
    return flat(BOX) | columns


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
    "sigma": (sign(sigma_m=[0.0]), "row 0: column 'sigma_m': expected a number above 0"),
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


@pytest.mark.parametrize("read", [read_map, read_survey])
def test_what_is_no_map_is_refused(tmp_path: Path, read) -> None:
    with pytest.raises(InputError, match="the map's folder is missing"):
        read(tmp_path / "nowhere")
    (tmp_path / "map.json").write_text('{"format": "crowdmap-dataset", "version": 1}')
    with pytest.raises(InputError, match="format: expected 'crowdmap-map'"):
        read(tmp_path)


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


@pytest.mark.parametrize(("drive", "signs"), [("kitti-00", 15), ("kitti-05", 4)])
def test_real_surveys_are_read(real_data, drive, signs) -> None:
    survey = read_survey(real_data("kitti-signs") / drive / "survey")
    assert len(survey.signs) == signs
    assert not survey.signs.has_corners.any()
