"""Worlds that are maps: their markers and signs as they stand, a road along their lanes or along recorded drives."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import KDTree

from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.exporters.carriageways import carriageways
from crowdmap_torch.io.formats.exporters.features import lane_points, sign_type
from crowdmap_torch.simulate.lane_ways import longest_way
from crowdmap_torch.simulate.markers import STEP_M, Markers
from crowdmap_torch.simulate.recordings import Recording
from crowdmap_torch.simulate.roads import SPACING_M, Road
from crowdmap_torch.simulate.signposts import SignConfig, WorldSigns, put_up_signs
from crowdmap_torch.simulate.worlds import World, WorldConfig
from crowdmap_torch.tables import LANE_TYPES, HdMap

LEAST_WAY_M = 60.0
"""Of a way that cars drive: shorter ones show too little of a map [m]."""
_SMOOTH_M = 3.0
"""Ways along lanes are smoothed by this: cars do not turn at once [m]."""
_BESIDE_M = 9.0
"""Markers this near to the way tell how the road leans, and where it ends [m]."""
_BANK_EVERY_M = 2.0
_MAX_BANK = 0.12


def map_world(
    hd_map: HdMap,
    signs: SignConfig,
    rng: np.random.Generator,
    *,
    recordings: tuple[Recording, ...] = (),
    dash_m: float = 4.0,
    gap_m: float = 5.0,
) -> World:
    """A world of a map's markers and signs; signs of `signs` are put up beside the road where the map has none.

    Cars drive the longest way along its lanes, or as `recordings` say. InputError if there are no markers, or no way.
    """
    points = lane_points(hd_map.lanes)
    if not points:
        raise InputError("the map has no lane markers; expected some to drive along")
    if recordings:
        way = recordings[0].way_m()
    else:
        way = longest_way(carriageways(points))
    length = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
    if length < LEAST_WAY_M:
        kind = "first recorded drive" if recordings else "longest way along the map's lanes"
        raise InputError(f"the {kind} is {length:.0f} m; expected {LEAST_WAY_M:.0f} m at least")
    road = _road(way, np.concatenate(points), 1.0 if recordings else _SMOOTH_M)
    spread = 0.0 if recordings else min(30.0, 0.2 * road.length)
    length = max(50.0, road.length - spread - 10.0)
    right, left = _edges(road, np.concatenate(points))
    placed = _signs(hd_map)
    if not len(placed):
        placed = put_up_signs(
            road,
            signs,
            rng,
            stations=(10.0, road.length - 5.0),
            edges=(right, left),
            lane_centres={1: (0.0,)},
        )
    config = WorldConfig(
        name="map", length_m=length, lanes_ahead=1, lanes_back=0, lights_per_km=0.0, signs=signs
    )
    return World(
        config=config,
        road=road,
        markers=_markers(hd_map, points, dash_m, gap_m),
        signs=placed,
        lane_centres={1: (0.0,)},
        lights=np.zeros(0),
        origin=hd_map.origin,
        recordings=recordings,
        is_map=True,
    )


def _road(
    way: Float[np.ndarray, "n 3"], marker_points: Float[np.ndarray, "p 3"], smooth_m: float
) -> Road:
    """A ribbon along a way, which leans as the markers beside it do."""
    steps = np.linalg.norm(np.diff(way, axis=0), axis=1)
    way = way[np.concatenate(([True], steps > 1e-3))]
    centre = _even(way)
    sigma = smooth_m / SPACING_M
    if len(centre) > 8 * sigma:
        # What is left of the way beyond its ends goes straight on, so that smoothing keeps them.
        centre = _even(gaussian_filter1d(_extended(centre, 4 * int(sigma)), sigma, axis=0))
    forward = _unit(np.gradient(centre, axis=0))
    level_left = _unit(np.stack((-forward[:, 1], forward[:, 0], np.zeros(len(forward))), axis=-1))
    bank = _bank(centre, level_left, marker_points)
    left = np.cos(bank)[:, None] * level_left + np.sin(bank)[:, None] * np.cross(
        forward, level_left
    )
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    return Road(
        centre=centre,
        forward=forward,
        left=left,
        left_rate=np.gradient(left, SPACING_M, axis=0),
        curvature=np.gradient(heading, SPACING_M),
        closed=False,
    )


def _even(way: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Points `SPACING_M` apart along a way."""
    along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))))
    at = np.arange(int(along[-1] / SPACING_M) + 1) * SPACING_M
    return np.stack([np.interp(at, along, way[:, k]) for k in range(3)], axis=-1)


