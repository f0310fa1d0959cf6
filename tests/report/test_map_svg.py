from __future__ import annotations

import re
from dataclasses import replace

import torch

from crowdmap_torch.report.map_svg import map_svg
from crowdmap_torch.report.record import RunRecord


def view_box(text: str) -> list[float]:
    found = re.search(r'viewBox="([^"]+)"', text)
    assert found
    return [float(v) for v in found.group(1).split()]


def turn(text: str) -> float:
    found = re.search(r'id="world" transform="rotate\(([^)]+)\)"', text)
    assert found
    return float(found.group(1))


def test_a_road_to_the_north_is_laid_along_the_page(build):
    k = torch.arange(9, dtype=torch.float64)
    north = build.hd_map(build.signs(torch.stack((0.1 * k, 50 * k, 0 * k), dim=-1)))
    text = map_svg(RunRecord("north", north))
    # 400 m and a tenth of margin, not twice that.
    assert view_box(text)[2] < 450
    assert 85 < abs(turn(text)) <= 90
    assert "rotate(" in text


def test_a_square_map_is_not_turned(build):
    square = build.signs([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [100, 100, 0]])
    assert turn(map_svg(RunRecord("square", build.hd_map(square)))) == 0


def test_the_map_is_inside_the_view(build):
    line = torch.tensor([[100.0, 200, 0], [180, 260, 0], [300, 330, 0]], dtype=torch.float64)
    hd_map = build.hd_map(build.signs([[110.0, 190, 2]]), build.lanes([line]))
    text = map_svg(RunRecord("line", hd_map))
    left, top, width, height = view_box(text)
    angle = torch.deg2rad(torch.tensor(turn(text)))
    for x, y in ((100, -200), (300, -330), (110, -190)):
        across = float(x * angle.cos() - y * angle.sin())
        down = float(x * angle.sin() + y * angle.cos())
        assert left < across < left + width
        assert top < down < top + height


def test_layers_are_only_those_that_hold_something(build, record):
    bare = map_svg(RunRecord("bare", build.hd_map(build.signs([[0.0, 0, 2]]))))
    assert re.findall(r'value="layer-([a-z-]+)"', bare) == ["signs"]
    full = re.findall(r'value="layer-([a-z-]+)"', map_svg(record))
    assert full == ["signs", "errors", "before", "survey-signs", "lanes", "survey-lanes", "paths"]


def test_signs_surveyed_by_centre_are_drawn(build):
    signs = build.signs([[0.0, 0, 2], [50, 0, 2]])
    survey = build.survey(signs)
    survey = replace(survey, signs=build.centers_only(survey.signs))
    text = map_svg(RunRecord("centres", build.hd_map(signs), survey=survey))
    assert "survey signs" in text
    assert "nan" not in text
