"""Maps in tiles, as they are read: the index in map.json, and a kind's files of all tiles as one sheet, ordered by `row`.

What is read is that of a map in one piece to the last bit; complaints name the tile's file and the row in it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int

from crowdmap_torch.geometry import quadtree
from crowdmap_torch.io.area import Area
from crowdmap_torch.io.budget import budget_now, refuse_way_out
from crowdmap_torch.io.columns import Sheet, read_columns
from crowdmap_torch.io.datasets import read_origin
from crowdmap_torch.io.documents import Document
from crowdmap_torch.io.errors import Code, InputError
from crowdmap_torch.io.faults import Fault, FaultsGathered, gathered
from crowdmap_torch.io.formats.geodesy import geodetic_from_local
from crowdmap_torch.ranges import shown
from crowdmap_torch.tables import Origin

SCHEME = "here-quadtree"
PLACES = {
    "signs": ("sign_id", ("corners", "center")),
    "lanes": ("lane_id", ("points",)),
    "tentative_signs": ("sign_id", ("corners", "center")),
}
"""Kinds of landmarks: the column of their names, and those that say where they are."""
_BORDER_DEG = 1e-9
"""A place this near to a border is in the tile of either side: machines differ in last digits of latitudes (0.1 mm)."""
_BESIDE_M = 1.0
"""Control points of a lane marker are this near to one of its points [m]."""


@dataclass(frozen=True)
class Tile:
    """What map.json says of a tile."""

    quadkey: str
    counts: Mapping[str, int]
    """Rows of each kind of landmarks."""
    bounds_m: tuple[float, ...]
    """West, south, east, north of the centres of its signs and the points of its lane pieces [m]."""


@dataclass(frozen=True)
class TiledFile:
    """The landmarks of one kind of a map in tiles: what stands for the file of a map in one piece."""

    folder: Path
    kind: str
    origin: Origin
    tiles: tuple[Tile, ...]
    is_part: bool = False
    """Whether some tiles are left out."""

    def path_of(self, tile: int) -> Path:
        """The file of one tile."""
        return self.folder / self.tiles[tile].quadkey / f"{self.kind}.parquet"

    def touching(self, area: Area) -> TiledFile:
        """The tiles alone that hold something in an area."""
        west, south, east, north = area.sides
        bounds = np.array([tile.bounds_m for tile in self.tiles]).reshape(-1, 4)
        is_in = (bounds[:, :2] <= np.array([east, north]) + _BESIDE_M).all(-1)
        is_in &= (bounds[:, 2:] >= np.array([west, south]) - _BESIDE_M).all(-1)
        kept = tuple(self.tiles[k] for k in np.flatnonzero(is_in))
        # Columns have the types of a file's: there must be one.
        return replace(self, tiles=kept or self.tiles[:1], is_part=True)


def landmark_file(folder: Path, head: Document, kind: str) -> Path | TiledFile:
    """Where the landmarks of a kind are: a file, which may be missing, or those of tiles."""
    whole = folder / f"{kind}.parquet"
    if "tiles" not in head.content:
        return whole
    told = len(gathered() or ())
    index = head.part("tiles")
    index.allow(("scheme", "level", "kinds", "index"))
    if (scheme := index.text("scheme")) != SCHEME:
        raise index.fault(f"expected {SCHEME!r}, found {shown(scheme)}", "scheme")
    kinds = index.take("kinds")
    if not isinstance(kinds, list) or not all(name in PLACES for name in map(str, kinds)):
        raise index.fault(f"expected a list of {', '.join(PLACES)}, found {shown(kinds)}", "kinds")
    level = index.integer("level", low=1, high=quadtree.MAX_LEVEL)
    tiles = tuple(_tile(entry, level, kinds) for entry in index.parts("index"))
    _refuse_strays(folder / "tiles", index, [tile.quadkey for tile in tiles])
    if len(gathered() or ()) > told:
        raise FaultsGathered(f"{head.path}: has faults")
    if whole.exists():
        raise InputError(f"{whole}: is beside tiles; expected one of the two", "name-twice")
    return TiledFile(folder / "tiles", kind, read_origin(head), tiles) if kind in kinds else whole


def _tile(entry: Document, level: int, kinds: Sequence[str]) -> Tile:
    entry.allow(("quadkey", "bounds_m", *kinds))
    name = entry.text("quadkey")
    if not quadtree.is_quadkey(name) or len(name) != level:
        raise entry.fault(f"expected a quadkey of {level} digits, found {shown(name)}", "quadkey")
    counts = {kind: entry.integer(kind, low=0, high=budget_now().rows) for kind in kinds}
    return Tile(name, counts, tuple(entry.numbers("bounds_m", 4)))


def _refuse_strays(folder: Path, index: Document, named: list[str]) -> None:
    """Refuses tiles that are named twice, or are on the disk and nowhere named."""
    if twice := sorted(
        {name for name in named if named.count(name) > 1} if len(named) > len({*named}) else ()
    ):
        raise index.fault(
            f"tile {twice[0]} is named twice; expected it once", "index", "name-twice"
        )
    if not named or not folder.is_dir():
        rule = (
            f"{folder}: the map's tiles are missing; expected a folder for each that map.json names"
        )
        raise InputError(rule, "missing-file")
    refuse_way_out(folder)
    there = {path.name for path in folder.iterdir() if quadtree.is_quadkey(path.name)}
    if stray := sorted(there - {*named}):
        raise InputError(
            f"{folder / stray[0]}: map.json does not name this tile; write the map again", "other"
        )


def opened(
    source: Path | TiledFile, required: Sequence[str], optional: Sequence[str] = ()
) -> Sheet:
    """The sheet of a map's landmarks; `required` begins with the column of their names."""
    if isinstance(source, TiledFile):
        return TiledSheet(source, required, optional)
    return Sheet(source, required, optional)


