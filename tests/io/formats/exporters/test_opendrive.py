from __future__ import annotations

import json
import shutil
import subprocess
import xml.etree.ElementTree as ET
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree
from worlds.marked_roads import bend, crossing, line, marked_map, two_way_road
from worlds.opendrive_reader import ReadRoad, facing, number

from crowdmap_torch.geometry import polygon
from crowdmap_torch.io.formats.composing.compose import write_survey_alone
from crowdmap_torch.io.formats.composing.map_files import map_of_file
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.exporters.features import lane_points
from crowdmap_torch.io.formats.exporters.opendrive import write
from crowdmap_torch.io.formats.importers import argoverse2
from crowdmap_torch.io.maps import read_map
from crowdmap_torch.tables import HdMap


def hill() -> HdMap:
    """A bend of 40 m, banked, on which one lane runs on where the other two end, with a sign; and a line by itself."""
    markers = [
        ("solid", bend(40, 170, 0.0)),
        ("dashed", bend(40, 170, -3.4)),
        ("solid", bend(40, 90, -6.9)),
        (None, line((200, 0), (230, 0))),
    ]
    signs = [("DE:205", (50.0, 30.0, 5.0, 250.0)), ("US:R1-1", (5.0, -12.0, 3.0, 200.0))]
    return marked_map(markers, signs)


def ragged() -> HdMap:
    """Four markers in a bend on a cambered road, none of which begins or ends beside another."""
    markers = []
    for aside, camber, cut in (
        (0, 0.0, (0, 9)),
        (-3.4, 0.08, (6, 5)),
        (-6.9, 0.06, (3, 1)),
        (-10.3, -0.09, (4, 12)),
    ):
        points = bend(60, 100, aside)
        points[:, 2] += camber
        markers.append(("solid", points[cut[0] : -cut[1]]))
    return marked_map(markers, [("US:R1-1", (5.0, 15.0, 3.0, 200.0))])


WORLDS = {"two-way": two_way_road, "hill": hill, "ragged": ragged}


def exported(hd_map: HdMap, folder: Path) -> list[ReadRoad]:
    write(hd_map, folder / "map.xodr")
    root = ET.parse(folder / "map.xodr").getroot()
    assert root.find("header").attrib["revMinor"] == "7"  # pyright: ignore[reportOptionalMemberAccess]
    return [ReadRoad(road) for road in root.iter("road") if road.attrib["junction"] == "-1"]


def dense(points: np.ndarray) -> np.ndarray:
    share = np.linspace(0, 1, 21)[:, None, None]
    return (points[:-1] + share * np.diff(points, axis=0)).reshape(-1, 3)


def test_lanes_come_and_go_with_their_markers(tmp_path: Path):
    road = max(exported(ragged(), tmp_path), key=lambda road: road.length)
    sections = road.element.findall("lanes/laneSection")
    counts = [len([x for x in s.iter("lane") if x.attrib["type"] == "driving"]) for s in sections]
    assert len(counts) >= 3 and max(counts) == 3 and counts[0] < 3 and counts[-1] < 3
    for one, other in pairwise(sections):
        for lane in one.iter("lane"):
            link = lane.find("link/successor")
            if link is None:
                continue
            # The other knows of it, and no edge jumps.
            (next_,) = (x for x in other.iter("lane") if x.attrib["id"] == link.attrib["id"])
            assert next_.find("link/predecessor").attrib["id"] == lane.attrib["id"]  # pyright: ignore[reportOptionalMemberAccess]
            at = number(other, "s")
            before, after = road.borders(at - 1e-6), road.borders(at)
            mine, its = int(lane.attrib["id"]), int(link.attrib["id"])
            assert before[mine] == pytest.approx(after[its], abs=1e-4)


@pytest.mark.parametrize("world", WORLDS)
def test_borders_of_lanes_are_the_markers(world: str, tmp_path: Path):
    hd_map = WORLDS[world]()
    markers = KDTree(np.concatenate([dense(p) for p in lane_points(hd_map.lanes)]))
    found = [
        edge
        for road in exported(hd_map, tmp_path)
        for s in np.linspace(0, road.length, 60)
        for edge in road.edges(s)
    ]
    # Chords of points a metre apart cut a bend of 40 m by 3 mm; what lies between them is 2.5 cm from a sample at most.
    assert markers.query(found)[0].max() < 0.05
    # And they reach along all of them but the one by itself.
    border = KDTree(np.array(found))
    least, lonely = {"ragged": (0.94, 0)}.get(world, (0.97, 1))
    for points in lane_points(hd_map.lanes)[: len(hd_map.lanes) - lonely]:
        assert np.mean(border.query(points)[0] < 2.0) > least


