"""Maps in tiles: the same map to the last bit, each landmark in one tile, and which line names each fault."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from crowdmap_torch.geometry import quadtree
from crowdmap_torch.io.area import Area
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.inspection import inspect_dataset
from crowdmap_torch.io.maps import read_map, write_map
from crowdmap_torch.io.surveys import read_survey
from crowdmap_torch.io.tiled_maps import DEFAULT_LEVEL, rewrite_map
from crowdmap_torch.io.trees import to_tree
from crowdmap_torch.simulate.dataset import SimulationConfig, write_dataset
from crowdmap_torch.simulate.worlds import WORLD_PRESETS
from crowdmap_torch.tables import HdMap, Origin, Survey

WEST, SOUTH, _, _ = quadtree.bounds_deg(quadtree.tiles_of(["12201203120220"]), 14)[0].tolist()
CORNER = Origin(SOUTH, WEST, 40.0)
"""Where four tiles meet, in Berlin."""


def is_equal(one: HdMap | Survey, other: HdMap | Survey) -> bool:
    """Whether two maps are one to the last bit."""

    def same(a: object, b: object) -> bool:
        if isinstance(a, torch.Tensor):
            assert isinstance(b, torch.Tensor)
            return torch.equal(a.nan_to_num(-1e9), b.nan_to_num(-1e9))
        if isinstance(a, dict):
            assert isinstance(b, dict)
            return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
        return a == b

    return same(to_tree(one), to_tree(other))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A street's survey around the corner of four tiles, in one piece."""
    out = tmp_path_factory.mktemp("sim")
    write_dataset(SimulationConfig(WORLD_PRESETS["street"], journeys=1, seed=1), out / "street")
    street = read_map(out / "street" / "survey")
    middle = street.signs.center_world.mean(0)
    middle = middle * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
    T = street.signs.T_world_sign.clone()
    T[:, :3, 3] -= middle
    control = replace(street.lanes.control, point_world=street.lanes.control.point_world - middle)
    confidence = torch.linspace(0.4, 1.0, len(street.signs), dtype=torch.float64)
    moved = replace(
        street,
        origin=CORNER,
        signs=replace(street.signs, T_world_sign=T, confidence=confidence),
        lanes=replace(street.lanes, control=control),
    )
    write_map(moved, out / "map")
    return out / "map"


@pytest.fixture
def tiled(whole: Path, tmp_path: Path) -> Path:
    """The same in tiles."""
    rewrite_map(whole, tmp_path / "tiled", level=DEFAULT_LEVEL)
    return tmp_path / "tiled"


def head_of(folder: Path) -> dict:
    return json.loads((folder / "map.json").read_text())


def test_a_map_in_tiles_is_read_as_that_in_one_piece(whole: Path, tiled: Path) -> None:
    assert not list(tiled.glob("*.parquet"))
    assert len(list((tiled / "tiles").iterdir())) >= 2
    assert is_equal(read_map(tiled), read_map(whole))
    assert is_equal(read_survey(tiled), read_survey(whole))


def test_a_map_is_written_in_tiles(whole: Path, tmp_path: Path) -> None:
    hd_map = read_map(whole)
    write_map(hd_map, tmp_path / "map", min_confidence=0.7, tile_level=18)
    write_map(hd_map, tmp_path / "whole", min_confidence=0.7)
    assert is_equal(read_map(tmp_path / "map"), read_map(tmp_path / "whole"))
    assert not list(tmp_path.glob(".*"))


@pytest.mark.parametrize("level", [1, 14, 17, quadtree.MAX_LEVEL])
def test_there_and_back_nothing_is_lost(whole: Path, tmp_path: Path, level: int) -> None:
    counts = rewrite_map(whole, tmp_path / "tiled", level=level)
    assert counts["tentative_signs"] > 0
    assert rewrite_map(tmp_path / "tiled", tmp_path / "back", level=None) == counts
    assert sorted(p.name for p in whole.iterdir()) == sorted(
        p.name for p in (tmp_path / "back").iterdir()
    )
    assert head_of(tmp_path / "back") == head_of(whole)
    for path in whole.glob("*.parquet"):
        back, before = pq.read_table(tmp_path / "back" / path.name), pq.read_table(path)
        assert back.equals(before, check_metadata=True)


def test_each_landmark_is_in_one_tile(whole: Path, tiled: Path) -> None:
    for kind, name in (("signs", "sign_id"), ("lanes", "lane_id"), ("tentative_signs", "sign_id")):
        paths = sorted(tiled.glob(f"tiles/*/{kind}.parquet"))
        ids = [i for p in paths for i in pq.ParquetFile(p).read().column(name).to_pylist()]
        assert sorted(ids) == sorted(pq.read_table(whole / f"{kind}.parquet")[name].to_pylist())


