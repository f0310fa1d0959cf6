"""Logs of Argoverse 2 (sensor data set): poses of the car, one of its cameras, and painted lane boundaries as a survey.

The city's frame is a UTM grid moved to the city's origin: it is turned to true north at the data set's origin, lengths stay
as they are. Images are named by their time: `--images ns`. The camera is that of `--camera` (ring_front_center if nobody
says); its height over the road is that over the map's lane boundaries where the car drove.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import KDTree

from crowdmap_torch.geometry.camera import Camera
from crowdmap_torch.io.documents import Document, read_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing import utm
from crowdmap_torch.io.formats.composing.feather import Feather
from crowdmap_torch.io.formats.composing.lines import rotations
from crowdmap_torch.io.formats.composing.parts import (
    Asked,
    CarRig,
    Importer,
    Parts,
    SurveyRows,
    Track,
)
from crowdmap_torch.io.formats.composing.sources import file_in, the_one
from crowdmap_torch.tables import LANE_TYPES, Origin

_CITIES = {
    "ATX": (14, 30.27464237939507, -97.7404457407424),
    "DTW": (17, 42.29993066912924, -83.17555750783717),
    "MIA": (17, 25.77452579915163, -80.19656914449405),
    "PAO": (10, 37.416065, -122.13571963362166),
    "PIT": (17, 40.44177902989321, -80.01294377242584),
    "WDC": (18, 38.889377, -77.0355047439081),
}
"""UTM zone and origin of each city's frame, as the data set's own tools have them."""
_QUATERNION, _PLACE = ("qx", "qy", "qz", "qw"), ("tx_m", "ty_m", "tz_m")
_TYPES = {"SOLID": "solid", "DASHED": "dashed", "DOUBLE": "double"}
_NEAR_M = 3.0
"""Lane boundaries this near to the car, from above, are the road under it."""


def read(sources: tuple[Path, ...], asked: Asked) -> Parts:
    """Poses, rig and survey of one log."""
    log = the_one(sources, "the folder of a log, with city_SE3_egovehicle.feather in it")
    T_city_ego, t_ns = _poses(file_in(log, "city_SE3_egovehicle.feather"))
    head, zone, city_grid = _map(log)
    place = utm.geodetic_from_grid(city_grid + T_city_ego[0, :2, 3], zone)
    lat, lon = place.tolist()
    origin = asked.origin or Origin(lat, lon, float(T_city_ego[0, 2, 3]))
    T_enu_city = _turn_to_north(origin, zone, city_grid)
    lanes = _boundaries(head)
    track = Track(log, t_ns, T_enu_city @ T_city_ego)
    points = [p @ T_enu_city[:3, :3].T + T_enu_city[:3, 3] for p in lanes.lane_points]
    every = np.concatenate([_points(head, key) for key in head.content])
    rig = _rig(log, asked.camera or "ring_front_center", _road_below(T_city_ego, every))
    survey = replace(lanes, lane_points=tuple(points))
    return Parts(track=track, rig=rig, survey=survey, origin=origin)


def _transforms(table: Feather) -> Float[np.ndarray, "n 4 4"]:
    values = table.numbers((*_QUATERNION, *_PLACE))
    T = np.tile(np.eye(4), (len(values), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotations(values[:, :4].copy()), values[:, 4:]
    return T


def _poses(path: Path) -> tuple[Float[np.ndarray, "n 4 4"], np.ndarray]:
    table = Feather(path, ("timestamp_ns", *_QUATERNION, *_PLACE))
    t_ns = table.integers("timestamp_ns")
    if not len(t_ns):
        raise InputError(f"{path}: has no rows; expected one for each time")
    T = _transforms(table)
    if (stays := np.diff(t_ns) <= 0).any():
        row = int(stays.argmax()) + 1
        raise InputError(f"{path}: row {row}: its time is not after that of the row before")
    return T, t_ns


def _map(log: Path) -> tuple[Document, int, Float[np.ndarray, " 2"]]:
    """The lane segments, the UTM zone, and the grid place of the city's origin."""
    files = sorted((log / "map").glob("log_map_archive_*.json"))
    if len(files) != 1:
        raise InputError(
            f"{log / 'map'}: {len(files)} files log_map_archive_*.json; expected one: it names the city"
        )
    named = re.search(r"__([A-Z]{3})_city", files[0].name)
    if named is None or named[1] not in _CITIES:
        raise InputError(
            f"{files[0]}: its name has no city; expected ____CITY_city_NUMBER.json with one of "
            f"{', '.join(_CITIES)}"
        )
    zone, lat, lon = _CITIES[named[1]]
    grid = utm.grid_from_geodetic(np.array([lat, lon]), zone)
    return read_json(files[0]).part("lane_segments"), zone, grid


