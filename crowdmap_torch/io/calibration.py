"""Tables of an offline calibration (IV-C), and its result in rig.yaml.

`points`: columns point, x, y, z [m, any frame of the room], surface (`wall` or `floor`). `pixels`:
columns picture, point, u, v [raw pixels]. Both as CSV with a header, or as YAML: a list of mappings
with these keys under `points` or `pixels`.
"""

from __future__ import annotations

import csv
import io
import math
import re
from pathlib import Path

import torch

from crowdmap_torch.io.atomic import atomic_file
from crowdmap_torch.io.budget import read_text
from crowdmap_torch.io.columns import MAX_PLACE_M
from crowdmap_torch.io.documents import read_yaml
from crowdmap_torch.io.errors import InputError, one_line
from crowdmap_torch.ranges import shown
from crowdmap_torch.road.calibration import Annotations, RoadCalibration, SurveyedPoints

SURFACES = ("wall", "floor")
_POINT_COLUMNS = ("point", "x", "y", "z", "surface")
_PIXEL_COLUMNS = ("picture", "point", "u", "v")


def read_surveyed_points(path: Path) -> SurveyedPoints:
    """The surveyed points of a file; InputError names the row that is wrong."""
    rows = _read_rows(path, "points", _POINT_COLUMNS)
    names: dict[str, int] = {}
    position, is_floor = [], []
    for number, row in rows:
        name, surface = str(row["point"]), row["surface"]
        if name in names:
            raise InputError(f"{path}: row {number}: point {name!r} is given twice")
        if surface not in SURFACES:
            raise InputError(
                f"{path}: row {number}: surface: expected one of {', '.join(SURFACES)}, found {surface!r}"
            )
        names[name] = number
        position.append([_number(path, number, row, axis) for axis in ("x", "y", "z")])
        is_floor.append(surface == "floor")
    at = torch.tensor(position, dtype=torch.float64).reshape(-1, 3)
    return SurveyedPoints(tuple(names), at, tuple(is_floor))


def read_annotations(path: Path, points: SurveyedPoints) -> Annotations:
    """The pixels of a file; InputError names the row that is wrong."""
    rows = _read_rows(path, "pixels", _PIXEL_COLUMNS)
    index = {name: k for k, name in enumerate(points.name)}
    pictures: dict[str, int] = {}
    of_picture, point, px = [], [], []
    seen = set()
    for number, row in rows:
        name = str(row["point"])
        if name not in index:
            raise InputError(f"{path}: row {number}: point {name!r} is not among the surveyed ones")
        picture = str(row["picture"])
        if (picture, name) in seen:
            raise InputError(
                f"{path}: row {number}: point {name!r} is given twice in picture {picture!r}"
            )
        seen.add((picture, name))
        of_picture.append(pictures.setdefault(picture, len(pictures)))
        point.append(index[name])
        px.append([_number(path, number, row, axis) for axis in ("u", "v")])
    return Annotations(
        picture=tuple(pictures),
        of_picture=torch.tensor(of_picture, dtype=torch.int64),
        point=torch.tensor(point, dtype=torch.int64),
        px=torch.tensor(px, dtype=torch.float64).reshape(-1, 2),
    )


def write_rig_road(path: Path, calibration: RoadCalibration) -> None:
    """Writes the section `road` of a rig.yaml, or replaces it; everything else stays as it is."""
    text = read_text(path)
    normal = ", ".join(repr(x) for x in calibration.normal_camera.tolist())
    road = f"road:\n  normal: [{normal}]\n  height_m: {calibration.height!r}\n"
    # The section reaches to the next line that begins at the margin.
    changed, count = re.subn(
        r"^road:.*\n?(?:(?:[ \t].*|[ \t]*)(?:\n|\Z))*?(?=^\S|\Z)", road, text, flags=re.M
    )
    if not count:
        changed = text + ("" if text.endswith("\n") or not text else "\n") + road
    with atomic_file(path) as beside:
        beside.write_text(changed, encoding="utf-8")


def _read_rows(
    path: Path, key: str, columns: tuple[str, ...]
) -> list[tuple[int, dict[str, object]]]:
    """Rows with their numbers in the file, all columns there."""
    if path.suffix.lower() in (".yaml", ".yml"):
        document = read_yaml(path)
        entries = document.take(key)
        if not isinstance(entries, list) or not all(isinstance(e, dict) for e in entries):
            raise document.fault(f"expected a list of mappings with keys {', '.join(columns)}", key)
        rows = [(k + 1, dict(e)) for k, e in enumerate(entries)]
    else:
        rows = _read_csv(path, columns)
    for number, row in rows:
        for column in columns:
            if row.get(column) in (None, ""):
                raise InputError(
                    f"{path}: row {number}: {column} is missing; expected {', '.join(columns)}"
                )
    if not rows:
        raise InputError(f"{path}: no rows; expected some with columns {', '.join(columns)}")
    return rows


def _read_csv(path: Path, columns: tuple[str, ...]) -> list[tuple[int, dict[str, object]]]:
    try:
        reader = csv.DictReader(io.StringIO(read_text(path), newline=""), skipinitialspace=True)
        head = tuple(reader.fieldnames or ())
        missing = [c for c in columns if c not in head]
        if missing:
            raise InputError(
                f"{path}: column {missing[0]!r} is missing; expected {', '.join(columns)}"
            )
        return [(reader.line_num, dict(row)) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read as CSV ({one_line(error)})") from error


def _number(path: Path, number: int, row: dict[str, object], column: str) -> float:
    value = row[column]
    try:
        result = float(value) if isinstance(value, str | int | float) else math.nan
    except (ValueError, OverflowError):
        result = math.nan
    if not abs(result) <= MAX_PLACE_M:
        raise InputError(
            f"{path}: row {number}: {column}: expected a finite number, {MAX_PLACE_M:g} at most, "
            f"found {shown(value)}"
        )
    return result
