from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
import yaml

from crowdmap_torch.io.calibration import read_annotations, read_surveyed_points, write_rig_road
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.road.calibration import RoadCalibration

POINTS = "point,x,y,z,surface\na,1,2,3,wall\nb,4,5.5,0,floor\n"
PIXELS = "picture,point,u,v\np,a,10,20\np,b,30.5,40\nq,a,11,21\n"


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_points_and_pixels_are_read_row_by_row(tmp_path: Path):
    points = read_surveyed_points(write(tmp_path / "points.csv", POINTS))
    assert points.name == ("a", "b")
    assert points.is_floor == (False, True)
    seen = read_annotations(write(tmp_path / "pixels.csv", PIXELS), points)
    assert seen.picture == ("p", "q")
    assert seen.of_picture.tolist() == [0, 0, 1]
    assert seen.point.tolist() == [0, 1, 0]
    assert seen.px.tolist() == [[10.0, 20.0], [30.5, 40.0], [11.0, 21.0]]


def test_csv_and_yaml_say_the_same(tmp_path: Path):
    rows = [
        {"point": "a", "x": 1, "y": 2, "z": 3, "surface": "wall"},
        {"point": "b", "x": 4, "y": 5.5, "z": 0, "surface": "floor"},
    ]
    from_yaml = read_surveyed_points(
        write(tmp_path / "points.yaml", yaml.safe_dump({"points": rows}))
    )
    from_csv = read_surveyed_points(write(tmp_path / "points.csv", POINTS))
    assert (from_yaml.name, from_yaml.is_floor) == (from_csv.name, from_csv.is_floor)
    fields = [v for v in vars(from_csv).values() if isinstance(v, torch.Tensor)]
    others = [v for v in vars(from_yaml).values() if isinstance(v, torch.Tensor)]
    assert all(torch.equal(a, b) for a, b in zip(fields, others, strict=True))


POINT_FAULTS = {
    "twice": (POINTS + "a,1,2,3,wall\n", "row 4: point 'a' is given twice"),
    "surface": (
        POINTS.replace("floor", "roof"),
        "row 3: surface: expected one of wall, floor, found",
    ),
    "number": (
        POINTS.replace("5.5", "high"),
        "row 3: y: expected a finite number, 1e.06 at most, found 'high'",
    ),
    "infinite": (POINTS.replace("5.5", "inf"), "row 3: y: expected a finite number"),
    "cell": (
        POINTS.replace("4,5.5", ",5.5"),
        "row 3: x is missing; expected point, x, y, z, surface",
    ),
    "column": (POINTS.replace("surface", "kind"), "column 'surface' is missing"),
    "empty": ("point,x,y,z,surface\n", "no rows; expected some with columns"),
}


@pytest.mark.parametrize("fault", POINT_FAULTS)
def test_a_fault_of_the_points_names_its_row(tmp_path: Path, fault: str):
    text, rule = POINT_FAULTS[fault]
    with pytest.raises(InputError, match=rf"points\.csv: {rule}"):
        read_surveyed_points(write(tmp_path / "points.csv", text))


PIXEL_FAULTS = {
    "unknown": (PIXELS + "q,c,1,2\n", "row 5: point 'c' is not among the surveyed ones"),
    "twice": (PIXELS + "q,a,1,2\n", "row 5: point 'a' is given twice in picture 'q'"),
    "number": (PIXELS.replace("30.5", "x"), "row 3: u: expected a finite number"),
}


@pytest.mark.parametrize("fault", PIXEL_FAULTS)
def test_a_fault_of_the_pixels_names_its_row(tmp_path: Path, fault: str):
    points = read_surveyed_points(write(tmp_path / "points.csv", POINTS))
    text, rule = PIXEL_FAULTS[fault]
    with pytest.raises(InputError, match=rf"pixels\.csv: {rule}"):
        read_annotations(write(tmp_path / "pixels.csv", text), points)


@pytest.mark.parametrize("section", ["road:\n  normal: [0.0, 1.0, 0.0]\n\n  height_m: 1.4\n", ""])
def test_the_section_of_the_road_is_replaced_or_added_and_all_else_stays(
    tmp_path: Path, section: str
):
    before, after = (
        "# our first car\ncamera:\n  fx: 1000.0  # a guess\n",
        "mount:\n  urdf: rig.urdf\n",
    )
    path = write(tmp_path / "rig.yaml", before + section + after)
    normal = torch.tensor([0.0, math.cos(0.1), math.sin(0.1)], dtype=torch.float64)
    road = RoadCalibration(
        normal_camera=normal,
        height=1.47,
        sigma_deg=0.1,
        sigma_height=0.01,
        picture=(),
        rms_px=(),
        off_deg=(),
    )
    write_rig_road(path, road)
    text = path.read_text(encoding="utf-8")
    read = yaml.safe_load(text)
    assert read["road"] == {"normal": normal.tolist(), "height_m": 1.47}
    assert read["mount"] == {"urdf": "rig.urdf"}
    assert text.startswith(before) and after in text
    write_rig_road(path, road)
    assert path.read_text(encoding="utf-8") == text
