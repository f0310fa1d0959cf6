from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from worlds.marked_roads import ORIGIN, two_way_road

from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.formats.exporters.lanelet2 import write
from crowdmap_torch.io.formats.geodesy import local_from_geodetic
from crowdmap_torch.tables import HdMap


@pytest.fixture
def road() -> HdMap:
    return two_way_road()


@pytest.fixture
def file(road: HdMap, tmp_path: Path) -> Path:
    write(road, tmp_path / "road.osm")
    return tmp_path / "road.osm"


def tags(element: ET.Element) -> dict[str, str]:
    return {tag.attrib["k"]: tag.attrib["v"] for tag in element.iter("tag")}


def ways(file: Path) -> list[tuple[dict[str, str], np.ndarray]]:
    """Tags and points in the local frame of every way."""
    osm = ET.parse(file).getroot()
    place = {
        node.attrib["id"]: [float(node.attrib[k]) for k in ("lat", "lon")]
        + [float(tags(node)["ele"])]
        for node in osm.iter("node")
    }
    return [
        (
            tags(way),
            local_from_geodetic(
                np.array([place[nd.attrib["ref"]] for nd in way.iter("nd")]), ORIGIN
            ),
        )
        for way in osm.iter("way")
    ]


def test_every_sign_comes_back_with_its_code_and_corners(road: HdMap, file: Path):
    signs = [(t, p) for t, p in ways(file) if t["type"] == "traffic_sign"]
    assert [t["sign_id"] for t, _ in signs] == list(road.sign_id)
    assert [t["subtype"] for t, _ in signs] == ["usR1-1", "de274", "unknown", "usR1-1"]
    assert [t.get("code") for t, _ in signs] == ["US:R1-1", "DE:274", None, "US:R1-1"]
    for row, (told, corners) in enumerate(signs):
        expected = road.signs.corners_world[row][road.signs.corner_mask[row]]
        np.testing.assert_allclose(corners, expected, rtol=0, atol=2e-5)
        assert told["n_observations"] == str(20 + row)
        assert told["covariance"] == "0.01 0.0 0.0 0.01 0.0 0.01"


def test_every_marker_comes_back_with_its_type_and_heights(road: HdMap, file: Path):
    lines = [(t, p) for t, p in ways(file) if t["type"] != "traffic_sign"]
    for name, expected in zip(road.lane_id, lane_points(road.lanes), strict=True):
        parts = np.concatenate([p for t, p in lines if t["lane_id"] == name])
        gap = np.linalg.norm(expected[:, None] - parts, axis=-1).min(1)
        assert gap.max() < 2e-5
    kinds = {(t["type"], t.get("subtype")) for t, _ in lines}
    assert kinds == {
        ("curbstone", "high"),
        ("line_thin", "solid"),
        ("line_thin", "dashed"),
        ("line_thin", "solid_solid"),
        ("line_thin", None),
    }


def test_the_file_says_where_it_comes_from(road: HdMap, file: Path):
    note = ET.parse(file).getroot().findtext("note")
    assert note is not None
    told = json.loads(note)["crowdmap"]
    assert told["provenance"] == road.provenance
    assert told["origin"]["lat_deg"] == ORIGIN.lat_deg


def test_editors_are_told_that_nothing_belongs_into_openstreetmap(file: Path):
    assert ET.parse(file).getroot().attrib["upload"] == "never"


def test_a_map_without_landmarks_is_a_file_without_elements(road: HdMap, tmp_path: Path):
    none = torch.empty(0, dtype=torch.int64)
    bare = replace(
        road, signs=road.signs[none], lanes=road.lanes.select(none), sign_id=(), lane_id=()
    )
    assert write(bare, tmp_path / "bare.osm") == ()
    assert [e.tag for e in ET.parse(tmp_path / "bare.osm").getroot()] == ["note"]


def test_lanelet2_loads_it_and_routes_over_it(road: HdMap, file: Path):
    lanelet2 = pytest.importorskip("lanelet2", reason="lanelet2 (extra [lanelet]) is not installed")
    origin = lanelet2.io.Origin(ORIGIN.lat_deg, ORIGIN.lon_deg, ORIGIN.height_m)
    projector = lanelet2.projection.LocalCartesianProjector(origin)
    loaded, errors = lanelet2.io.loadRobust(str(file), projector)
    assert list(errors) == []
    plates = {p.attributes["sign_id"]: p for p in loaded.polygonLayer}
    for row, name in enumerate(road.sign_id):
        corners = [(c.x, c.y, c.z) for c in plates[name]]
        expected = road.signs.corners_world[row][road.signs.corner_mask[row]]
        np.testing.assert_allclose(corners, expected, rtol=0, atol=1e-3)
    points = np.array([(p.x, p.y, p.z) for line in loaded.lineStringLayer for p in line])
    for expected in lane_points(road.lanes):
        assert np.linalg.norm(expected[:, None] - points, axis=-1).min(1).max() < 1e-3
    rules = lanelet2.traffic_rules.create(
        lanelet2.traffic_rules.Locations.Germany, lanelet2.traffic_rules.Participants.Vehicle
    )
    graph = lanelet2.routing.RoutingGraph(loaded, rules)
    assert graph.checkValidity() == []
    lanelets = [*loaded.laneletLayer]
    begins = [one for one in lanelets if not graph.previous(one)]
    assert len(begins) == 3
    # From each beginning the road goes on to its end; the two lanes to the east may be changed.
    assert all(graph.following(one) for one in begins)
    east = [one for one in lanelets if graph.left(one) is not None]
    assert len(east) == len(lanelets) // 3
    assert sum(len(one.regulatoryElements) for one in lanelets) == 5