def test_the_index_tells_counts_and_bounds(tiled: Path) -> None:
    told = head_of(tiled)["tiles"]
    assert (told["scheme"], told["level"]) == ("here-quadtree", DEFAULT_LEVEL)
    assert {t["quadkey"] for t in told["index"]} == {p.name for p in (tiled / "tiles").iterdir()}
    hd_map = read_map(tiled)
    assert sum(t["signs"] for t in told["index"]) == len(hd_map.signs)
    assert sum(t["lanes"] for t in told["index"]) == len(hd_map.lanes)
    west = min(t["bounds_m"][0] for t in told["index"])
    assert west <= float(hd_map.signs.center_world[:, 0].min())


def test_a_map_without_landmarks_has_the_tile_of_its_origin(whole: Path, tmp_path: Path) -> None:
    hd_map = read_map(whole)
    none = torch.zeros(0, dtype=torch.int64)
    empty = replace(
        hd_map,
        signs=hd_map.signs[none],
        lanes=hd_map.lanes.select(none),
        sign_id=(),
        lane_id=(),
        type_names=(),
    )
    write_map(empty, tmp_path / "map", tile_level=14)
    assert [p.name for p in (tmp_path / "map" / "tiles").iterdir()] == ["12201203120220"]
    assert is_equal(read_map(tmp_path / "map"), empty)


def test_an_area_reads_the_tiles_that_touch_it(whole: Path, tmp_path: Path) -> None:
    tiled = tmp_path / "tiled"
    rewrite_map(whole, tiled, level=18)
    east = float(read_map(whole).signs.center_world[:, 0].max())
    area = Area(east - 30, -1e4, east + 1, 1e4)
    expected = read_map(whole, area=area)
    assert 0 < len(expected.signs) < len(read_map(whole).signs)
    for tile in head_of(tiled)["tiles"]["index"]:
        if tile["bounds_m"][2] < east - 40:
            shutil.rmtree(tiled / "tiles" / tile["quadkey"])
    assert len(list((tiled / "tiles").iterdir())) < len(head_of(tiled)["tiles"]["index"])
    assert is_equal(read_map(tiled, area=area), expected)
    nowhere = Area(1e5, 1e5, 2e5, 2e5)
    assert len(read_map(whole, area=nowhere).signs) == 0


def change(tiled: Path, entry: int = 0, **keys: object) -> None:
    head = head_of(tiled)
    head["tiles"]["index"][entry] |= keys
    (tiled / "map.json").write_text(json.dumps(head))


def tile_with(tiled: Path, kind: str, at: int = 0) -> tuple[Path, pa.Table]:
    """The file of a tile that has landmarks of a kind."""
    paths = sorted(tiled.glob(f"tiles/*/{kind}.parquet"))
    path = [p for p in paths if pq.read_metadata(p).num_rows][at]
    return path, pq.ParquetFile(path).read()


def missing_file(tiled: Path) -> None:
    tile_with(tiled, "signs")[0].unlink()


def missing_tile(tiled: Path) -> None:
    shutil.rmtree(tile_with(tiled, "lanes")[0].parent)


def missing_tiles(tiled: Path) -> None:
    shutil.rmtree(tiled / "tiles")


def other_count(tiled: Path) -> None:
    change(tiled, signs=77)


def stray_tile(tiled: Path) -> None:
    (tiled / "tiles" / "12201203120000").mkdir()


def twice_in_index(tiled: Path) -> None:
    change(tiled, 1, quadkey=head_of(tiled)["tiles"]["index"][0]["quadkey"])


def broken_json(tiled: Path) -> None:
    (tiled / "map.json").write_text('{"format": ')


def no_tile(tiled: Path) -> None:
    change(tiled, quadkey="99")


def other_scheme(tiled: Path) -> None:
    head = head_of(tiled)
    head["tiles"]["scheme"] = "bing"
    (tiled / "map.json").write_text(json.dumps(head))


def no_origin(tiled: Path) -> None:
    head = head_of(tiled)
    del head["origin"]
    (tiled / "map.json").write_text(json.dumps(head))


