"""Signs and lane markers of a map as features of geographic formats: geometry on WGS84, and what is known in columns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import polygon, se3, spline_length
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.io.landmarks import POINT_SPACING_M
from crowdmap_torch.tables import LANE_TYPES, HdMap, Lanes, Origin, Signs

LAYERS = ("signs", "plates", "lanes")
"""Signs as points, their plates as polygons, lane markers as lines."""


@dataclass(frozen=True)
class Layer:
    """Features of one kind, and what is known of each."""

    name: str
    geometry: str
    """`Point`, `Polygon` (one open ring) or `LineString`."""
    feature_id: tuple[str, ...]
    place: tuple[Float[np.ndarray, "_ 3"], ...]
    """Longitude [deg], latitude [deg] and height above the ellipsoid [m] of every feature's points."""
    columns: dict[str, list]
    """Texts, whole numbers, numbers or None, one for each feature; names and units are those of FORMAT.md."""
    lists: dict[str, list[list]]
    """Columns whose every value is a list, for formats that have room for one."""

    def __len__(self) -> int:
        return len(self.feature_id)


def layers(hd_map: HdMap) -> tuple[Layer, Layer, Layer]:
    """The map as LAYERS."""
    signs, lanes = hd_map.signs.to("cpu"), hd_map.lanes
    columns = _sign_columns(hd_map, signs)
    mask = signs.corner_mask
    corners = [c[m].numpy() for c, m in zip(signs.corners_world, mask, strict=True)]
    points = lane_points(lanes)
    pieces = lanes.select(torch.arange(len(lanes), device=lanes.type.device)).to("cpu")
    count = pieces.control_count.tolist()
    control = pieces.control.point_world.detach().split(count)
    sigma = pieces.control.sigma.split(count)
    names = [None if code < 0 else LANE_TYPES[code] for code in pieces.type.tolist()]
    center = signs.center_world.detach().numpy()[:, None]
    return (
        _layer(hd_map, "signs", "Point", hd_map.sign_id, [*center], columns, {}),
        _layer(
            hd_map,
            "plates",
            "Polygon",
            tuple(f"{name}:plate" for name in hd_map.sign_id),
            corners,
            {"sign_id": list(hd_map.sign_id)} | {n: columns[n] for n in ("shape", "type")},
            {"corners": [c.tolist() for c in corners]},
        ),
        _layer(
            hd_map,
            "lanes",
            "LineString",
            hd_map.lane_id,
            points,
            {"lane_id": list(hd_map.lane_id), "type": names} | _support(pieces),
            {
                "control_points": [c.tolist() for c in control],
                "sigma_m": [s.tolist() for s in sigma],
            },
        ),
    )


def lane_points(lanes: Lanes) -> list[Float[np.ndarray, "_ 3"]]:
    """Points of each piece's spline in the world, as lanes.parquet has them: at most POINT_SPACING_M apart."""
    if not len(lanes):
        return []
    lanes = lanes.select(torch.arange(len(lanes), device=lanes.type.device)).to("cpu")
    point, _, piece = spline_length.sample_flat(
        lanes.control.point_world.detach(), lanes.control_count, POINT_SPACING_M
    )
    count = torch.bincount(piece, minlength=len(lanes)).tolist()
    return [part.numpy() for part in point.split(count)]


def sign_type(hd_map: HdMap, row: int) -> str | None:
    """The traffic-sign code of a sign; None if unknown."""
    code = int(hd_map.signs.type[row])
    return None if code < 0 else hd_map.type_names[code]


def heading_deg(normal_world: Float[Tensor, "n 3"]) -> list[float]:
    """Where signs face: clockwise from north [deg, 0 to 360]."""
    return [math.degrees(math.atan2(e, n)) % 360 for e, n, _ in normal_world.tolist()]


def geographic(
    points_world: list[Float[np.ndarray, "_ 3"]], origin: Origin
) -> tuple[Float[np.ndarray, "_ 3"], ...]:
    """Longitude [deg], latitude [deg] and height [m] of every feature's points."""
    if not points_world:
        return ()
    place = geodetic_from_local(np.concatenate(points_world), origin)[:, [1, 0, 2]]
    return tuple(np.split(place, np.cumsum([len(points) for points in points_world])[:-1]))


def _layer(
    hd_map: HdMap,
    name: str,
    geometry: str,
    feature_id: tuple[str, ...],
    points_world: list[np.ndarray],
    columns: dict[str, list],
    lists: dict[str, list[list]],
) -> Layer:
    places = geographic(points_world, hd_map.origin)
    return Layer(name, geometry, feature_id, places, columns, lists)


def _sign_columns(hd_map: HdMap, signs: Signs) -> dict[str, list]:
    quaternion = se3.to_quaternion(signs.T_world_sign.detach()[:, :3, :3])
    covariance = signs.covariance.detach()
    return {
        "sign_id": list(hd_map.sign_id),
        "shape": [polygon.SHAPES[code] for code in signs.shape.tolist()],
        "type": [sign_type(hd_map, row) for row in range(len(signs))],
        "width_m": signs.size[:, 0].tolist(),
        "height_m": signs.size[:, 1].tolist(),
        "heading_deg": heading_deg(signs.normal_world.detach()),
        **{a: signs.center_world.detach()[:, k].tolist() for k, a in enumerate("xyz")},
        **{f"q{a}": quaternion[:, k].tolist() for k, a in enumerate("xyzw")},
        **{
            f"covariance_{a}{b}": covariance[:, i, j].tolist()
            for i, a in enumerate("enu")
            for j, b in enumerate("enu")
            if i <= j
        },
        **_support(signs),
    }


def _support(table: Signs | Lanes) -> dict[str, list]:
    names = ("n_journeys", "n_observations", "first_seen_ns", "last_seen_ns", "confidence")
    return {name: getattr(table, name).tolist() for name in names}