@pytest.mark.parametrize("world", WORLDS)
def test_signals_stand_and_face_as_the_signs(world: str, tmp_path: Path):
    hd_map = WORLDS[world]()
    signs = hd_map.signs
    told = {}
    for road in exported(hd_map, tmp_path):
        for signal in road.element.iter("signal"):
            told[signal.attrib["name"]] = (signal, road)
    assert told.keys() == {*hd_map.sign_id}
    for row, name in enumerate(hd_map.sign_id):
        signal, road = told[name]
        corners = polygon.corners(signs.shape[row], signs.size[row])
        T = signs.T_world_sign[row].numpy()
        bottom = T[:3, 3] + float(corners[:, 1].min()) * T[:3, 1]
        place = road.world(*(number(signal, key) for key in ("s", "t", "zOffset")))
        np.testing.assert_allclose(place, bottom, rtol=0, atol=1e-3)
        np.testing.assert_allclose(facing(signal, road), T[:3, 2], rtol=0, atol=1e-6)
        inertial = signal.find("positionInertial")
        assert inertial is not None
        np.testing.assert_allclose([number(inertial, a) for a in "xyz"], bottom, atol=1e-9)
        assert [number(signal, "width"), number(signal, "height")] == signs.size[row].tolist()
        code = None if signs.type[row] < 0 else hd_map.type_names[signs.type[row]]
        country, _, rest = (code or ":-1").partition(":")
        assert signal.attrib["type"] == rest and signal.attrib.get("country", "") == country
        kept = json.loads(signal.find("userData").attrib["value"])  # pyright: ignore[reportOptionalMemberAccess]
        assert kept["sign_id"] == name and kept["n_observations"] == 20 + row


def test_lanes_of_both_directions_lie_on_either_side_of_lane_0(tmp_path: Path):
    reads = exported(two_way_road(), tmp_path)
    for road in reads:
        assert road.element.attrib["rule"] == "RHT"
        marks = {k: lane.find("roadMark").attrib["type"] for k, lane in road.lanes().items()}  # pyright: ignore[reportOptionalMemberAccess]
        # The line may run either way.
        east = -1 if min(marks) == -2 else 1
        assert marks == {-east: "curb", 0: "solid solid", east: "broken", 2 * east: "solid"}
        heading = road.line(0.0)[2]
        assert np.cos(heading) == pytest.approx(-east)


def test_roads_go_on_into_one_another(tmp_path: Path):
    for world in (two_way_road, hill):
        reads = exported(world(), tmp_path)
        assert len(reads) == 2
        joined = 0
        for road in reads:
            follower = road.element.find("link/successor")
            if follower is None:
                continue
            (other,) = (r for r in reads if r.element.attrib["id"] == follower.attrib["elementId"])
            assert follower.attrib["contactPoint"] == "start"
            ends, starts = road.borders(road.length), other.borders(0.0)
            for number_, lane in road.lanes().items():
                link = lane.find("link/successor")
                if link is not None:
                    joined += 1
                    mine = road.world(road.length, ends[number_])
                    its = other.world(0.0, starts[int(link.attrib["id"])])
                    # Each road tilts as fits its own markers.
                    np.testing.assert_allclose(mine[:2], its[:2], rtol=0, atol=1e-3)
        assert joined >= 1


def test_lanes_go_on_over_a_crossing(tmp_path: Path):
    roads = {road.element.attrib["id"]: road for road in exported(crossing(), tmp_path)}
    root = ET.parse(tmp_path / "map.xodr").getroot()
    (junction,) = root.iter("junction")
    over = [ReadRoad(road) for road in root.iter("road") if road.attrib["junction"] != "-1"]
    # From each of four arms straight on, to the left and to the right.
    assert len(roads) == 4 and len(over) == len(junction) == 12
    ways = set()
    for road, connection in zip(over, junction, strict=True):
        assert road.element.attrib["junction"] == junction.attrib["id"]
        assert connection.attrib["connectingRoad"] == road.element.attrib["id"]
        ((lane_id, lane),) = [one for one in road.lanes().items() if one[0]]
        tips = []
        for name, s in (("predecessor", 0.0), ("successor", road.length)):
            link, lane_link = road.element.find(f"link/{name}"), lane.find(f"link/{name}")
            assert link is not None and lane_link is not None
            other, its = roads[link.attrib["elementId"]], int(lane_link.attrib["id"])
            at = {"start": 0.0, "end": other.length}[link.attrib["contactPoint"]]
            mine, theirs = road.borders(s), other.borders(at)
            inner = its - int(np.sign(its))
            for own, one in ((0, inner), (lane_id, its)):
                away = road.world(s, mine[own]) - other.world(at, theirs[one])
                assert np.linalg.norm(away) < 5e-3
            # Its arm says so too.
            which = {"start": "predecessor", "end": "successor"}[link.attrib["contactPoint"]]
            end = other.element.find(f"link/{which}")
            assert end is not None and end.attrib["elementType"] == "junction"
            assert end.attrib["elementId"] == junction.attrib["id"]
            # Lanes to the right of the line run along it: into the crossing at its end, out of it at its start.
            runs = (its < 0) == (link.attrib["contactPoint"] == "end")
            assert runs == (name == "predecessor")
            heading = other.line(at)[2] + (0.0 if its < 0 else np.pi)
            assert np.cos(road.line(s)[2] - heading) > 0.9999
            tips.append(link.attrib["elementId"])
        (lane_link,) = connection
        assert connection.attrib["incomingRoad"] == tips[0] and tips[0] != tips[1]
        assert int(lane_link.attrib["to"]) == lane_id
        ways.add(tuple(tips))
    assert len(ways) == 12


