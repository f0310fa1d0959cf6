"""Maps in tiles, as they are written: the files of a map in one piece cut by tile, and put together again, row for row."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from crowdmap_torch.geometry.quadtree import MAX_LEVEL
from crowdmap_torch.io.atomic import atomic_folder
from crowdmap_torch.io.budget import reading
from crowdmap_torch.io.columns import Sheet
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import read_json, write_json
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.map_heads import read_map_head
from crowdmap_torch.io.tiled_sheets import (
    PLACES,
    SCHEME,
    TiledFile,
    landmark_file,
    landmark_places,
    opened,
    refuse_unlike,
    tile_names,
)
from crowdmap_torch.ranges import Range
from crowdmap_torch.tables import Origin

TileLevel = Annotated[int, Range(1, MAX_LEVEL, "levels of the quadtree of tiles")]
DEFAULT_LEVEL = 14
"""Tiles of 2.4 km from south to north: finer ones cost bytes and files (SCALE.md), as every tile has all kinds of them."""


def split_map(folder: Path, level: int) -> None:
    """Puts a map in one piece, in a folder that nobody reads yet, into tiles: each landmark into that of its place.

    A map without any landmark has the tile of its origin, whose files have no rows.
    """
    head = read_json(folder / "map.json")
    origin = read_origin(head)
    kinds = [kind for kind in PLACES if (folder / f"{kind}.parquet").exists()]
    cut = {kind: _cut(folder / f"{kind}.parquet", kind, origin, level) for kind in kinds}
    names = sorted({name for one in cut.values() for name in one.names})
    names = names or [*tile_names(np.zeros((1, 3)), origin, level)]
    for name in names:
        (folder / "tiles" / name).mkdir(parents=True)
        for kind, one in cut.items():
            pq.write_table(one.table_of(name), folder / "tiles" / name / f"{kind}.parquet")
    for kind in kinds:
        (folder / f"{kind}.parquet").unlink()
    index = [
        {
            "quadkey": name,
            **{kind: len(one.rows_of(name)) for kind, one in cut.items()},
            "bounds_m": _bounds([one.bounds[one.rows_of(name)] for one in cut.values()]),
        }
        for name in names
    ]
    tiles = {"scheme": SCHEME, "level": level, "kinds": kinds, "index": index}
    write_json(folder / "map.json", {**head.content, "tiles": tiles})


@dataclass(frozen=True)
class _Cut:
    """A file of a map, and the tile of each of its rows."""

    table: pa.Table
    bounds: np.ndarray
    rows: dict[str, np.ndarray]
    """By tile, ascending."""

    @property
    def names(self) -> Collection[str]:
        return self.rows.keys()

    def rows_of(self, name: str) -> np.ndarray:
        return self.rows.get(name, np.zeros(0, dtype=np.int64))

    def table_of(self, name: str) -> pa.Table:
        rows = pa.array(self.rows_of(name), pa.int64())
        return self.table.take(rows).append_column("row", rows)


def _cut(path: Path, kind: str, origin: Origin, level: int) -> _Cut:
    name, where = PLACES[kind]
    sheet = Sheet(path, (name,), where)
    place, low, high = landmark_places(sheet, kind)
    if len(lost := np.flatnonzero(np.isnan(place[:, 0]))):
        raise sheet.fault(f"no {' and no '.join(where)}; expected its place", int(lost[0]), "null")
    table = _read(path)
    if "row" in table.column_names:
        raise sheet.fault("column 'row' is there; tiles keep the order of a map in it: rename it")
    names, tile = np.unique(np.array(tile_names(place, origin, level)), return_inverse=True)
    order = np.argsort(tile, kind="stable")
    parts = np.split(order, np.searchsorted(tile[order], np.arange(1, len(names))))
    rows = dict(zip(names.tolist(), parts, strict=False))
    return _Cut(table, np.concatenate((low, high), axis=-1), rows)


def _bounds(bounds: list[np.ndarray]) -> list[float]:
    every = np.concatenate(bounds)
    if not len(every):
        return [0.0] * 4
    return [*every[:, :2].min(0).tolist(), *every[:, 2:].max(0).tolist()]


def rewrite_map(folder: Path, out: Path, *, level: int | None) -> dict[str, int]:
    """Writes a map in either form again, in tiles or (`level` None) in one piece, and returns how many rows each kind has.

    All rows, columns and keys stay as they are. What was at `out` stays until the new map is complete. InputError for what
    breaks FORMAT.md in the index, the tiles, names or places.
    """
    with atomic_folder(out) as beside:
        with reading(inside=folder):
            counts = _copy_whole(folder, beside)
        if level is not None:
            split_map(beside, level)
        return counts


def _copy_whole(folder: Path, to: Path) -> dict[str, int]:
    head = read_map_head(folder)
    read_origin(head)
    counts = {}
    for kind, (name, where) in PLACES.items():
        source = landmark_file(folder, head, kind)
        if isinstance(source, Path) and not source.exists():
            continue
        counts[kind] = len(opened(source, (name,), where))
        pq.write_table(_whole(source), to / f"{kind}.parquet")
    if not counts.keys() & {"signs", "lanes"}:
        raise InputError(f"{folder}: has neither signs nor lanes", "missing-file")
    told = {key: value for key, value in head.content.items() if key != "tiles"}
    write_json(to / "map.json", told)
    return counts


def tentative_count(folder: Path) -> int:
    """How many signs of a map are tentative."""
    source = landmark_file(folder, read_map_head(folder), "tentative_signs")
    if isinstance(source, TiledFile):
        return sum(tile.counts[source.kind] for tile in source.tiles)
    return pq.read_metadata(source).num_rows if source.is_file() else 0


def _whole(source: Path | TiledFile) -> pa.Table:
    """Every column of a kind's landmarks, in the order of the map."""
    if isinstance(source, Path):
        return _read(source)
    tables = [_read(source.path_of(k)) for k in range(len(source.tiles))]
    refuse_unlike(source, tables)
    table = pa.concat_tables(tables)
    order = np.argsort(table.column("row").to_numpy())
    return table.take(pa.array(order)).drop_columns(["row"]).combine_chunks()


def _read(path: Path) -> pa.Table:
    with pq.ParquetFile(path) as file:
        return file.read()
