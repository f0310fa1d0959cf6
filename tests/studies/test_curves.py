from __future__ import annotations

import math

import numpy as np

from crowdmap_torch.studies.curves import Line, Panel, Point, line_of, plot_bars, plot_lines
from crowdmap_torch.studies.numbers import spread


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


def test_a_line_of_spreads_has_their_means_and_sigmas():
    line = line_of("ours", [1, 2], [spread([1.0, 3.0]), spread([4.0])])
    assert (line.y, line.sigma) == ([2.0, 4.0], [1.0, 0.0])
