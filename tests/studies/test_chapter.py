from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from crowdmap_torch.studies.chapter import Chapter, Table, shown, write_chapters
from crowdmap_torch.studies.curves import Line, Panel, Point, plot_bars, plot_lines


def test_tables_keep_every_digit_and_leave_out_what_is_unknown(tmp_path: Path):
    table = Table("errors", ("name", "error [m]", "n"), (("a, b", 0.123456, 3), ("c", math.nan, 0)))
    page = write_chapters(tmp_path, "all", "Studies", [Chapter("one", "One", tables=(table,))])
    with (tmp_path / "tables" / "errors.csv").open(encoding="utf-8") as file:
        assert list(csv.reader(file)) == [
            ["name", "error [m]", "n"],
            ["a, b", "0.123456", "3"],
            ["c", "", "0"],
        ]
    text = page.read_text(encoding="utf-8")
    assert ">0.123<" in text and ">-<" in text and ">nan<" not in text


def test_numbers_are_short_for_people():
    assert [shown(cell) for cell in ("a", 12345, 0.12345, 1234.5, math.nan)] == [
        *("a", "12,345", "0.123", "1,234", "-"),
    ]


def test_lines_have_one_colour_in_all_panels_and_skip_what_is_unknown():
    first = Panel("a", [Line("ours", [1, 2], [0.2, math.nan], [0.1, math.nan])])
    second = Panel("b", [Line("theirs", [1], [0.3]), Line("ours", [1], [0.1], style="--")])
    figure = plot_lines([first, second], x="journeys", y="error [m]")
    ours, (theirs, ours_again) = figure.axes[0].get_lines()[0], figure.axes[1].get_lines()
    assert list(np.asarray(ours.get_xdata())) == [1]
    assert ours.get_color() == ours_again.get_color() != theirs.get_color()


def test_what_others_measured_is_drawn_and_named():
    panel = Panel("a", [], [Point("the paper's drives", 25, 0.17)])
    (axes,) = plot_lines([panel], x="journeys", y="error [m]").axes
    assert axes.get_legend_handles_labels()[1] == ["the paper's drives"]


def test_bars_of_nothing_are_an_empty_figure():
    assert plot_bars({}, x="error [m]").axes
    (axes,) = plot_bars({"a": {"x": (1.0, 0.1)}, "b": {"y": (2.0, 0.1)}}, x="error [m]").axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b"]