def test_lanes_go_on_where_none_is_marked(tmp_path: Path):
    """Not over another road, and not up a bridge."""
    before = [("solid", line((0, y), (40, y))) for y in (3.5, 0.0)]
    behind = [("solid", line((75, y), (120, y))) for y in (3.5, 0.0)]
    across = [("solid", line((x, -60), (x, 60))) for x in (55, 58.5)]
    high = [("solid", line((75, y), (120, y), z=5.0)) for y in (3.5, 0.0)]
    for markers, count in (
        ([*before, *behind], 1),
        ([*before, *behind, *across], 0),
        ([*before, *high], 0),
    ):
        exported(marked_map(markers), tmp_path)
        assert len([*ET.parse(tmp_path / "map.xodr").getroot().iter("junction")]) == count


def test_what_is_left_out_is_said(tmp_path: Path):
    losses = write(hill(), tmp_path / "hill.xodr")
    assert losses[0].startswith("32 m of markers without a lane")
    far = marked_map([("solid", line((0, 0), (50, 0)))], [("US:R1-1", (10.0, 3.0, 2.0, 180.0))])
    assert any(loss.startswith("1 signs: there is no road") for loss in write(far, tmp_path / "x"))
    beside = marked_map(
        [("solid", line((0, 0), (50, 0))), ("solid", line((0, -3), (50, -3)))],
        [("US:R1-1", (90.0, -5.0, 2.0, 180.0))],
    )
    assert any("positionInertial" in loss for loss in write(beside, tmp_path / "y"))


def test_a_map_without_landmarks_is_written(tmp_path: Path):
    assert write(marked_map([]), tmp_path / "bare.xodr") == ()
    assert [e.tag for e in ET.parse(tmp_path / "bare.xodr").getroot()] == ["header"]


@pytest.mark.parametrize("world", [*WORLDS, "crossing"])
def test_the_checker_of_asam_finds_nothing(world: str, tmp_path: Path):
    checker = shutil.which("qc_opendrive")
    if checker is None:
        pytest.skip("qc_opendrive (asam-qc-opendrive, in an environment of its own) is not on PATH")
    write({**WORLDS, "crossing": crossing}[world](), tmp_path / "map.xodr")
    (tmp_path / "config.xml").write_text(
        f'<Config><Param name="InputFile" value="{tmp_path / "map.xodr"}"/>'
        '<CheckerBundle application="xodrBundle">'
        f'<Param name="resultFile" value="{tmp_path / "result.xml"}"/></CheckerBundle></Config>'
    )
    subprocess.run([checker, "-c", str(tmp_path / "config.xml")], check=True, capture_output=True)
    result = ET.parse(tmp_path / "result.xml").getroot()
    assert len([*result.iter("Checker")]) > 15
    assert [issue.attrib["description"] for issue in result.iter("Issue")] == []
    assert not [c for c in result.iter("Checker") if c.attrib["status"] == "error"]


def test_lanes_of_a_real_map_are_where_its_markers_are(real_data, tmp_path: Path):
    for name in ("argoverse2/7fab2350-7eaf-3b7e-a39d-6937a4c1bede", "lanelet2/intersection.osm"):
        path = real_data(name)
        if path.suffix == ".osm":
            hd_map = map_of_file(path)
        else:
            write_survey_alone(
                tmp_path / "SURVEY",
                [replace(argoverse2.read((path,), Asked()), track=None, rig=None)],
            )
            hd_map = read_map(tmp_path / "SURVEY")
        markers = KDTree(np.concatenate([dense(p) for p in lane_points(hd_map.lanes)]))
        roads = exported(hd_map, tmp_path)
        found = [
            e for road in roads for s in np.linspace(0, road.length, 40) for e in road.edges(s)
        ]
        away = markers.query(found)[0]
        # Where two pieces of a marker leave a gap its border goes on.
        assert np.mean(away > 0.05) < 0.005, name
        assert len(roads) > 10
