"""What GDAL reads back of the formats that it knows."""

from __future__ import annotations

import json
import sqlite3
import struct
from contextlib import closing
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds.marked_roads import two_way_road

from crowdmap_torch.io.formats.exporters.export import FORMATS, export_map
from crowdmap_torch.io.formats.exporters.features import LAYERS, layers
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import HdMap

raw = pytest.importorskip("pyogrio.raw", reason="pyogrio (extra [gis]) is not installed")


def points_of(wkb: bytes) -> np.ndarray:
    """Longitude, latitude and height of a geometry with heights; rings without their last point."""
    kind = struct.unpack_from("<I", wkb, 1)[0]
    kind = kind % 1000 if kind < 2**31 else kind % 2**31
    skip = {1: 5, 2: 9, 3: 13}[kind]
    points = np.frombuffer(wkb, dtype="<f8", offset=skip).reshape(-1, 3)
    return points[:-1] if kind == 3 else points


def features(path: Path, form: str, layer: str) -> tuple[dict[str, np.ndarray], list[np.ndarray]]:
    """Columns and points that GDAL reads of a layer."""
    place = path / f"{layer}.fgb" if form == "flatgeobuf" else path
    where = f"layer = '{layer}'" if form == "geojson" else None
    name = None if form in ("flatgeobuf", "geojson") else layer
    meta, _, geometry, data = raw.read(place, layer=name, where=where)
    return dict(zip(meta["fields"], data, strict=True)), [points_of(g) for g in geometry]


@pytest.fixture(scope="module")
def road() -> HdMap:
    return two_way_road()


@pytest.mark.parametrize("form", ["geopackage", "flatgeobuf", "kml", "geojson"])
def test_every_feature_comes_back_to_the_millimetre(form: str, road: HdMap, tmp_path: Path):
    path = tmp_path / f"road{FORMATS[form].ending}"
    export_map(road, path, form)
    assert [*tmp_path.iterdir()] == [path]
    for layer in layers(road):
        columns, points = features(path, form, layer.name)
        # FlatGeobuf lays features in the order of its index.
        key = next(iter(layer.columns))
        key = "Name" if form == "kml" else key
        expected = layer.feature_id if form == "kml" else layer.columns[next(iter(layer.columns))]
        order = [columns[key].tolist().index(name) for name in expected]
        assert sorted(order) == list(range(len(layer)))
        for row, at in enumerate(order):
            back = local_from_geodetic(points[at][:, [1, 0, 2]], road.origin)
            true = local_from_geodetic(layer.place[row][:, [1, 0, 2]], road.origin)
            # The rings of GeoJSON may run the other way.
            gap = np.linalg.norm(back[:, None] - true, axis=-1)
            assert gap.min(0).max() < 1e-3 and gap.min(1).max() < 1e-3
        for name, values in layer.columns.items():
            told = [columns[name][at] for at in order]
            assert [*map(str, told)] == [*map(str, values)] or told == values


def test_lists_are_json_texts(road: HdMap, tmp_path: Path):
    export_map(road, tmp_path / "road.gpkg", "geopackage")
    columns, _ = features(tmp_path / "road.gpkg", "geopackage", "lanes")
    first = int(road.lanes.control_count[0])
    assert (
        json.loads(columns["control_points"][0]) == road.lanes.control.point_world[:first].tolist()
    )


def test_a_geopackage_says_where_it_comes_from(road: HdMap, tmp_path: Path):
    export_map(road, tmp_path / "road.gpkg", "geopackage")
    meta, _, _, data = raw.read(tmp_path / "road.gpkg", layer="crowdmap")
    told = dict(zip(meta["fields"], data, strict=True))
    assert json.loads(told["provenance"][0]) == road.provenance
    assert json.loads(told["origin"][0])["lat_deg"] == road.origin.lat_deg


@pytest.mark.parametrize("form", ["geopackage", "flatgeobuf", "kml"])
def test_a_map_without_landmarks_is_written(form: str, road: HdMap, tmp_path: Path):
    none = torch.empty(0, dtype=torch.int64)
    bare = replace(
        road, signs=road.signs[none], lanes=road.lanes.select(none), sign_id=(), lane_id=()
    )
    path = tmp_path / f"bare{FORMATS[form].ending}"
    export_map(bare, path, form)
    if form != "kml":
        assert [len(features(path, form, layer)[1]) for layer in LAYERS] == [0, 0, 0]


def test_modules_are_there_for_every_format():
    for name in FORMATS:
        assert callable(import_module(f"crowdmap_torch.io.formats.exporters.{name}").write)


def test_a_geopackage_is_of_a_version_that_older_programs_know(road: HdMap, tmp_path: Path):
    export_map(road, tmp_path / "road.gpkg", "geopackage")
    with closing(sqlite3.connect(tmp_path / "road.gpkg")) as file:
        assert file.execute("pragma user_version").fetchone() == (10300,)