def _turn_to_north(
    origin: Origin, zone: int, city_grid: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, "4 4"]:
    """T_enu_city: a turn about the vertical at the origin, and a shift."""
    place = np.array([origin.lat_deg, origin.lon_deg])
    angle = utm.convergence(place, zone)
    cos, sin = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    # Grid north lies clockwise of true north: the grid's axes are turned clockwise.
    T[:2, :2] = [[cos, sin], [-sin, cos]]
    city = np.array([*(utm.grid_from_geodetic(place, zone) - city_grid), origin.height_m])
    T[:3, 3] = -T[:3, :3] @ city
    return T


def _boundaries(head: Document) -> SurveyRows:
    """Painted boundaries in the city's frame; one that two lanes share comes once."""
    names, types, lines = [], [], []
    known: set[tuple] = set()
    for key in head.content:
        segment = head.part(key)
        for side in ("left", "right"):
            mark = segment.text(f"{side}_lane_mark_type")
            if mark in ("NONE", "UNKNOWN"):
                continue
            points = _line(segment, f"{side}_lane_boundary")
            ends = tuple(map(tuple, np.round(points, 1).tolist()))
            if min(ends, ends[::-1]) in known:
                continue
            known.add(min(ends, ends[::-1]))
            names.append(f"{key}-{side}")
            # Two lines of which one is solid, or both, are one marker of two.
            kind = "DOUBLE" if mark.count("SOLID") + mark.count("DASH") > 1 else mark.split("_")[0]
            kind = _TYPES.get(kind)
            types.append(-1 if kind is None else LANE_TYPES.index(kind))
            lines.append(points)
    return SurveyRows(
        source=head.path,
        lane_id=tuple(names),
        lane_type=np.array(types, dtype=np.int64),
        lane_points=tuple(lines),
        sign_id=(),
        sign_shape=np.zeros(0, dtype=np.int64),
        sign_code=(),
        sign_corners=(),
    )


def _points(head: Document, key: str) -> Float[np.ndarray, "p 3"]:
    segment = head.part(key)
    sides = [_line(segment, f"{side}_lane_boundary") for side in ("left", "right")]
    return np.concatenate(sides)


def _line(segment: Document, key: str) -> Float[np.ndarray, "p 3"]:
    listed = segment.take(key)
    if not isinstance(listed, list) or len(listed) < 2:
        raise segment.fault("expected a list of two points or more", key)
    rows = []
    for number, one in enumerate(listed):
        point = Document(segment.path, one, f"{segment.section}.{key}[{number}]")
        rows.append([point.number(axis, low=-1e6, high=1e6) for axis in "xyz"])
    return np.array(rows)


def _road_below(
    T_city_ego: Float[np.ndarray, "n 4 4"], points_city: Float[np.ndarray, "p 3"]
) -> float | None:
    """How far the road lies below the origin of the car's frame [m]; None if no lane boundary is near its way."""
    distance, nearest = KDTree(points_city[:, :2]).query(T_city_ego[:, :2, 3])
    near = distance < _NEAR_M
    if not near.any():
        return None
    T = np.linalg.inv(T_city_ego[near])
    point_city = points_city[np.asarray(nearest)[near]]
    below = (T[:, :3, :3] @ point_city[..., None])[..., 0] + T[:, :3, 3]
    return float(-np.median(below[:, 2]))


def _rig(log: Path, camera: str, road_below: float | None) -> CarRig:
    lenses = file_in(log, "calibration/intrinsics.feather")
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3", "width_px", "height_px")
    table = Feather(lenses, ("sensor_name", *names))
    fx, fy, cx, cy, k1, k2, k3, width, height = table.numbers(names)[
        table.row("sensor_name", camera)
    ]
    places = file_in(log, "calibration/egovehicle_SE3_sensor.feather")
    sensors = Feather(places, ("sensor_name", *_QUATERNION, *_PLACE))
    T_ego_camera = _transforms(sensors)[sensors.row("sensor_name", camera)]
    lens = Camera(
        "brown_conrady",
        int(width),
        int(height),
        torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], dtype=torch.float64),
        torch.tensor([k1, k2, 0, 0, k3], dtype=torch.float64),
    )
    over_road = None if road_below is None else float(T_ego_camera[2, 3] + road_below)
    return CarRig(camera, lens, T_ego_camera, camera_height=over_road)


IMPORTER = Importer(
    summary="a log of Argoverse 2; --camera ring_front_center, --images ns",
    gives=("poses", "rig", "survey"),
    tested_on="real files",
    read=read,
)
