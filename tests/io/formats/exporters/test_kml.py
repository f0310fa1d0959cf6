from __future__ import annotations

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from worlds.marked_roads import two_way_road

from crowdmap_torch.io.formats.exporters.features import LAYERS, layers
from crowdmap_torch.io.formats.exporters.kml import write

KML = {"k": "http://www.opengis.net/kml/2.2"}


@pytest.fixture
def document(tmp_path: Path) -> ET.Element:
    assert write(two_way_road(), tmp_path / "road.kml") == ()
    found = ET.parse(tmp_path / "road.kml").getroot().find("k:Document", KML)
    assert found is not None
    return found


def test_every_feature_has_its_place_and_what_is_known(document: ET.Element):
    road = two_way_road()
    for folder, layer in zip(document.findall("k:Folder", KML), layers(road), strict=True):
        assert folder.findtext("k:name", None, KML) == layer.name
        marks = folder.findall("k:Placemark", KML)
        assert [m.findtext("k:name", None, KML) for m in marks] == [*layer.feature_id]
        for row, mark in enumerate(marks):
            text = mark.findtext(".//k:coordinates", "", KML).split()
            assert len(text) == len(layer.place[row]) + (layer.geometry == "Polygon")
            first = [float(number) for number in text[0].split(",")]
            assert first == pytest.approx(layer.place[row][0].tolist(), abs=1e-5)
            told = {
                d.attrib["name"]: d.findtext("k:value", "", KML)
                for d in mark.iter(f"{{{KML['k']}}}Data")
            }
            known = layer.columns | layer.lists
            assert told.keys() == {
                name for name, values in known.items() if values[row] is not None
            }


def test_a_document_says_where_it_comes_from(document: ET.Element):
    told = json.loads(document.findtext("k:description", "", KML))["crowdmap"]
    assert told["provenance"] == two_way_road().provenance


def test_heights_do_not_lift_what_is_drawn(document: ET.Element):
    modes = {mode.text for mode in document.iter(f"{{{KML['k']}}}altitudeMode")}
    assert modes == {"clampToGround"} and len(LAYERS) == 3


def test_gdal_reads_every_feature_to_the_millimetre(tmp_path: Path):
    raw = pytest.importorskip("pyogrio.raw", reason="pyogrio (extra [gis]) is not installed")
    shapely = pytest.importorskip("shapely", reason="shapely (extra [gis]) is not installed")
    road = two_way_road()
    write(road, tmp_path / "road.kml")
    for layer in layers(road):
        _, _, shapes, _ = raw.read(tmp_path / "road.kml", layer=layer.name)
        assert len(shapes) == len(layer.place)
        for shape, place in zip(shapely.from_wkb(shapes), layer.place, strict=True):
            found = shapely.get_coordinates(shape, include_z=True)[: len(place)]
            # Outlines may run the other way round: 1e-8 degrees are a millimetre.
            away = np.abs(found[:, None] - place[None]) / [1e-8, 1e-8, 1e-3]
            assert away.max(axis=2).min(axis=1).max() < 1