def _extended(centre: Float[np.ndarray, "n 3"], count: int) -> Float[np.ndarray, "m 3"]:
    run = np.arange(1, count + 1)[:, None]
    first, last = centre[0] - centre[5], centre[-1] - centre[-6]
    before, after = centre[0] + run[::-1] * first / 5, centre[-1] + run * last / 5
    return np.concatenate((before, centre, after))


def _bank(
    centre: Float[np.ndarray, "n 3"],
    left: Float[np.ndarray, "n 3"],
    marker_points: Float[np.ndarray, "p 3"],
) -> Float[np.ndarray, " n"]:
    """How far the road leans [rad]: the slope across of the markers near each place, level where there are too few."""
    tree = KDTree(marker_points[:, :2])
    rows = np.arange(0, len(centre), round(_BANK_EVERY_M / SPACING_M))
    forward = np.stack((left[:, 1], -left[:, 0]), axis=-1)
    slope = np.zeros(len(rows))
    for k, (row, near) in enumerate(
        zip(rows, tree.query_ball_point(centre[rows, :2], _BESIDE_M), strict=True)
    ):
        away = marker_points[near] - centre[row]
        across, along = away[:, :2] @ left[row, :2], away[:, :2] @ forward[row]
        if len(near) >= 6 and np.ptp(across) > 2.0:
            plane = np.stack((np.ones(len(near)), across, along), axis=-1)
            slope[k] = np.linalg.lstsq(plane, away[:, 2], rcond=None)[0][1]
    smooth = gaussian_filter1d(np.clip(slope, -_MAX_BANK, _MAX_BANK), 3.0)
    return np.arctan(np.interp(np.arange(len(centre)), rows, smooth))


def _edges(road: Road, marker_points: Float[np.ndarray, "p 3"]) -> tuple[float, float]:
    """Offsets of the road's right and left side: of the markers that lie beside the way."""
    nearest = KDTree(road.centre[:, :2]).query(marker_points[:, :2])[1]
    away = marker_points[:, :2] - road.centre[nearest, :2]
    offset = np.sum(away * road.left[nearest, :2], axis=-1)
    offset = offset[np.abs(offset) < _BESIDE_M]
    if not len(offset):
        return -4.0, 4.0
    return min(-2.0, float(np.quantile(offset, 0.02))), max(2.0, float(np.quantile(offset, 0.98)))


def _markers(
    hd_map: HdMap, points: list[Float[np.ndarray, "_ 3"]], dash_m: float, gap_m: float
) -> Markers:
    """The map's markers by their own length; of unknown type: solid."""
    even = []
    for own in points:
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(own, axis=0), axis=1))))
        at = np.arange(max(2, int(along[-1] / STEP_M) + 1)) * min(STEP_M, along[-1])
        even.append(np.stack([np.interp(at, along, own[:, k]) for k in range(3)], axis=-1))
    kinds = tuple("solid" if k < 0 else LANE_TYPES[k] for k in hd_map.lanes.type.tolist())
    count = np.array([len(own) for own in even], dtype=np.int64)
    is_dashed = np.array([kind == "dashed" for kind in kinds], dtype=bool)
    return Markers(
        lane_id=hd_map.lane_id,
        type=kinds,
        start=np.cumsum(count) - count,
        count=count,
        station=np.full(len(even), np.nan),
        dash_m=np.where(is_dashed, dash_m, 0.0),
        gap_m=np.where(is_dashed, gap_m, 0.0),
        is_oncoming=np.zeros(len(even), dtype=bool),
        point=np.concatenate(even),
    )


def _signs(hd_map: HdMap) -> WorldSigns:
    signs = hd_map.signs.to("cpu")
    T = signs.T_world_sign.detach().numpy()
    return WorldSigns(
        sign_id=hd_map.sign_id,
        shape=signs.shape.numpy(),
        code=tuple(sign_type(hd_map, row) for row in range(len(signs))),
        post=np.arange(len(signs)),
        center=T[:, :3, 3],
        R_world_sign=T[:, :3, :3],
        size=signs.size.detach().numpy(),
    )


def _unit(v: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)