def path_of(source: Path | TiledFile) -> Path:
    """The file, or the folder of tiles."""
    return source.folder if isinstance(source, TiledFile) else source


class TiledSheet(Sheet):
    """The same kind's files of several tiles as one sheet, sorted by `row`; each landmark must be in its own tile, once."""

    def __init__(
        self, source: TiledFile, required: Sequence[str], optional: Sequence[str] = ()
    ) -> None:
        self.path = source.folder
        self._source = source
        self._wrong = {}
        every = (required[0], *PLACES[source.kind][1])
        tables = _tables(source, ("row", *required), tuple(dict.fromkeys((*optional, *every))))
        rows = [table.num_rows for table in tables]
        self._tile = np.repeat(np.arange(len(rows)), rows)
        self._row = np.concatenate([np.arange(count) for count in rows])
        self._table = pa.concat_tables(tables).unify_dictionaries()
        self._refuse_in_two_tiles(required[0])
        self._refuse_misplaced()
        order = self._order()
        self._table = self._table.take(pa.array(order))
        self._tile, self._row = self._tile[order], self._row[order]
        self._wrong = {name: wrong[order] for name, wrong in self._wrong.items()}

    def fault(self, rule: str, row: int | None = None, code: Code = "other") -> InputError:
        """The error that says in which row of which tile's file a rule is broken."""
        if row is None:
            return super().fault(rule, row, code)
        return InputError(f"{self._file_of(row)}: row {self._row[row]}: {rule}", code)

    def _keep(self, rule: str, code: Code, rows: Int[np.ndarray, " k"], column: str = "") -> None:
        faults = gathered()
        if faults is None or not len(rows):
            super()._keep(rule, code, rows, column)
            return
        for tile in np.unique(self._tile[rows]):
            inside = self._row[rows[self._tile[rows] == tile]]
            path = self._source.path_of(int(tile))
            faults.append(Fault(path, rule, code, tuple(inside.tolist()), column=column))

    def _file_of(self, row: int) -> Path:
        return self._source.path_of(int(self._tile[row]))

    def _refuse_in_two_tiles(self, name: str) -> None:
        first: dict[str, int] = {}
        names = self.strings(name).to_pylist()
        earlier = np.array([first.setdefault(text, k) for k, text in enumerate(names)], dtype=int)
        self.refuse(
            self._tile[earlier] != self._tile if len(self) else np.zeros(0, dtype=bool),
            lambda row: (
                f"column {name!r}: {names[row]!r} is in {self._file_of(int(earlier[row]))} too; "
                "expected each landmark in one tile"
            ),
            name,
            code="name-twice",
        )

    def _refuse_misplaced(self) -> None:
        """Refuses landmarks that lie in another tile than they are in, or outside what map.json says of it."""
        place, low, high = landmark_places(self, self._source.kind)
        keys = [tile.quadkey for tile in self._source.tiles]
        level = len(keys[0])
        west, south, east, north = quadtree.bounds_deg(quadtree.tiles_of(keys), level)[self._tile].T
        lat, lon, _ = geodetic_from_local(place, self._source.origin).T
        # Longitudes go around.
        lon = west + (lon - west + 180) % 360 - 180
        away = np.stack((west - lon, lon - east, south - lat, lat - north)).max(axis=0)
        self.refuse(
            away > _BORDER_DEG,
            lambda row: (
                f"its place is in tile {tile_names(place[[row]], self._source.origin, level)[0]}; "
                "expected each landmark in the tile that holds its place"
            ),
            code="range",
        )
        bounds = np.array([tile.bounds_m for tile in self._source.tiles])[self._tile]
        self.refuse(
            np.asarray(((low < bounds[:, :2]) | (high > bounds[:, 2:])).any(-1)),
            lambda row: (
                f"it lies outside bounds_m of tile {keys[self._tile[row]]} in map.json; "
                "write the map again"
            ),
            code="range",
        )

    def _order(self) -> Int[np.ndarray, " n"]:
        """The rows of the tiles in the order of the map; refuses what is no order."""
        row = self.integers("row")
        order = np.argsort(row, kind="stable")
        expected = np.empty(len(row), dtype=np.int64)
        expected[order] = np.arange(len(row))
        self.refuse(
            row != (row if self._source.is_part else expected),
            lambda k: (
                f"column 'row': {row[k]}; expected each of 0 to {len(row) - 1} once in all tiles"
            ),
            "row",
            code="order",
        )
        return order


