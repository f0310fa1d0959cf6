from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from worlds.marked_roads import ORIGIN, two_way_road

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.io.errors import InputError
from crowdmap_torch.io.formats.composing.compose import write_survey_alone
from crowdmap_torch.io.formats.composing.map_files import map_of_file
from crowdmap_torch.io.formats.composing.parts import Asked
from crowdmap_torch.io.formats.exporters.opendrive import write
from crowdmap_torch.io.formats.importers import opendrive
from crowdmap_torch.tables import LANE_TYPES, Origin

GEO = "<geoReference>+proj=tmerc +lat_0=48 +lon_0=11 +k=1 +x_0=0 +y_0=0</geoReference>"
HEAD = f'<OpenDRIVE><header revMajor="1" revMinor="7">{GEO}</header>'
LANES = """<lanes><laneSection s="0"><center><lane id="0" type="none"><roadMark sOffset="0" type="solid"/></lane></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/><roadMark sOffset="0" type="broken"/>
<roadMark sOffset="12" type="grass"/></lane></right></laneSection></lanes>"""


def xodr(path: Path, geometry: str, rest: str = LANES, head: str = HEAD) -> Path:
    length = sum(float(part.split('"')[0]) for part in geometry.split('length="')[1:])
    road = (
        f'<road id="7" length="{length}" junction="-1"><planView>{geometry}</planView>{rest}</road>'
    )
    path.write_text(f"{head}{road}</OpenDRIVE>")
    return path


def piece(s: float, x: float, y: float, hdg: float, length: float, shape: str) -> str:
    return f'<geometry s="{s}" x="{x}" y="{y}" hdg="{hdg}" length="{length}">{shape}</geometry>'


def test_an_exported_map_comes_back_as_it_was(tmp_path: Path):
    road = two_way_road()
    write(road, tmp_path / "road.xodr")
    parts = opendrive.read((tmp_path / "road.xodr",), Asked())
    assert parts.origin == ORIGIN
    survey = write_survey_alone(tmp_path / "SURVEY", [parts])
    assert sorted(survey.sign_id) == sorted(road.sign_id)
    # The marker by itself has no place in the format.
    assert sorted(survey.lane_id) == sorted(road.lane_id)[:-1]
    rows = [survey.sign_id.index(name) for name in road.sign_id]
    np.testing.assert_allclose(
        survey.signs.corners_world[rows], road.signs.corners_world, rtol=0, atol=1e-4
    )
    figures = evaluate_map(road, survey).as_dict()
    assert figures["signs"]["recall"] == 1 and figures["signs"]["precision"] == 1
    assert figures["signs"]["absolute"]["total"]["p95"] < 1e-3
    assert figures["lanes"]["recall"] == 1
    assert figures["lanes"]["lateral"]["p95"] < 1e-3
    types = {n: LANE_TYPES[k] for n, k in zip(survey.lane_id, survey.lane_type, strict=True)}
    assert types == {
        "lane-0": "curb",
        "lane-1": "double",
        "lane-2": "double",
        "lane-3": "dashed",
        "lane-4": "solid",
    }


def test_lines_arcs_and_spirals_are_where_they_should_be(tmp_path: Path):
    # Ten metres east, a quarter turn to the left about (10, 20), a spiral that ends straight.
    quarter = 10 * math.pi
    path = xodr(
        tmp_path / "turn.xodr",
        piece(0, 0, 0, 0, 10, "<line/>")
        + piece(10, 10, 0, 0, quarter, '<arc curvature="0.05"/>')
        + piece(10 + quarter, 30, 20, math.pi / 2, 20, '<spiral curvStart="0.05" curvEnd="0"/>'),
    )
    rows = opendrive.read((path,), Asked()).survey
    assert rows is not None
    middle = rows.lane_points[rows.lane_type.tolist().index(LANE_TYPES.index("solid"))]
    s = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(middle, axis=0), axis=1))))
    assert s[-1] == pytest.approx(30 + quarter, abs=2e-2)
    on_arc = middle[(s > 10.5) & (s < 40.5)]
    np.testing.assert_allclose(np.hypot(on_arc[:, 0] - 10, on_arc[:, 1] - 20), 20, atol=1e-3)
    # A clothoid from curvature 1/20 to nothing in 20 m turns by half a radian.
    assert np.arctan2(*(middle[-1] - middle[-2])[1::-1]) == pytest.approx(
        math.pi / 2 + 0.5, abs=1e-2
    )
    # Its dashed border ends where grass begins, 3.5 m to the right.
    dashed = rows.lane_points[rows.lane_type.tolist().index(LANE_TYPES.index("dashed"))]
    assert len(dashed) < 0.4 * len(middle) and dashed[0].tolist() == pytest.approx([0, -3.5, 0])


def test_cubics_with_a_range_of_one_are_cubics(tmp_path: Path):
    shape = '<paramPoly3 aU="0" bU="40" cU="0" dU="0" aV="0" bV="0" cV="4" dV="0"/>'
    rows = opendrive.read(
        (xodr(tmp_path / "x.xodr", piece(0, 0, 0, 0, 40.3, shape)),), Asked()
    ).survey
    assert rows is not None
    np.testing.assert_allclose(rows.lane_points[0][-1], [40, 4, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ((GEO, "<geoReference>+proj=utm +zone=32</geoReference>"), "--origin LAT LON HEIGHT"),
        (("OpenDRIVE", "Other"), "expected OpenDRIVE"),
        (("<line/>", "<curve/>"), "expected line, arc, spiral"),
        (('a="3.5"', 'a="wide"'), "width: a: expected a finite number, found 'wide'"),
        (("solid", "none"), "has no road marks"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path: Path, change, said: str):
    path = xodr(tmp_path / "x.xodr", piece(0, 0, 0, 0, 40, "<line/>"))
    text = path.read_text().replace(*change)
    path.write_text(text.replace("broken", "none") if change[0] == "solid" else text)
    with pytest.raises(InputError, match=said) as error:
        opendrive.read((path,), Asked())
    assert "\n" not in str(error.value) and str(path) in str(error.value)


def test_a_given_origin_stands_for_a_reference_that_is_none(tmp_path: Path):
    path = xodr(tmp_path / "x.xodr", piece(0, 0, 0, 0, 40, "<line/>"), head="<OpenDRIVE>")
    origin = Origin(1.0, 2.0, 3.0)
    assert opendrive.read((path,), Asked(origin=origin)).origin == origin


def test_files_of_maps_are_read_as_maps(tmp_path: Path):
    road = two_way_road()
    write(road, tmp_path / "road.xodr")
    hd_map = map_of_file(tmp_path / "road.xodr")
    assert sorted(hd_map.sign_id) == sorted(road.sign_id) and len(hd_map.lanes) == 5
    with pytest.raises(InputError, match="expected a map's folder, or a file"):
        map_of_file(tmp_path / "road.txt")
