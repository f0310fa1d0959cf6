"""Maps on disk: a folder with `map.json`, signs and lanes (FORMAT.md), complete or not there."""

from __future__ import annotations

from pathlib import Path

import torch

from crowdmap_torch.io.atomic import atomic_folder
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import Document, read_json, write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.landmarks import read_lanes, read_signs, write_lanes, write_signs
from crowdmap_torch.tables import HdMap

MAP_FORMAT = "crowdmap-map"
MIN_CONFIDENCE = 0.5
"""Signs that are less probable than this are tentative."""


def write_map(hd_map: HdMap, path: Path | str, *, min_confidence: float = MIN_CONFIDENCE) -> None:
    """Writes a map; an older one at `path` stays untouched until the new one is complete.

    Signs less probable than `min_confidence` go to `tentative_signs.parquet`.
    """
    with atomic_folder(Path(path)) as folder:
        signs = hd_map.signs.to("cpu")
        is_certain = signs.confidence >= min_confidence
        for name, chosen in (("signs", is_certain), ("tentative_signs", ~is_certain)):
            rows = chosen.nonzero()[:, 0]
            ids = [hd_map.sign_id[row] for row in rows.tolist()]
            write_signs(folder / f"{name}.parquet", signs[rows], ids, hd_map.type_names)
        write_lanes(folder / "lanes.parquet", hd_map.lanes, hd_map.lane_id)
        origin = hd_map.origin
        write_json(
            folder / "map.json",
            {
                "format": MAP_FORMAT,
                "version": 1,
                "origin": {
                    "lat_deg": origin.lat_deg,
                    "lon_deg": origin.lon_deg,
                    "height_m": origin.height_m,
                },
                "shared_covariance": hd_map.shared_covariance.detach().cpu().flatten().tolist(),
                "provenance": hd_map.provenance,
            },
        )


def read_map(path: Path | str) -> HdMap:
    """A map with its certain signs; InputError for what breaks FORMAT.md.

    What a survey may leave out is filled in: no observations, confidence 1, the default sigma, no
    shared part.
    """
    folder = Path(path)
    head = read_map_head(folder)
    shared = [0.0] * 9
    if "shared_covariance" in head.content:
        shared = head.numbers("shared_covariance", 9)
    signs, sign_id, type_names = read_signs(folder / "signs.parquet")
    lanes, lane_id = read_lanes(folder / "lanes.parquet")
    return HdMap(
        origin=read_origin(head),
        signs=signs,
        lanes=lanes,
        sign_id=sign_id,
        lane_id=lane_id,
        type_names=type_names,
        shared_covariance=torch.tensor(shared, dtype=torch.float64).reshape(3, 3),
        provenance=head.part("provenance").content if "provenance" in head.content else {},
    )


def read_map_head(folder: Path) -> Document:
    """The `map.json` of a map or survey, its format checked."""
    if not folder.is_dir():
        raise InputError(f"{folder}: the map's folder is missing; expected map.json in it")
    head = read_json(folder / "map.json")
    head.require_format(MAP_FORMAT)
    return head