def _tables(source: TiledFile, required: Sequence[str], optional: Sequence[str]) -> list[pa.Table]:
    """The table of each tile; as many rows as map.json says, columns of the same types."""
    tables = []
    optional = [name for name in optional if name not in required]
    for k, tile in enumerate(source.tiles):
        path = source.path_of(k)
        table, missing = read_columns(path, required, optional)
        if missing:
            raise InputError(f"{path}: {next(iter(missing.values()))}", "missing-column")
        if table.num_rows != (expected := tile.counts[source.kind]):
            rule = (
                f"{table.num_rows} rows; expected {expected}, as map.json says; write the map again"
            )
            raise InputError(f"{path}: {rule}", "no-rows")
        tables.append(table)
    refuse_unlike(source, tables)
    if (total := sum(table.num_rows for table in tables)) > (most := budget_now().rows):
        raise InputError(f"{source.folder}: {total} rows; expected {most} at most", "too-large")
    return tables


def refuse_unlike(source: TiledFile, tables: Sequence[pa.Table]) -> None:
    """Refuses tiles whose columns are not those of the first."""
    for k, table in enumerate(tables):
        if table.schema != tables[0].schema:
            rule = f"its columns are not those of {source.path_of(0)}; write the map again"
            raise InputError(f"{source.path_of(k)}: {rule}", "column-type")


def landmark_places(
    sheet: Sheet, kind: str
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """What decides on each landmark's tile, and its bounds: a sign's centre, a lane piece's first point; NaN without one."""
    place = np.full((len(sheet), 3), np.nan)
    if kind == "lanes":
        points = sheet.point_lists("points")
        some = points.count > 0
        place[some] = points.values[points.start[some]]
        low, high = place[:, :2].copy(), place[:, :2].copy()
        if len(points.values):
            low[some] = np.minimum.reduceat(points.values[:, :2], points.start[some])
            high[some] = np.maximum.reduceat(points.values[:, :2], points.start[some])
        return place, low, high
    if "corners" in sheet:
        corners = sheet.point_lists("corners", optional=True)
        np.copyto(place, 0.0, where=corners.count[:, None] > 0)
        np.add.at(place, corners.row, corners.values)
        place /= np.maximum(corners.count, 1)[:, None]
    if "center" in sheet:
        centers = sheet.points("center", optional=True)
        place[centers.count > 0] = centers.values[centers.count > 0]
    return place, place[:, :2], place[:, :2]


def tile_names(place: Float[np.ndarray, "n 3"], origin: Origin, level: int) -> tuple[str, ...]:
    """The quadkeys of the tiles that hold places of the local frame."""
    lat, lon, _ = geodetic_from_local(place, origin).T
    return quadtree.quadkeys(quadtree.tiles_at(lon, lat, level), level)
