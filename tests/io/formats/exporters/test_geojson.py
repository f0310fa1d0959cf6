from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.formats.exporters.features import layers
from crowdmap_torch.io.formats.exporters.geojson import write
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import HdMap


@pytest.fixture
def collection(hd_map: HdMap, tmp_path: Path) -> dict:
    assert write(hd_map, tmp_path / "map.geojson") == ()
    return json.loads((tmp_path / "map.geojson").read_text(encoding="utf-8"))


def of(collection: dict, layer: str) -> list[dict]:
    return [f for f in collection["features"] if f["properties"]["layer"] == layer]


def local(coordinates: list, hd_map: HdMap) -> np.ndarray:
    return local_from_geodetic(np.array(coordinates)[..., [1, 0, 2]], hd_map.origin)


def test_every_landmark_comes_back_to_the_millimetre(collection: dict, hd_map: HdMap):
    signs, plates, lanes = (of(collection, name) for name in ("signs", "plates", "lanes"))
    assert [f["id"] for f in signs] == list(hd_map.sign_id)
    assert [f["id"] for f in lanes] == list(hd_map.lane_id)
    place = local([f["geometry"]["coordinates"] for f in signs], hd_map)
    np.testing.assert_allclose(place, hd_map.signs.center_world, rtol=0, atol=1e-4)
    for row, plate in enumerate(plates):
        (ring,) = plate["geometry"]["coordinates"]
        assert (
            ring[0] == ring[-1] and len(ring) == polygon.corner_count(hd_map.signs.shape[row]) + 1
        )
        expected = hd_map.signs.corners_world[row][hd_map.signs.corner_mask[row]].numpy()
        gap = np.linalg.norm(local(ring[:-1], hd_map)[:, None] - expected, axis=-1)
        assert gap.min(0).max() < 1e-4


def test_outer_rings_run_anticlockwise(collection: dict):
    for plate in of(collection, "plates"):
        x, y, _ = (
            np.array(plate["geometry"]["coordinates"][0]) - plate["geometry"]["coordinates"][0][0]
        ).T
        assert np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) >= 0


def test_nothing_of_a_map_is_lost(collection: dict, hd_map: HdMap):
    head = collection["crowdmap"]
    assert head["provenance"] == hd_map.provenance
    assert head["shared_covariance"] == hd_map.shared_covariance.flatten().tolist()
    assert head["origin"] == {"lat_deg": 32.9, "lon_deg": -117.2, "height_m": 120.0}
    for row, sign in enumerate(of(collection, "signs")):
        told, signs = sign["properties"], hd_map.signs
        assert told["shape"] == polygon.SHAPES[signs.shape[row]]
        assert told["type"] == (None if signs.type[row] < 0 else hd_map.type_names[signs.type[row]])
        assert [told["width_m"], told["height_m"]] == signs.size[row].tolist()
        assert [told[a] for a in "xyz"] == signs.center_world[row].tolist()
        assert told["covariance_eu"] == signs.covariance[row, 0, 2]
        assert told["first_seen_ns"] == signs.first_seen_ns[row]
        assert told["confidence"] == signs.confidence[row]
    for row, lane in enumerate(of(collection, "lanes")):
        told, first = lane["properties"], int(hd_map.lanes.control_start[row])
        rows = slice(first, first + int(hd_map.lanes.control_count[row]))
        assert told["control_points"] == hd_map.lanes.control.point_world[rows].tolist()
        assert told["sigma_m"] == hd_map.lanes.control.sigma[rows].tolist()
        assert told["n_observations"] == hd_map.lanes.n_observations[row]


def test_gdal_reads_every_feature(hd_map: HdMap, tmp_path: Path):
    pyogrio = pytest.importorskip("pyogrio", reason="pyogrio (extra [gis]) is not installed")
    write(hd_map, tmp_path / "map.geojson")
    told = pyogrio.read_info(tmp_path / "map.geojson")
    assert told["features"] == 2 * len(hd_map.signs) + len(hd_map.lanes)
    assert told["crs"] == "EPSG:4979" or told["crs"] == "EPSG:4326"
    shapely = pytest.importorskip("shapely", reason="shapely (extra [gis]) is not installed")
    _, _, shapes, _ = pyogrio.raw.read(tmp_path / "map.geojson")
    every = [place for layer in layers(hd_map) for place in layer.place]
    for shape, place in zip(shapely.from_wkb(shapes), every, strict=True):
        found = shapely.get_coordinates(shape, include_z=True)[: len(place)]
        # Outlines may run the other way round: 1e-8 degrees are a millimetre.
        away = np.abs(found[:, None] - place[None]) / [1e-8, 1e-8, 1e-3]
        assert away.max(axis=2).min(axis=1).max() < 1