def wrong_tile(tiled: Path) -> None:
    paths = sorted(tiled.glob("tiles/*"))
    for kind in ("signs", "lanes", "tentative_signs"):
        one, other = (p / f"{kind}.parquet" for p in (paths[0], paths[-1]))
        beside = one.with_name("beside")
        one.rename(beside)
        other.rename(one)
        beside.rename(other)
    head = head_of(tiled)
    index = head["tiles"]["index"]
    ends = (index[0]["quadkey"], index[-1]["quadkey"])
    index[0]["quadkey"], index[-1]["quadkey"] = ends[1], ends[0]
    (tiled / "map.json").write_text(json.dumps(head))


def in_two_tiles(tiled: Path) -> None:
    (_, one), (path, other) = tile_with(tiled, "signs"), tile_with(tiled, "signs", 1)
    names = pa.array([one["sign_id"][0].as_py(), *other["sign_id"].to_pylist()[1:]])
    pq.write_table(other.set_column(0, "sign_id", names), path)


def row_twice(tiled: Path) -> None:
    path, table = tile_with(tiled, "signs")
    rows = pa.array([1000, *table["row"].to_pylist()[1:]])
    pq.write_table(table.set_column(table.column_names.index("row"), "row", rows), path)


def no_row(tiled: Path) -> None:
    path, table = tile_with(tiled, "signs")
    pq.write_table(table.drop_columns(["row"]), path)


def other_types(tiled: Path) -> None:
    path, table = tile_with(tiled, "signs", 1)
    pq.write_table(table.drop_columns(["confidence"]), path)


def other_bounds(tiled: Path) -> None:
    index = head_of(tiled)["tiles"]["index"]
    at = next(k for k, tile in enumerate(index) if tile["signs"])
    change(tiled, at, bounds_m=[9e5, 9e5, 9.1e5, 9.1e5])


def whole_beside(tiled: Path) -> None:
    shutil.copy(tile_with(tiled, "signs")[0], tiled / "signs.parquet")


FAULTS: dict[Callable[[Path], None], str] = {
    missing_file: r"signs\.parquet: the file is missing",
    missing_tile: r"signs\.parquet: the file is missing",
    missing_tiles: r"tiles: the map's tiles are missing",
    other_count: r"signs\.parquet: \d+ rows; expected 77, as map\.json says",
    stray_tile: r"12201203120000: map\.json does not name this tile",
    twice_in_index: r"map\.json: tiles\.index: tile \d+ is named twice",
    broken_json: r"map\.json: cannot be read as JSON",
    no_tile: r"map\.json: tiles\.index\[0\]\.quadkey: expected a quadkey of 14 digits, found '99'",
    other_scheme: r"map\.json: tiles\.scheme: expected 'here-quadtree', found 'bing'",
    no_origin: r"map\.json: origin: is missing",
    wrong_tile: r"\.parquet: row 0: its place is in tile \d{14}; expected each landmark in the tile",
    in_two_tiles: r"signs\.parquet: row 0: column 'sign_id': '.*' is in .*signs\.parquet too",
    row_twice: r"signs\.parquet: row 0: column 'row': 1000; expected each of 0 to",
    no_row: r"signs\.parquet: column 'row' is missing",
    other_types: r"signs\.parquet: its columns are not those of",
    other_bounds: r"signs\.parquet: row 0: it lies outside bounds_m of tile \d+ in map\.json",
    whole_beside: r"signs\.parquet: is beside tiles; expected one of the two",
}


@pytest.mark.parametrize("spoil", FAULTS, ids=lambda spoil: spoil.__name__)
def test_a_fault_is_one_line(spoil, tiled: Path, tmp_path: Path) -> None:
    spoil(tiled)
    with pytest.raises(InputError, match=FAULTS[spoil]) as fault:
        read_map(tiled)
    assert "\n" not in str(fault.value)
    with pytest.raises(InputError):
        rewrite_map(tiled, tmp_path / "back", level=None)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tiled"]


def test_check_names_every_fault_of_a_survey_in_tiles(whole: Path, tmp_path: Path) -> None:
    survey = tmp_path / "data" / "survey"
    rewrite_map(whole, survey, level=18)
    shutil.copy(survey / "map.json", tmp_path / "data" / "dataset.json")
    sound = [f for f in inspect_dataset(tmp_path / "data") if survey in (f.path, *f.path.parents)]
    assert sound == []
    spoilt = [tile_with(survey, "signs", k) for k in (0, 1)]
    for path, table in spoilt:
        shapes = pa.array(["star", *table["shape"].to_pylist()[1:]])
        pq.write_table(table.set_column(1, "shape", shapes), path)
    found = [f for f in inspect_dataset(tmp_path / "data") if survey in (f.path, *f.path.parents)]
    assert [(f.path, f.rows, f.code) for f in found] == [
        (path, (0,), "unknown-name") for path, _ in spoilt
    ]
