"""Maps as FORMAT.md has them: made of what the mapper found, and on disk, a folder complete or not there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.area import Area
from crowdmap_torch.io.atomic import atomic_folder
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.columns import MAX_PLACE_M
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import write_json
from crowdmap_torch.io.landmark_ids import lane_ids, sign_ids
from crowdmap_torch.io.landmarks import read_lanes, read_signs, write_lanes, write_signs
from crowdmap_torch.io.map_heads import MAP_FORMAT, read_map_head
from crowdmap_torch.io.tiled_maps import split_map
from crowdmap_torch.io.tiled_sheets import TiledFile, landmark_file
from crowdmap_torch.tables import Association, Dataset, HdMap, Lanes, Signs, concatenate

MIN_CONFIDENCE = 0.5
"""Signs that are less probable than this are tentative."""


def as_map(
    dataset: Dataset,
    signs: Signs,
    lanes: Lanes,
    tentative: Signs,
    associations: Sequence[Association],
    shared: Float[Tensor, "3 3"],
    provenance: dict,
) -> HdMap:
    """Signs and lanes with their identifiers, corners in the order of FORMAT.md, tentative signs behind the others."""
    every = concatenate([signs, tentative])
    journeys = dataset.journeys
    T_world_sign, size = polygon.canonical(every.T_world_sign, every.size, every.shape)
    return HdMap(
        origin=dataset.origin,
        signs=replace(every, T_world_sign=T_world_sign, size=size),
        lanes=lanes,
        sign_id=sign_ids(journeys, associations, every),
        lane_id=lane_ids(journeys, associations, lanes),
        type_names=dataset.type_names,
        shared_covariance=shared,
        provenance=provenance,
    )


def certain_part(hd_map: HdMap, min_confidence: float) -> HdMap:
    """The map without its tentative signs: what readers of signs.parquet see."""
    kept = torch.nonzero(hd_map.signs.confidence >= min_confidence)[:, 0]
    names = tuple(hd_map.sign_id[row] for row in kept.tolist())
    return replace(hd_map, signs=hd_map.signs[kept], sign_id=names)


def write_map(
    hd_map: HdMap,
    path: Path | str,
    *,
    min_confidence: float = MIN_CONFIDENCE,
    tile_level: int | None = None,
) -> None:
    """Writes a map; an older one at `path` stays untouched until the new one is complete.

    Signs less probable than `min_confidence` go to `tentative_signs.parquet`. With `tile_level` the map is in tiles of that
    level of `geometry.quadtree`.
    """
    with atomic_folder(Path(path)) as folder:
        signs = hd_map.signs.to("cpu")
        is_certain = signs.confidence >= min_confidence
        for name, chosen in (("signs", is_certain), ("tentative_signs", ~is_certain)):
            rows = chosen.nonzero()[:, 0]
            ids = [hd_map.sign_id[row] for row in rows.tolist()]
            write_signs(folder / f"{name}.parquet", signs[rows], ids, hd_map.type_names)
        write_lanes(folder / "lanes.parquet", hd_map.lanes, hd_map.lane_id)
        write_json(
            folder / "map.json",
            {
                "format": MAP_FORMAT,
                "version": 1,
                "origin": asdict(hd_map.origin),
                "shared_covariance": hd_map.shared_covariance.detach().cpu().flatten().tolist(),
                "provenance": hd_map.provenance,
            },
        )
        if tile_level is not None:
            split_map(folder, tile_level)


def read_map(path: Path | str, *, area: Area | None = None) -> HdMap:
    """A map with its certain signs, in one piece or in tiles; InputError for what breaks FORMAT.md.

    What a survey may leave out is filled in: no observations, confidence 1, the default sigma, no
    shared part. With `area` the signs whose centre is inside alone, and the lane pieces with a control point inside;
    of a map in tiles only those are read that hold something there.
    """
    folder = Path(path)
    with reading(inside=folder):
        return _read_map(folder, area)


def _read_map(folder: Path, area: Area | None) -> HdMap:
    head = read_map_head(folder)
    shared = [0.0] * 9
    if "shared_covariance" in head.content:
        shared = head.numbers("shared_covariance", 9, most=MAX_PLACE_M**2)
    sources = [landmark_file(folder, head, kind) for kind in ("signs", "lanes")]
    if area is not None:
        sources = [s.touching(area) if isinstance(s, TiledFile) else s for s in sources]
    signs, sign_id, type_names = read_signs(sources[0])
    lanes, lane_id = read_lanes(sources[1])
    hd_map = HdMap(
        origin=read_origin(head),
        signs=signs,
        lanes=lanes,
        sign_id=sign_id,
        lane_id=lane_id,
        type_names=type_names,
        shared_covariance=torch.tensor(shared, dtype=torch.float64).reshape(3, 3),
        provenance=head.part("provenance").content if "provenance" in head.content else {},
    )
    return hd_map if area is None else _part(hd_map, area)


def _part(hd_map: HdMap, area: Area) -> HdMap:
    """What of a map lies in an area; codes of signs are those that its signs have."""
    signs, lanes = hd_map.signs, hd_map.lanes
    kept = area.holds(signs.center_world).nonzero()[:, 0]
    near = torch.zeros(len(lanes), dtype=torch.bool)
    piece = torch.arange(len(lanes)).repeat_interleave(lanes.control_count)
    near[piece[area.holds(lanes.control.point_world)]] = True
    pieces = near.nonzero()[:, 0]
    code, type_of = signs.type[kept].unique(return_inverse=True)
    known = code[code >= 0].tolist()
    return replace(
        hd_map,
        signs=replace(signs[kept], type=type_of - int((code < 0).sum())),
        lanes=lanes.select(pieces),
        sign_id=tuple(hd_map.sign_id[k] for k in kept.tolist()),
        lane_id=tuple(hd_map.lane_id[k] for k in pieces.tolist()),
        type_names=tuple(hd_map.type_names[k] for k in known),
    )
