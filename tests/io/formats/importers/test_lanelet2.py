from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from worlds.marked_roads import ORIGIN, two_way_road

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import write_survey_alone
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.exporters.lanelet2 import write
from crowdmap_torch.io.formats.importers import lanelet2
from crowdmap_torch.tables import LANE_TYPES, Origin

HEAD = "<?xml version='1.0'?><osm>"


def node(name: int, lat: float, lon: float, ele: float = 100.0) -> str:
    return f'<node id="{name}" lat="{lat}" lon="{lon}"><tag k="ele" v="{ele}"/></node>'


def way(name: int, nodes: tuple[int, ...], **tags: str) -> str:
    inside = "".join(f'<nd ref="{n}"/>' for n in nodes)
    inside += "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
    return f'<way id="{name}">{inside}</way>'


NODES = "".join(node(k, 48.0 + 1e-5 * k, 11.0) for k in range(1, 7))


def osm(path: Path, *elements: str) -> Path:
    path.write_text(HEAD + NODES + "".join(elements) + "</osm>")
    return path


def test_an_exported_map_comes_back_as_it_was(tmp_path: Path):
    road = two_way_road()
    write(road, tmp_path / "road.osm")
    parts = lanelet2.read((tmp_path / "road.osm",), Asked())
    assert parts.origin == ORIGIN
    survey = write_survey_alone(tmp_path / "SURVEY", [parts])
    figures = evaluate_map(road, survey).as_dict()
    assert sorted(survey.sign_id) == sorted(road.sign_id)
    assert sorted(survey.lane_id) == sorted(road.lane_id)
    rows = [survey.sign_id.index(name) for name in road.sign_id]
    assert survey.signs.shape[rows].tolist() == road.signs.shape.tolist()
    np.testing.assert_allclose(
        survey.signs.corners_world[rows], road.signs.corners_world, rtol=0, atol=1e-4
    )
    types = [survey.lane_type[survey.lane_id.index(name)] for name in road.lane_id]
    assert types == road.lanes.type.tolist()
    assert figures["signs"]["recall"] == 1 and figures["signs"]["precision"] == 1
    assert figures["lanes"]["recall"] == 1
    assert figures["signs"]["absolute"]["total"]["p95"] < 1e-4
    assert figures["lanes"]["lateral"]["p95"] < 1e-4


def test_the_real_intersection_is_a_survey(real_data: Callable[[str], Path], tmp_path: Path):
    parts = lanelet2.read((real_data("lanelet2/intersection.osm"),), Asked())
    survey = write_survey_alone(tmp_path / "SURVEY", [parts])
    # Of 19 solid and 18 dashed lines and 16 curbs five come twice.
    counts = np.bincount(survey.lane_type.numpy(), minlength=len(LANE_TYPES))
    assert dict(zip(LANE_TYPES, counts.tolist(), strict=True)) == {
        **{"solid": 19, "dashed": 13, "double": 0, "curb": 16}
    }
    assert len(survey.sign_id) == 1 and not bool(survey.signs.has_corners.any())
    points = survey.lane_points.point_world
    assert float(points.abs().max()) < 300
    assert parts.notes[0] == "5 of 53 ways are there twice, or pieces of others"


def test_ways_become_markers(tmp_path: Path):
    path = osm(
        tmp_path / "a.osm",
        way(10, (1, 2), type="line_thin", subtype="solid"),
        way(11, (2, 1), type="line_thin", subtype="dashed"),
        way(12, (3, 4), type="line_thick", subtype="solid_dashed"),
        way(13, (4, 5), type="line_thin", lane_id="a"),
        way(14, (5, 6), type="line_thin", lane_id="a"),
        way(15, (2, 3), type="line_thin", lane_id="b"),
        way(16, (4, 6), type="line_thin", lane_id="b"),
        way(17, (1, 6), type="virtual"),
    )
    parts = lanelet2.read((path,), Asked(origin=Origin(48.0, 11.0, 100.0)))
    survey = parts.survey
    assert survey is not None
    assert survey.lane_id == ("10", "12", "a", "b-0", "b-1")
    assert survey.lane_type.tolist() == [0, 2, -1, -1, -1]
    np.testing.assert_allclose(survey.lane_points[2][:, 1], np.arange(4, 7) * 1.11196, atol=1e-3)
    assert parts.notes == (
        "2 of 7 ways are there twice, or pieces of others",
        "ways left out: virtual (1)",
    )


def test_a_sign_that_is_a_line_has_its_centre_above_it(tmp_path: Path):
    path = osm(
        tmp_path / "a.osm", way(1, (1, 2), type="traffic_sign", subtype="de205", height="0.8")
    )
    parts = lanelet2.read((path,), Asked(origin=Origin(48.0, 11.0, 100.0)))
    assert parts.survey is not None
    assert parts.survey.sign_code == ("de205",)
    (centre,) = parts.survey.sign_corners
    assert centre[0, 2] == pytest.approx(0.4, abs=1e-3)


@pytest.mark.parametrize(
    ("elements", "expected"),
    [
        ((), "has no ways"),
        ((way(1, (1, 99), type="line_thin"),), "way 1: node 99 is not in the file"),
        ((node(7, 480, 0), way(1, (1, 7), type="line_thin")), "node 7: no place on the earth"),
        (('<node id="7"/>',), "node 7: expected lat, lon and ele"),
        (
            (way(1, (1, 2, 3), type="traffic_sign", shape="round"),),
            "way 1: shape 'round' is unknown",
        ),
        (
            (way(1, (1, 2, 3), type="traffic_sign", shape="octagon"),),
            "octagon with 3 corners; expected 8",
        ),
        ((way(1, (1, 2), type="traffic_sign", height="low"),), "way 1: height: expected metres"),
    ],
)
def test_a_map_with_a_mistake_is_refused(tmp_path: Path, elements: tuple[str, ...], expected: str):
    with pytest.raises(InputError, match=expected):
        lanelet2.read((osm(tmp_path / "a.osm", *elements),), Asked())
