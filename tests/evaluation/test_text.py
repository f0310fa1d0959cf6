from __future__ import annotations

from dataclasses import replace

import pytest

from crowdmap_torch.evaluation.evaluate import evaluate_map
from crowdmap_torch.evaluation.map_figures import MapFigures
from crowdmap_torch.evaluation.text import format_figures


@pytest.fixture
def figures(build, row_of_signs) -> MapFigures:
    """Of a map 0.3 m east of its survey, with lanes."""
    signs, lines = build.signs(row_of_signs), [build.straight(0.0), build.straight(3.5)]
    hd_map = build.hd_map(build.moved(signs, (0.3, 0.0, 0.0)), build.lanes(lines), shared=0.05)
    return evaluate_map(hd_map, build.survey(signs, lines), notes=("said of the map",))


def test_every_figure_has_a_line_of_its_name(figures: MapFigures):
    lines = {line[:34].strip(): line[34:].split() for line in format_figures(figures).splitlines()}
    assert lines["recall"][:2] == ["100.0", "%"]
    assert lines["absolute corner"] == ["0.300", "0.300", "0.300", "12"]
    assert lines["relative corner"] == ["0.000", "0.000", "0.000", "12"]
    assert lines["median shift e n u [m]"] == ["+0.300", "+0.000", "+0.000"]
    assert "lateral" in lines and "centres in 95 % ellipsoid" in lines
    assert "oracle corner" not in lines and "pair precision" not in lines


def test_sections_without_figures_are_left_out_and_notes_come_last(figures: MapFigures):
    text = format_figures(replace(figures, lanes=None, uncertainty=None))
    assert "Lanes [m]" not in text and "Uncertainty" not in text
    assert text.splitlines()[-1] == "note: said of the map"


def test_what_is_unknown_is_a_dash(figures: MapFigures):
    unknown = replace(figures.signs, recall=float("nan"))
    text = format_figures(replace(figures, signs=unknown, lanes=None))
    assert "  recall" + " " * 26 + "-" in text.splitlines()
